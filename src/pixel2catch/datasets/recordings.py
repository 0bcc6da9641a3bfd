"""Recordings of deployments as data sets: every run of the policy is an episode. Needs rosbags."""

from collections.abc import Iterator
from contextlib import suppress
from itertools import islice, pairwise
from pathlib import Path

import numpy as np
import torch

from pixel2catch.camera.boxes import pixel_features
from pixel2catch.camera.image import Pixels
from pixel2catch.datasets.lerobot import ACTION, DONE, SEEN, STATE, write_dataset
from pixel2catch.deployment.recorder import SERVO, TARGETS
from pixel2catch.errors import DeploymentError
from pixel2catch.ros2 import messages
from pixel2catch.ros2.bags import opened_bag
from pixel2catch.ros2.profile import Profile
from pixel2catch.scene.constants import RGB_CAMERA
from pixel2catch.servo.link import Command, JointTargets, Mode
from pixel2catch.workcells import find_workcell

RUNS = (int(Mode.RAMP), int(Mode.RUN))  #: Modes in which the robot follows the policy.
TASK = "Catch the thrown object."


def write_recording(folder: Path, recording: Path, profile: Profile) -> tuple[int, int]:
    """Write the runs of a recorded deployment, with images if there are any; without rewards or success.

    The image of a step is the newest that had arrived at the decision.

    Returns:
        The number of runs, and of control steps.

    Raises:
        PerceptionError: It cannot be read.
        DeploymentError: The policy never ran in it.
    """
    servo, orders, boxes, images = _read(recording, profile)
    ticks = np.searchsorted(
        [tick.time for tick in servo], [order.target_stamp for _, order in orders], "right"
    )
    is_followed = np.array([False, *(tick.mode in RUNS for tick in servo)])  # before the first tick, too
    chosen = np.flatnonzero(is_followed[ticks]) if orders else []
    if not len(chosen):
        raise DeploymentError(
            f"{recording}: the policy decided nothing there while the robot followed it; name what 'deploy "
            "--record' or 'rehearse --record' wrote, of a throw at least."
        )
    if not boxes:
        raise DeploymentError(f"{recording}: has no boxes on {profile.operator.status.name}; record it, too.")
    run = np.cumsum(~is_followed)[ticks[chosen]]  # it grows where a run ends
    is_first = np.diff(run, prepend=0) != 0
    times = [orders[row][0] for row in chosen]
    # The status with the box of a decision is recorded just after it.
    rows = np.minimum(np.searchsorted([time for time, _ in boxes], times), len(boxes) - 1)
    box = torch.from_numpy(np.array([boxes[row][1] for row in rows]))
    before = box[np.arange(len(run)) - ~is_first]
    columns = {
        STATE: np.array([servo[row - 1].joint_pos for row in ticks[chosen]]),
        ACTION: np.array([orders[row][1].joint_pos_target for row in chosen]),
        SEEN: torch.cat((box, pixel_features(before, box, RGB_CAMERA)), dim=1).numpy(),
        DONE: np.append(is_first[1:], True),
    }
    pictures = _pictures(recording, profile, np.searchsorted(images, times, side="right") - 1)
    ends = pairwise([*np.flatnonzero(is_first).tolist(), len(run)])
    episodes = (
        (TASK, {name: values[begin:end] for name, values in columns.items()}, islice(pictures, end - begin))
        for begin, end in ends
    )
    return write_dataset(folder, find_workcell(profile.workcell), episodes)


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
    return servo, orders, boxes, np.array(images)


def _image_topics(profile: Profile) -> tuple[str, ...]:
    topic = profile.camera.image
    return (topic.name, messages.compressed_topic(topic).name)


def _pictures(recording: Path, profile: Profile, wanted: np.ndarray) -> Iterator[Pixels]:
    """Yield images by their numbers, which never fall: the last good one where one is damaged."""
    if wanted.max() < 0:  # there are none
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
    if picture is None:
        raise DeploymentError(f"{recording}: no image can be read.")
