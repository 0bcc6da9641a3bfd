"""Messages of every kind, changed at random: a value or a `DeploymentError`, nothing else."""

import json
import random
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import numpy as np
import pytest

from mutation import changed_bytes, changed_json
from pixel2catch.deployment.control_loop import read_prompt
from pixel2catch.deployment.operator import is_status
from pixel2catch.errors import DeploymentError
from pixel2catch.ros2 import messages
from pixel2catch.ros2.messages import decode
from pixel2catch.ros2.profile import Profile
from pixel2catch.scene.constants import RGB_CAMERA

NUM_CHANGES = 150  #: Of each message.
PIXELS = np.zeros((6, 8, 3), dtype=np.uint8)
IMAGE = messages.image(PIXELS, 12.5)
PARTS = Profile.load("ur5e_allegro_v4").robots
NAMES = [joint.name_in_state for part in PARTS for joint in part.joints.values()]
BOX = [1.0, 2.0, 3.0, 4.0]
STATUS = {"mode": "run", "message": "", "box": BOX, "stopped_by": [], "refused": ["x"], "found": []}
JOINTS = messages.joint_state(NAMES, range(19), 3.25, velocity=range(19))


def merged(data: bytes) -> None:
    """Read a joint state as the servo does."""
    reading = messages.read_joint_state(data)
    for part in PARTS:
        np.take(reading.position, part.columns(reading.names)[0])


BINARY: dict[str, tuple[Any, Callable[[bytes], object]]] = {
    "joint_state": (JOINTS, merged),
    "image": (IMAGE, messages.read_image),
    "compressed": (messages.compress(IMAGE), messages.uncompress),
    "camera_info": (messages.camera_info(RGB_CAMERA, 1.0), messages.read_camera_info),
    "boolean": (messages.boolean(True), messages.read_boolean),
    "text": (messages.text("hello"), messages.read_text),
    "safety_mode": (messages.safety_mode(3), messages.read_safety_mode),
    "trajectory": (IMAGE, lambda data: decode(data, "trajectory_msgs/msg/JointTrajectory")),
}
"""A message of every type, and what reads it."""

TEXTS: dict[str, tuple[Any, Callable[[bytes], object]]] = {
    "prompt": ({"box": [1.0, 2.0, 3.0, 4.0]}, read_prompt),
    "status": (STATUS, lambda data: is_status(messages.read_json(data))),
    "request": ({"do": "prepare", "seed": 3}, messages.read_json),
}
"""JSON in a text, and what reads it."""


@pytest.mark.parametrize("name", [*BINARY, *TEXTS])
def test_a_changed_message_is_read_or_refused(name: str):
    valid, read = (BINARY | TEXTS)[name]
    for number in map(random.Random, range(NUM_CHANGES)):
        with suppress(DeploymentError):
            if isinstance(valid, bytes):
                read(changed_bytes(valid, number))
            else:
                text = changed_json(json.dumps(valid).encode(), number).decode("utf-8", "replace")
                read(messages.text(text.replace("\0", "")))


def test_a_message_that_is_too_large_is_refused(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(messages, "MOST_BYTES", len(IMAGE) - 1)
    with pytest.raises(DeploymentError, match="at most"):
        messages.read_image(IMAGE)


def test_an_image_larger_than_a_jpeg_is_refused():
    with pytest.raises(DeploymentError, match="too large for a JPEG"):
        messages.compress(messages.image(np.zeros((1, 70_000, 3), dtype=np.uint8), 0.0))
