"""Recordings of deployments as data sets: every run of the policy is an episode. Needs rosbags."""

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from pixel2catch.camera.boxes import pixel_features
from pixel2catch.camera.image import Pixels
from pixel2catch.datasets.lerobot import ACTION, DONE, SEEN, STATE, DatasetWriter
from pixel2catch.deployment.recorder import SERVO, TARGETS
from pixel2catch.errors import DeploymentError
from pixel2catch.ros2 import messages
from pixel2catch.ros2.bags import opened_bag
from pixel2catch.ros2.profile import Profile
from pixel2catch.scene.constants import RGB_CAMERA
from pixel2catch.servo.link import Command, JointTargets, Mode

RUNS = (int(Mode.RAMP), int(Mode.RUN))  #: Modes in which the robot follows the policy.
TASK = "Catch the thrown object."


@dataclass(frozen=True, kw_only=True, eq=False)
class _Decisions:
    """The decisions of the policy in its runs, with their inputs."""

    joint_pos: np.ndarray  #: Newest measured joint positions [rad], (num_steps, num_joints).
    target: np.ndarray  #: Joint targets [rad], (num_steps, num_joints).
    box: np.ndarray  #: Newest box that perception had found [px], (num_steps, 4).
    run: np.ndarray  #: Number of the run, (num_steps,).
    image: np.ndarray  #: Number of the newest image, (num_steps,); -1 for none.


def write_recording(recording: Path, profile: Profile, writer: DatasetWriter) -> None:
    """Write the runs of a recorded deployment, with images if there are any; without rewards or success.

    The image of a step is the newest that had arrived at the decision.

    Raises:
        PerceptionError: It cannot be read.
        DeploymentError: The policy never ran in it.
    """
    decisions = _decisions(recording, profile)
    run, box = decisions.run, torch.from_numpy(decisions.box)
    before = np.arange(len(run)) - (np.diff(run, prepend=-1) == 0)
    pixels = pixel_features(box[before], box, RGB_CAMERA).numpy()
    is_last = np.diff(run, append=-1) != 0
    pictures = _pictures(recording, profile, decisions.image)
    for row, picture in enumerate(pictures):
        step = {STATE: decisions.joint_pos[row], ACTION: decisions.target[row]}
        step[SEEN] = np.concatenate((decisions.box[row], pixels[row]))
        writer.add(step | {DONE: is_last[row]}, picture)
        if is_last[row]:
            writer.end_episode(TASK)


def _decisions(recording: Path, profile: Profile) -> _Decisions:
    servo, orders, boxes, images = _read(recording, profile)
    newest = np.searchsorted(
        [status.time for status in servo], [order.target_stamp for _, order in orders], side="right"
    )
    num_others = np.cumsum([status.mode not in RUNS for status in servo])  # a run ends where it grows
    chosen = [
        (time, order, servo[row - 1], num_others[row - 1])
        for (time, order), row in zip(orders, newest, strict=True)
        if row > 0 and servo[row - 1].mode in RUNS
    ]
    if not chosen:
        raise DeploymentError(
            f"{recording}: the policy decided nothing there while the robot followed it; name what 'deploy "
            "--record' or 'rehearse --record' wrote, of a throw at least."
        )
    times, decided, known, runs = zip(*chosen, strict=True)
    seen = np.searchsorted([time for time, _ in boxes], times)  # said of a decision just after it
    return _Decisions(
        joint_pos=np.array([status.joint_pos for status in known]),
        target=np.array([order.joint_pos_target for order in decided]),
        box=np.array([boxes[min(row, len(boxes) - 1)][1] for row in seen]),
        run=np.array(runs),
        image=np.searchsorted(images, times, side="right") - 1,
    )


def _read(
    recording: Path, profile: Profile
) -> tuple[list[Command], list[tuple[float, JointTargets]], list[tuple[float, np.ndarray]], np.ndarray]:
    """Ticks of the servo, decisions, boxes and the times of the images, each with the recorder's time [s]."""
    servo, orders, images = list[Command](), list[tuple[float, JointTargets]](), list[float]()
    boxes = list[tuple[float, np.ndarray]]()
    with opened_bag(recording, extra="deployment") as reader:
        for connection, nanoseconds, data in reader.messages():
            time, topic = 1e-9 * nanoseconds, connection.topic
            if topic == SERVO.name:
                servo.append(Command.of(messages.read_float_array(data)))
            elif topic == TARGETS.name:
                orders.append((time, JointTargets.of(messages.read_float_array(data))))
            elif topic == profile.operator.status.name:
                box = messages.read_json(data)["box"]
                if box is not None or boxes:
                    boxes.append((time, boxes[-1][1] if box is None else np.array(box)))
            elif topic in _image_topics(profile):
                images.append(time)
    if orders and not boxes:
        raise DeploymentError(f"{recording}: has no boxes on {profile.operator.status.name}; record it, too.")
    return servo, orders, boxes, np.array(images)


def _image_topics(profile: Profile) -> tuple[str, ...]:
    topic = profile.camera.image
    return (topic.name, messages.compressed_topic(topic).name)


def _pictures(recording: Path, profile: Profile, wanted: np.ndarray) -> Iterator[Pixels | None]:
    """Images by their numbers, which never fall: the last good one where one is damaged, None without any."""
    if wanted.max() < 0:
        yield from (None for _ in wanted)
        return
    row, picture = 0, None
    with opened_bag(recording, extra="deployment") as reader:
        topics = [each for each in reader.connections if each.topic in _image_topics(profile)]
        for number, (connection, _, data) in enumerate(reader.messages(topics)):
            if number in wanted or picture is None:
                with suppress(DeploymentError):
                    is_raw = connection.msgtype == messages.IMAGE
                    raw = bytes(data) if is_raw else messages.uncompress(bytes(data))
                    picture = messages.read_image(raw).pixels
            while picture is not None and row < len(wanted) and wanted[row] <= number:
                yield picture
                row += 1
            if row == len(wanted):
                return
    raise DeploymentError(f"{recording}: no image can be read.")
