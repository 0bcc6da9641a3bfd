"""Messages of every kind, changed at random: a value or a `DeploymentError`, nothing else."""

import json
import random
import re

import numpy as np
import pytest

from mutation import changed_bytes, changed_json
from pixel2catch.deployment.operator import is_status, read_prompt
from pixel2catch.errors import DeploymentError
from pixel2catch.ros2 import messages
from pixel2catch.ros2.joint_states import JointStateReader
from pixel2catch.ros2.messages import decode
from pixel2catch.ros2.profile import Profile
from pixel2catch.scene.constants import RGB_CAMERA

NUM_CHANGES = 150  #: Of each message.
PIXELS = np.zeros((6, 8, 3), dtype=np.uint8)
IMAGE = messages.image(PIXELS, 12.5)
PARTS = Profile.load("ur5e_allegro_v4").robots
NAMES = [joint.name_in_state for part in PARTS for joint in part.joints.values()]
STATUS = {
    "mode": "run",
    "message": "",
    "box": [1.0, 2.0, 3.0, 4.0],
    "stopped_by": [],
    "refused": ["x"],
    "found": [],
}


JOINTS = messages.joint_state(NAMES, range(19), 3.25, velocity=range(19))


def merged(data: bytes) -> None:
    """As the servo does with a joint state, of which it knows another; that makes no difference."""
    reader = JointStateReader()
    reader.read(JOINTS)
    try:
        reading = messages.read_joint_state(data)
    except DeploymentError as error:
        with pytest.raises(DeploymentError, match=re.escape(str(error))):
            reader.read(data)
        raise
    for again in (reader.read(data), reader.read(data)):
        assert (again.names, again.stamp) == (reading.names, reading.stamp)
        np.testing.assert_array_equal(again.position, reading.position)
    for part in PARTS:
        part.merge(reading, np.zeros(19))


BINARY = {
    "joint_state": (JOINTS, merged),
    "float_array": (messages.float_array([1.0, 2.0]), messages.read_float_array),
    "image": (IMAGE, messages.read_image),
    "compressed": (messages.compress(IMAGE), messages.uncompress),
    "camera_info": (messages.camera_info(RGB_CAMERA, 1.0), messages.read_camera_info),
    "boolean": (messages.boolean(True), messages.read_boolean),
    "number": (messages.number(1.5), messages.read_number),
    "text": (messages.text("hello"), messages.read_text),
    "safety_mode": (messages.safety_mode(3), messages.read_safety_mode),
    "robot_mode": (messages.robot_mode(-1), messages.read_robot_mode),
    "trajectory": (IMAGE, lambda data: decode(data, "trajectory_msgs/msg/JointTrajectory")),
    "definition": (IMAGE, lambda data: decode(data, "no_msgs/msg/Such")),
}
"""A message of every type, and what reads it."""

TEXTS = {
    "prompt": ({"box": [1.0, 2.0, 3.0, 4.0]}, read_prompt),
    "status": (STATUS, lambda data: is_status(messages.read_json(data))),
    "request": ({"do": "prepare", "seed": 3}, messages.read_json),
}
"""JSON in a text, and what reads it."""


@pytest.mark.parametrize("name", BINARY)
def test_a_changed_message_is_read_or_refused(name: str):
    valid, read = BINARY[name]
    for number in range(NUM_CHANGES):
        try:
            read(changed_bytes(valid, random.Random(number)))
        except DeploymentError:
            continue


@pytest.mark.parametrize("name", TEXTS)
def test_a_changed_text_is_read_or_refused(name: str):
    valid, read = TEXTS[name]
    for number in range(NUM_CHANGES):
        text = changed_json(json.dumps(valid).encode(), random.Random(number)).decode("utf-8", "replace")
        try:
            read(messages.text(text.replace("\0", "")))
        except DeploymentError:
            continue


def test_joint_states_of_two_drivers_and_of_one_that_changes_are_read_as_they_are():
    """On one topic, of equal sizes, with their numbers at other places; names that change, and none."""
    sent = [
        messages.joint_state(["a", "b"], [1.0, 2.0], 1.5),
        messages.joint_state(["a", "c"], [3.0, 4.0], 2.5, effort=[9.0, 9.0]),
        messages.joint_state(["a", "b"], [5.0, np.nan], -2.25),
        messages.joint_state(["c", "b"], [7.0, 8.0], 3.5),
        messages.joint_state([], [], 1.0),
        messages.joint_state(["a"], [1.0], 1.0, velocity=[4.0]),
        messages.joint_state(["a", ""], [1.0, 5.0], 1.0),
    ]
    reader, random_order = JointStateReader(), random.Random(0)
    for data in random_order.choices(sent, k=200):
        again, reading = reader.read(data), messages.read_joint_state(data)
        assert (again.names, again.stamp) == (reading.names, reading.stamp)
        np.testing.assert_array_equal(again.position, reading.position)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('{"box": [0, 0, 1, NaN]}', "'box' has the number nan"),
        ('{"box": [0, 0, 1, 1e999]}', "'box' has the number inf"),
        ('{"box": 1, "box": 2}', "the entry 'box' twice"),
        ('{"box": ' + 40 * "[" + 40 * "]" + "}", "nested deeper than 32"),
        ('{"seed": 9223372036854775808}', "more than 64 bits"),
        ('{"do": "\\ud800"}', "surrogates"),
        ("[1]", "must be a JSON object"),
    ],
)
def test_a_text_says_what_is_wrong(text: str, words: str):
    with pytest.raises(DeploymentError, match=words):
        messages.read_json(messages.text(text))


def test_a_message_is_no_larger_than_any_of_ours(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(messages, "MOST_BYTES", len(IMAGE) - 1)
    with pytest.raises(DeploymentError, match="at most are read"):
        messages.read_image(IMAGE)


@pytest.mark.parametrize("shape", [(1, 70_000, 3), (70_000, 1, 3)])
def test_an_image_larger_than_a_jpeg_is_refused(shape: tuple[int, ...]):
    with pytest.raises(DeploymentError, match="larger than a JPEG may be"):
        messages.compress(messages.image(np.zeros(shape, dtype=np.uint8), 0.0))
