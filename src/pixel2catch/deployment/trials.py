"""What a robot measured in a recorded throw, and the outcome that this proposes."""

from collections import deque
from itertools import pairwise
from math import inf
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pixel2catch.camera.image import Pixels
from pixel2catch.deployment.recorder import SERVO
from pixel2catch.deployment.replay import played
from pixel2catch.deployment.throw_cycle import FLIGHT, HELD_DISTANCE, HELD_TIME, palm_distance
from pixel2catch.robots.geometry import WorkcellGeometry
from pixel2catch.ros2 import messages
from pixel2catch.ros2.profile import Profile
from pixel2catch.scene.constants import CameraSpec
from pixel2catch.servo.link import Command
from pixel2catch.workcells import find_workcell

GRIP = 0.005
"""Mean distance of the fingers behind their commands [rad] from which the hand holds something.

Source: ours, from the twin: 0.000 in an empty hand, 0.009 or more with an object.
"""
GRIP_FROM, GRIP_TO = 0.5, 1.5  #: Time after the flight in which that is measured [s]. Source: ours.
LINGER, LINGER_TIME = 0.2, 0.08
"""Where a touched object is seen again: distance from the palm [m], time since the nearest [s].

Source: ours, from the twin.
"""
BEFORE = 0.3  #: Time for which a throw is shown before its flight is noticed [s]. Source: ours.
MOST_IMAGES = 90  #: Images that are kept of a throw, the newest.


class _Step(NamedTuple):
    time: float
    status: dict[str, Any]
    command: Command

    @property
    def center(self) -> np.ndarray:
        return np.reshape(self.status["box"], (2, 2)).mean(axis=0)


def measure(
    recording: Path, profile: Profile, camera: CameraSpec
) -> tuple[dict[str, Any], list[tuple[Pixels, list[float] | None]]]:
    """Return what was measured in a recorded throw, and images of its flight with the object's boxes [px].

    Returns:
        `proposed`: caught, reached, dropped, or repeat where nothing flew. `nearest`: smallest distance of
        object and palm, across the line of sight [m]. `is_held`: whether the object stayed at the palm.
        `grip`: median distance of the fingers behind their commands after the flight [rad], which is their
        torque over the stiffness of their servos. `stopped_by`: faults that stopped the robot.
    """
    steps, images = list[_Step](), deque[tuple[float, bytes]](maxlen=MOST_IMAGES)
    command: Command | None = None
    for time, topic, content in played(recording, {profile.camera.image, profile.operator.status, SERVO}):
        if topic == SERVO:
            command = Command.of(messages.read_float_array(content))
        elif topic == profile.operator.status and command:
            steps.append(_Step(time, messages.read_json(content), command))
        elif steps and steps[-1].status.get("cycle") == "throw":
            images.append((time, content))
    throw = [each for each in steps if each.status.get("cycle") == "throw" and each.status["box"]]
    flight = [each for each in throw if np.abs(each.center - throw[0].center).max() > FLIGHT]
    stopped_by = steps[-1].status["stopped_by"] if steps else []
    if not flight:
        return {"proposed": "repeat", "stopped_by": stopped_by}, []
    begin, end, workcell = flight[0].time, flight[-1].time, find_workcell(profile.workcell)
    geometry, hand = WorkcellGeometry(workcell), np.r_[workcell.of_role("hand")]
    distances = np.array(
        [palm_distance(geometry, camera, each.command.joint_pos, each.center) for each in flight]
    )
    times, boxes = np.array([each.time for each in flight]), [each.status["box"] for each in flight]
    is_new = np.array([True, *(one != other for one, other in pairwise(boxes))])
    place = int(np.argmin(np.where(is_new, distances, inf)))
    lingers = is_new & (times > times[place] + LINGER_TIME) & (distances < LINGER)
    errors = [
        np.abs(each.command.joint_pos_command - each.command.joint_pos)[hand].mean()
        for each in steps
        if GRIP_FROM <= each.time - end < GRIP_TO
    ]
    found = {
        "nearest": float(distances[place]),
        "is_held": bool((distances[times > end - 0.75 * HELD_TIME] < HELD_DISTANCE).all()),
        "grip": float(np.median(errors)) if errors else 0.0,
        "stopped_by": stopped_by,
    }
    is_caught = found["is_held"] and found["grip"] > GRIP
    proposed = "caught" if is_caught else "reached" if lingers.any() else "dropped"
    proposed = proposed if found["nearest"] < HELD_DISTANCE else "dropped"
    return {"proposed": proposed, **found}, [
        (messages.read_image(content).pixels, next((s.status["box"] for s in throw if s.time >= time), None))
        for time, content in images
        if time > begin - BEFORE
    ]
