"""Recordings of deployments as data sets: every run of the policy is an episode. Needs rosbags."""

import json
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch

from pixel2catch.camera.boxes import pixel_features
from pixel2catch.datasets.features import ACTION, DONE, SEEN, STATE
from pixel2catch.datasets.lerobot import DatasetWriter, Image
from pixel2catch.deployment.recorder import ORDERS, SERVO
from pixel2catch.errors import DeploymentError
from pixel2catch.ros2 import messages
from pixel2catch.ros2.bags import opened_bag
from pixel2catch.ros2.profile import Profile
from pixel2catch.scene.constants import CONTROL_DT, RGB_CAMERA
from pixel2catch.servo.core import Mode
from pixel2catch.servo.link import PolicyCommand, ServoStatus

RUNS = (int(Mode.RAMP), int(Mode.RUN))  #: Modes in which the robot follows the policy.
LONGEST_GAP = 5.0 * CONTROL_DT  #: Time between two decisions of one episode at most [s]. Source: ours.
TASK = "Catch the thrown object."


@dataclass(frozen=True, kw_only=True, eq=False)
class _Decisions:
    """What the policy decided in its runs, on what it knew; times are the recorder's [s]."""

    time: np.ndarray  #: (num_steps,)
    joint_pos: np.ndarray  #: Newest measured joint positions [rad], (num_steps, num_joints).
    target: np.ndarray  #: Joint targets [rad], (num_steps, num_joints).
    box: np.ndarray  #: Newest box that perception had found [px], (num_steps, 4).
    episode: np.ndarray  #: Number of the run, (num_steps,).
    image: np.ndarray  #: Number of the newest image, (num_steps,); -1 for none.


def write_recording(recording: Path, profile: Profile, writer: DatasetWriter) -> None:
    """Write the runs of a recorded deployment, with images if it has them.

    An image is the newest that had arrived at the decision. Nobody knows rewards or success.

    Raises:
        PerceptionError: It cannot be read.
        DeploymentError: The policy never ran in it.
    """
    runs = _decisions(recording, profile)
    box = torch.from_numpy(runs.box)
    before = np.maximum(np.arange(len(runs.time)) - (np.diff(runs.episode, prepend=-1) == 0), 0)
    pixels = pixel_features(box[before], box, RGB_CAMERA).numpy()
    is_last = np.diff(runs.episode, append=-1) != 0
    pictures = _pictures(recording, profile, runs.image)
    for row, picture in enumerate(pictures):
        step = {STATE: runs.joint_pos[row], ACTION: runs.target[row]}
        step[SEEN] = np.concatenate((runs.box[row], pixels[row]))
        writer.add(step | {DONE: is_last[row]}, picture)
        if is_last[row]:
            writer.end_episode(TASK)


def _decisions(recording: Path, profile: Profile) -> _Decisions:
    """Read all but the images."""
    servo, orders, boxes, images = _read(recording, profile)
    clock = np.array([status.time for status in servo])
    newest = np.searchsorted(clock, [order.target_stamp for _, order in orders], side="right") - 1
    chosen = [
        (time, order, servo[row])
        for (time, order), row in zip(orders, newest, strict=True)
        if row >= 0 and servo[row].mode in RUNS
    ]
    if not chosen:
        raise DeploymentError(
            f"{recording}: the policy decided nothing there while the robot followed it; name what 'deploy "
            "--record' or 'rehearse --record' wrote, of a throw at least."
        )
    times = np.array([time for time, _, _ in chosen])
    gaps = (after - before > LONGEST_GAP for before, after in pairwise(times))
    box_times = np.array([time for time, _ in boxes])
    seen = np.minimum(np.searchsorted(box_times, times - 1e-9), len(boxes) - 1)
    return _Decisions(
        time=times,
        joint_pos=np.array([status.joint_pos for _, _, status in chosen]),
        target=np.array([order.joint_pos_target for _, order, _ in chosen]),
        box=np.array([boxes[row][1] for row in seen]),
        episode=np.cumsum([0, *gaps]),
        image=np.searchsorted(images, times, side="right") - 1,
    )


def _read(
    recording: Path, profile: Profile
) -> tuple[list[ServoStatus], list[tuple[float, PolicyCommand]], list[tuple[float, np.ndarray]], np.ndarray]:
    """Ticks of the servo, decisions, boxes and the times of the images, each with the recorder's time [s]."""
    servo, orders, images = list[ServoStatus](), list[tuple[float, PolicyCommand]](), list[float]()
    boxes = list[tuple[float, np.ndarray]]()
    with opened_bag(recording, extra="deployment") as reader:
        for connection, nanoseconds, data in reader.messages():
            time, topic = 1e-9 * nanoseconds, connection.topic
            if topic == SERVO.name:
                servo.append(ServoStatus.of(messages.read_float_array(data)))
            elif topic == ORDERS.name:
                orders.append((time, PolicyCommand.of(messages.read_float_array(data))))
            elif topic == profile.operator.status.name:
                box = json.loads(messages.read_text(data))["box"]
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


def _pictures(recording: Path, profile: Profile, wanted: np.ndarray) -> Iterator[Image | None]:
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
