"""Messages as bytes: by hand, round trips, and damaged ones."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pixel2catch.errors import DeploymentError
from pixel2catch.ros2 import messages
from pixel2catch.scene.constants import RGB_CAMERA

LITTLE = b"\x00\x01\x00\x00"
"""The header of a message in little endian."""

PIXELS = np.arange(4 * 5 * 3, dtype=np.uint8).reshape(4, 5, 3)

EXAMPLES = {
    "joint_state": messages.joint_state(["a", "bc"], [0.5, -1.0], 3.25, velocity=[1.0, 2.0]),
    "float_array": messages.float_array([1.0, 2.0]),
    "image": messages.image(PIXELS, 12.5),
    "camera_info": messages.camera_info(RGB_CAMERA, 1.0),
    "boolean": messages.boolean(True),
    "number": messages.number(1.5),
    "text": messages.text('{"do": "throw"}'),
    "safety_mode": messages.safety_mode(3),
    "robot_mode": messages.robot_mode(-1),
    "compressed_image": messages.encode(
        messages.COMPRESSED_IMAGE,
        messages.header(12.5, messages.OPTICAL_FRAME),
        messages.FORMAT,
        np.array([255, 216, 255, 217], dtype=np.uint8),
    ),
}

RCLPY = json.loads(Path(__file__).with_name("rclpy_bytes.json").read_text())
"""Bytes of the examples from `rclpy.serialization.serialize_message`, and its version."""


@pytest.mark.parametrize("name", EXAMPLES)
def test_a_message_has_the_bytes_of_rclpy(name: str):
    assert EXAMPLES[name].hex() == RCLPY["cdr"][name]


def test_active_controllers_by_hand():
    """A header of the year 1970, two controllers with number, name and label each, and no hardware."""
    data = messages.activity({"up": messages.ACTIVE, "down": 2}, 0.0)
    empty = b"\0\0\0\0\0\0\0\0\1\0\0\0\0\0\0\0"
    up = b"\3\0\0\0up\0\3\1\0\0\0\0\0\0\0"
    down = b"\5\0\0\0down\0\2\0\0\1\0\0\0\0\0\0\0"
    assert data == LITTLE + empty + b"\2\0\0\0" + up + down + b"\0\0\0\0"
    assert messages.read_active_controllers(data) == {"up"}


def test_messages_are_read_as_written():
    reading = messages.read_joint_state(EXAMPLES["joint_state"])
    assert (reading.names, reading.position.tolist(), reading.stamp) == (("a", "bc"), [0.5, -1.0], 3.25)
    assert messages.read_float_array(EXAMPLES["joint_state"], messages.JOINT_STATE).tolist() == [0.5, -1.0]
    for name, value in (
        ("float_array", [1.0, 2.0]),
        ("boolean", True),
        ("number", 1.5),
        ("text", '{"do": "throw"}'),
        ("safety_mode", 3),
        ("robot_mode", -1),
    ):
        assert np.array_equal(getattr(messages, f"read_{name}")(EXAMPLES[name]), value)


@given(st.floats(0.0, 2.0**31 - 1.0))
def test_stamps_keep_microseconds(stamp: float):
    reading = messages.read_joint_state(messages.joint_state([], [], stamp))
    assert reading.stamp == pytest.approx(stamp, abs=1e-6)


def image_message(pixels: np.ndarray, encoding: str, step: int, height: int | None = None) -> bytes:
    """An image of a camera, which may pad its rows."""
    rows = np.zeros((len(pixels), step), dtype=np.uint8)
    rows[:, : pixels[0].size] = pixels.reshape(len(pixels), -1)
    height, width = len(pixels) if height is None else height, pixels.shape[1]
    fields = (messages.header(1.0), height, width, encoding, 0, step, rows.ravel())
    return messages.encode(messages.IMAGE, *fields)


def test_padding_and_order_of_the_channels_are_undone_and_an_image_without_is_not_copied():
    alpha = np.insert(PIXELS[..., ::-1], 3, 9, axis=-1)
    for encoding, sent in (("rgb8", PIXELS), ("bgr8", PIXELS[..., ::-1]), ("bgra8", alpha)):
        reading = messages.read_image(image_message(sent, encoding, step=24))
        np.testing.assert_array_equal(reading.pixels, PIXELS)
        assert (reading.encoding, reading.stamp) == (encoding, 1.0)
    data = messages.image(PIXELS, 0.0)
    pixels = messages.read_image(data).pixels
    assert np.shares_memory(pixels, np.frombuffer(data, dtype=np.uint8))
    assert not pixels.flags.writeable


@pytest.mark.parametrize(
    ("kind", "data", "message"),
    [
        ("image", image_message(PIXELS, "16UC1", 15), "the encoding is '16UC1'; set the camera"),
        ("image", image_message(PIXELS, "rgb8", 15, height=5), "image of 5 x 5 has 60 bytes"),
        ("image", image_message(PIXELS, "rgb8", 15, height=0), "image of 5 x 0"),
        ("joint_state", messages.joint_state(["a", "b"], [1.0], 0.0), "1 positions for 2 names"),
        ("camera_info", messages.camera_info(replace(RGB_CAMERA, fx=0.0), 0.0), "no focal length.*calibrate"),
    ],
)
def test_a_message_that_cannot_be_used_is_refused(kind: str, data: bytes, message: str):
    with pytest.raises(DeploymentError, match=message):
        getattr(messages, f"read_{kind}")(data)


def test_the_lens_is_sent_in_pixel_coordinates_of_ros():
    data = messages.camera_info(RGB_CAMERA, 1.0)
    reading = messages.read_camera_info(data)
    for name in ("width", "height", "fx", "fy", "cx", "cy"):
        assert getattr(reading, name) == pytest.approx(getattr(RGB_CAMERA, name))
    assert messages.decode(data, messages.CAMERA_INFO).k[2] == RGB_CAMERA.cx - 0.5
