"""Messages as bytes: hand-worked ones, round trips, and what damaged ones do."""

import struct
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pixel2catch.errors import DeploymentError
from pixel2catch.ros2 import messages
from pixel2catch.scene.constants import RGB_CAMERA

LITTLE = b"\x00\x01\x00\x00"
"""The header of a message in little endian."""

READERS: dict[str, Callable[[bytes], object]] = {
    name: getattr(messages, f"read_{name}")
    for name in (
        "joint_state",
        "float_array",
        "image",
        "camera_info",
        "boolean",
        "number",
        "text",
        "safety_mode",
        "robot_mode",
    )
}

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
}


def test_small_messages_are_the_bytes_that_ros_2_sends():
    assert messages.boolean(True) == LITTLE + b"\x01"
    assert messages.number(1.5) == LITTLE + struct.pack("<d", 1.5)
    assert messages.text("ab") == LITTLE + struct.pack("<I", 3) + b"ab\x00"
    assert messages.safety_mode(3) == LITTLE + b"\x03"
    assert messages.robot_mode(-1) == LITTLE + b"\xff"


def test_a_joint_state_is_the_bytes_that_ros_2_sends():
    stamp, frame = struct.pack("<iI", 3, 250_000_000), struct.pack("<I", 1) + b"\x00" + 3 * b"\x00"
    names = struct.pack("<I", 1) + struct.pack("<I", 2) + b"a\x00"
    # 26 bytes so far; the number of positions begins at 28, the positions at 32, a multiple of 8.
    position = 2 * b"\x00" + struct.pack("<I", 1) + struct.pack("<d", 0.5)
    nothing = 2 * struct.pack("<I", 0)
    assert messages.joint_state(["a"], [0.5], 3.25) == LITTLE + stamp + frame + names + position + nothing


def test_controllers_that_are_active_are_known_by_their_state():
    """A header of the year 1970, two controllers with number, name and label each, and no hardware."""
    data = messages.activity({"up": messages.ACTIVE, "down": 2}, 0.0)
    empty = b"\0\0\0\0\0\0\0\0\1\0\0\0\0\0\0\0"
    up = b"\3\0\0\0up\0\3\1\0\0\0\0\0\0\0"
    down = b"\5\0\0\0down\0\2\0\0\1\0\0\0\0\0\0\0"
    assert data == LITTLE + empty + b"\2\0\0\0" + up + down + b"\0\0\0\0"
    assert messages.read_active_controllers(data) == {"up"}


def test_what_is_read_is_what_was_written():
    reading = messages.read_joint_state(EXAMPLES["joint_state"])
    assert (reading.names, reading.position.tolist(), reading.stamp) == (("a", "bc"), [0.5, -1.0], 3.25)
    assert messages.read_float_array(EXAMPLES["float_array"]).tolist() == [1.0, 2.0]
    assert messages.read_boolean(EXAMPLES["boolean"]) is True
    assert messages.read_number(EXAMPLES["number"]) == 1.5
    assert messages.read_text(EXAMPLES["text"]) == '{"do": "throw"}'
    assert messages.read_safety_mode(EXAMPLES["safety_mode"]) == 3
    assert messages.read_robot_mode(EXAMPLES["robot_mode"]) == -1


@given(st.floats(0.0, 2.0**31 - 1.0))
def test_stamps_keep_microseconds(stamp: float):
    assert messages.read_joint_state(messages.joint_state([], [], stamp)).stamp == pytest.approx(
        stamp, abs=1e-6
    )


def test_numbers_that_are_none_are_passed_on_for_the_servo_to_refuse():
    reading = messages.read_joint_state(messages.joint_state(["a", "b"], [np.nan, np.inf], 0.0))
    assert np.isnan(reading.position[0])
    assert np.isinf(reading.position[1])


def test_a_joint_state_without_a_position_for_every_name_is_refused():
    with pytest.raises(DeploymentError, match="1 positions for 2 names"):
        messages.read_joint_state(messages.joint_state(["a", "b"], [1.0], 0.0))


def image_message(pixels: np.ndarray, encoding: str, step: int, height: int | None = None) -> bytes:
    """An image of a camera, which may pad its rows."""
    rows = np.zeros((len(pixels), step), dtype=np.uint8)
    rows[:, : pixels[0].size] = pixels.reshape(len(pixels), -1)
    types = messages.STORE.types
    header = types["std_msgs/msg/Header"](types["builtin_interfaces/msg/Time"](1, 0), "camera")
    height = len(pixels) if height is None else height
    message = types[messages.IMAGE](header, height, pixels.shape[1], encoding, 0, step, rows.ravel())
    return bytes(messages.STORE.serialize_cdr(message, messages.IMAGE))


@pytest.mark.parametrize("step", [15, 16, 32])
def test_padding_and_order_of_the_channels_are_undone(step: int):
    for encoding, sent in (("rgb8", PIXELS), ("bgr8", PIXELS[..., ::-1])):
        reading = messages.read_image(image_message(sent, encoding, step))
        np.testing.assert_array_equal(reading.pixels, PIXELS)
        assert (reading.encoding, reading.stamp) == (encoding, 1.0)


def test_an_image_without_padding_is_not_copied():
    data = messages.image(PIXELS, 0.0)
    pixels = messages.read_image(data).pixels
    assert np.shares_memory(pixels, np.frombuffer(data, dtype=np.uint8))
    assert not pixels.flags.writeable


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (image_message(PIXELS, "mono8", 15), "encoded as 'mono8'; have the camera send rgb8 or bgr8"),
        (image_message(PIXELS, "rgb8", 15, height=5), "image of 5 x 5 has 60 bytes, 15 a row"),
        (image_message(PIXELS[:, :0], "rgb8", 0), "image of 0 x 4"),
        (image_message(PIXELS, "rgb8", 15, height=0), "image of 5 x 0"),
    ],
)
def test_an_image_that_cannot_be_read_is_refused(data: bytes, message: str):
    with pytest.raises(DeploymentError, match=message):
        messages.read_image(data)


def test_the_camera_keeps_its_lens_and_ros_gets_its_own_pixel_coordinates():
    data = messages.camera_info(RGB_CAMERA, 1.0)
    reading = messages.read_camera_info(data)
    for name in ("width", "height", "fx", "fy", "cx", "cy"):
        assert getattr(reading.camera, name) == pytest.approx(getattr(RGB_CAMERA, name))
    assert reading.distortion == ()
    matrix = messages.STORE.deserialize_cdr(data, messages.CAMERA_INFO).k  # pyright: ignore[reportAttributeAccessIssue]
    assert matrix[2] == RGB_CAMERA.cx - 0.5, "ROS calls the middle of the first pixel 0"


def test_a_camera_that_is_not_calibrated_is_refused():
    message = messages.STORE.deserialize_cdr(EXAMPLES["camera_info"], messages.CAMERA_INFO)
    message.k = np.zeros(9)  # pyright: ignore[reportAttributeAccessIssue]
    with pytest.raises(DeploymentError, match="no focal length: calibrate it"):
        messages.read_camera_info(bytes(messages.STORE.serialize_cdr(message, messages.CAMERA_INFO)))


@pytest.mark.parametrize("name", READERS)
def test_a_message_that_was_cut_is_refused_wherever_it_was_cut(name: str):
    data = EXAMPLES[name]
    for size in range(len(data) - 3):  # three bytes may be padding
        with pytest.raises(
            DeploymentError, match=r"two programs disagree|positions for|not calibrated|damaged"
        ):
            READERS[name](data[:size])


@pytest.mark.parametrize("name", READERS)
@given(st.binary(max_size=120))
def test_noise_is_refused_or_read_but_never_crashes(name: str, data: bytes):
    for message in (data, LITTLE + data):
        try:
            READERS[name](message)
        except DeploymentError:
            continue
