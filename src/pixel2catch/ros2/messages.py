"""Messages of a deployment as CDR bytes, by rosbags. Stamps are seconds since the epoch."""

import struct
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from io import BytesIO
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Float
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from pixel2catch.camera.image import Image, Pixels
from pixel2catch.errors import DeploymentError, InvalidValueError
from pixel2catch.files import json_object, printable
from pixel2catch.robots.spec import IDENTITY
from pixel2catch.ros2.transport import Topic
from pixel2catch.scene.constants import PIXEL_CENTER, CameraSpec

SAFETY_MODE = "ur_dashboard_msgs/msg/SafetyMode"
ROBOT_MODE = "ur_dashboard_msgs/msg/RobotMode"
ACTIVITY = "controller_manager_msgs/msg/ControllerManagerActivity"
_CONTROLLER = "controller_manager_msgs/msg/NamedLifecycleState"
JOINT_STATE = "sensor_msgs/msg/JointState"
FLOAT_ARRAY = "std_msgs/msg/Float64MultiArray"
IMAGE = "sensor_msgs/msg/Image"
COMPRESSED_IMAGE = "sensor_msgs/msg/CompressedImage"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
BOOLEAN = "std_msgs/msg/Bool"
NUMBER = "std_msgs/msg/Float64"
TEXT = "std_msgs/msg/String"

MOST_BYTES = 2**26  #: Largest message that is read [bytes]: an image of 22 million pixels. Source: ours.
NORMAL_SAFETY_MODE, PROTECTIVE_STOP, RUNNING_ROBOT_MODE = 1, 3, 7
"""Modes of a UR robot; it moves in the first and the last. Source: `ur_dashboard_msgs`."""
ACTIVE = 3  #: State of a controller that moves its joints. Source: `lifecycle_msgs`.

STORE = get_typestore(Stores.ROS2_JAZZY)
"""Definitions of all messages. Source: ROS 2 Jazzy; `ur_dashboard_msgs`; `controller_manager_msgs`."""

_STATES = (
    "std_msgs/Header header\nNamedLifecycleState[] controllers\nNamedLifecycleState[] hardware_components"
)
for kind, definition in {
    SAFETY_MODE: "uint8 mode",
    ROBOT_MODE: "int8 mode",
    _CONTROLLER: "string name\nlifecycle_msgs/State state",
    ACTIVITY: _STATES,
}.items():
    STORE.register(get_types_from_msg(definition, kind))


def encode(kind: str, *fields: Any) -> bytes:
    """Encode a message of a type with these fields."""
    return bytes(STORE.serialize_cdr(STORE.types[kind](*fields), kind))


def decode(data: bytes, kind: str) -> Any:
    """Decode a message, its arrays as views of the data; raise DeploymentError for other or damaged data."""
    if len(data) > MOST_BYTES:
        raise DeploymentError(f"a message has {len(data):,} bytes; at most {MOST_BYTES:,} are read.")
    try:
        return STORE.deserialize_cdr(memoryview(data), kind)
    except (SerdeError, struct.error, ValueError, LookupError) as error:
        fix = "two programs use different types for a topic"
        raise DeploymentError(f"a message is no {kind} ({error}): {fix}.") from error


def float64(values: Iterable[float]) -> np.ndarray:
    """Return numbers as the encoder needs them."""
    return np.array(values if isinstance(values, np.ndarray) else tuple(values), dtype=np.float64)


def header(stamp: float, frame_id: str = "") -> Any:
    """Return a header with a time since the epoch [s]."""
    nanoseconds = round(stamp * 1e9)
    time = STORE.types["builtin_interfaces/msg/Time"](sec=nanoseconds // 10**9, nanosec=nanoseconds % 10**9)
    return STORE.types["std_msgs/msg/Header"](stamp=time, frame_id=frame_id)


def seconds(header: Any) -> float:
    """Return the time of a header since the epoch [s]."""
    return header.stamp.sec + 1e-9 * header.stamp.nanosec


ENCODINGS = {
    "rgb8": (3, ""),
    **dict.fromkeys(("bgr8", "8UC3"), (3, "BGR2RGB")),
    "rgba8": (4, "RGBA2RGB"),
    **dict.fromkeys(("bgra8", "8UC4"), (4, "BGRA2RGB")),
    **dict.fromkeys(("mono8", "8UC1"), (1, "GRAY2RGB")),
    **dict.fromkeys(("yuv422", "uyvy"), (2, "YUV2RGB_UYVY")),
    **dict.fromkeys(("yuv422_yuy2", "yuyv"), (2, "YUV2RGB_YUY2")),
    **{f"bayer_{order.lower()}8": (1, f"Bayer{order}2RGB") for order in ("RGGB", "BGGR", "GBRG", "GRBG")},
}
"""Encodings that are read: bytes of a pixel, and OpenCV's conversion. Source: REP 118, cv_bridge."""

OPTICAL_FRAME = "camera_color_optical_frame"  #: Frame of the images. Source: RealSense driver.


@dataclass(frozen=True, kw_only=True)
class JointReading:
    """Joint positions of a joint state."""

    names: tuple[str, ...]  #: The driver's names of the joints, in its order.
    position: Float[np.ndarray, " num_joints"]  #: Their positions [rad].
    stamp: float  #: Time of their measurement [s].


def joint_state(
    names: Iterable[str], position: Iterable[float], stamp: float, velocity: Iterable[float] = ()
) -> bytes:
    """Encode positions [rad], and optionally velocities [rad/s], of joints by name; efforts are left out."""
    return encode(JOINT_STATE, header(stamp), list(names), float64(position), float64(velocity), float64(()))


def read_joint_state(data: bytes) -> JointReading:
    """Decode the positions of a joint state; raises as `decode`, and where a name has no position."""
    message = decode(data, JOINT_STATE)
    names, position = tuple(message.name), float64(message.position)
    if len(names) != len(position):
        wrong = f"a joint state has {len(position)} positions for {len(names)} names"
        raise DeploymentError(f"{wrong}: check the program that publishes it.")
    return JointReading(names=names, position=position, stamp=seconds(message.header))


_LAYOUT = STORE.types["std_msgs/msg/MultiArrayLayout"](dim=[], data_offset=0)


def float_array(values: Iterable[float]) -> bytes:
    """Encode numbers without names, such as the commands of a forward position controller."""
    return encode(FLOAT_ARRAY, _LAYOUT, float64(values))


def read_float_array(data: bytes, kind: str = FLOAT_ARRAY) -> Float[np.ndarray, " size"]:
    """Decode numbers without names, or the positions of a joint state; raises as `decode` does."""
    message = decode(data, kind)
    return float64(message.data if kind == FLOAT_ARRAY else message.position)


def image(pixels: Pixels, stamp: float, frame_id: str = OPTICAL_FRAME) -> bytes:
    """Encode an image as rgb8."""
    height, width, _ = pixels.shape
    return encode(IMAGE, header(stamp, frame_id), height, width, "rgb8", 0, 3 * width, np.ravel(pixels))


def pixels_of(message: Any) -> Pixels | None:
    """Return the pixels of a decoded image, or None if its size and its bytes do not fit."""
    if message.encoding not in ENCODINGS:
        known = ", ".join(ENCODINGS)
        raise DeploymentError(f"the encoding is '{message.encoding}'; set the camera to one of {known}.")
    size, conversion = ENCODINGS[message.encoding]
    height, width, step = message.height, message.width, message.step
    is_odd = size == 2 and width % 2 == 1  # two pixels of YUV 4:2:2 share their colour
    if min(height, width) < 1 or step < size * width or len(message.data) < height * step or is_odd:
        return None
    rows = np.asarray(message.data)[: height * step].reshape(height, step)[:, : size * width]
    pixels = np.ascontiguousarray(rows).reshape(height, width, size)  # no copy without padding
    if not conversion:
        return pixels
    import cv2

    if "Bayer" in conversion and min(height, width) < 2:
        return None
    return cv2.cvtColor(pixels, getattr(cv2, f"COLOR_{conversion}"))


def read_image(data: bytes) -> Image:
    """Decode an image; raises as `decode` and `pixels_of`, and where bytes are missing."""
    message = decode(data, IMAGE)
    if (pixels := pixels_of(message)) is None:
        size = f"{message.width} x {message.height} has {len(message.data)} bytes, {message.step} in each row"
        raise DeploymentError(f"an image of {size}: it is damaged.")
    return Image(pixels=pixels, stamp=seconds(message.header), encoding=message.encoding)


def camera_info(camera: CameraSpec, stamp: float) -> bytes:
    """Encode the lens of a camera without distortion."""
    fx, fy, cx, cy = camera.fx, camera.fy, camera.cx - PIXEL_CENTER, camera.cy - PIXEL_CENTER
    matrix = float64((fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0))
    projection = float64((fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0))
    whole = STORE.types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
    lens = ("plumb_bob", np.zeros(5), matrix, np.eye(3).ravel(), projection)
    return encode(CAMERA_INFO, header(stamp, OPTICAL_FRAME), camera.height, camera.width, *lens, 0, 0, whole)


def delivered(info: Any, matrix: np.ndarray) -> tuple[int, int, Float[np.ndarray, "3 3"]]:
    """Return width and height of the images of a CameraInfo, and a lens matrix of the whole sensor in theirs.

    Images are cut to the region of interest, then binned. Source: `sensor_msgs/msg/CameraInfo`.
    """
    region, binning = info.roi, np.maximum((info.binning_x, info.binning_y), 1)
    size = np.array((region.width or info.width, region.height or info.height)) // binning
    matrix = matrix.reshape(3, -1)[:, :3].astype(np.float64)
    matrix[:2, 2] += PIXEL_CENTER - np.array((region.x_offset, region.y_offset))
    matrix[:2] /= binning[:, None]
    return int(size[0]), int(size[1]), matrix


def lens_fault(info: Any, matrix: np.ndarray) -> str:
    """Return what is impossible in a CameraInfo with this lens matrix of the whole sensor, or nothing."""
    (fx, skew, cx), (_, fy, cy), last = matrix.reshape(3, -1)[:, :3].tolist()
    region, width, height = info.roi, info.width, info.height
    if not (np.isfinite(matrix).all() and min(fx, fy) > 0.0 and min(width, height) > 0):
        return "no focal length or image size; the camera is not calibrated yet."
    if skew or last != [0.0, 0.0, 1.0]:
        return f"a lens matrix with the skew {skew:g} and the last row {last}, which no camera here has."
    right, bottom = region.x_offset + region.width, region.y_offset + region.height
    least = min(region.x_offset, region.y_offset, region.width, region.height, info.binning_x, info.binning_y)
    if least < 0 or right > width or bottom > height:
        return f"its region of interest is not within its image of {width} x {height} px."
    is_near = 0.0 <= cx <= width and 0.0 <= cy <= height
    if not (is_near and all(0.1 < each / width < 100.0 for each in (fx, fy))):  # 157 to 0.6° wide
        place = f"a focal length of {fx:g} x {fy:g} px and an optical axis at ({cx:g}, {cy:g}) px"
        return f"{place} are not of images of {width} x {height} px."
    return ""


def read_camera_info(data: bytes) -> CameraSpec:
    """Decode size and lens of a camera in its own frame, without distortion; refuse one that has no lens."""
    message = decode(data, CAMERA_INFO)
    if fault := lens_fault(message, message.k):
        raise DeploymentError(f"the camera's CameraInfo: {fault} Calibrate it (camera_calibration).")
    width, height, ((fx, _, cx), (_, fy, cy), _) = delivered(message, message.k)
    lens = {"fx": float(fx), "fy": float(fy), "cx": float(cx), "cy": float(cy)}
    return CameraSpec(width=width, height=height, **lens, pos=(0.0, 0.0, 0.0), quat=IDENTITY)


Value = TypeVar("Value", bool, int, float, str)


def _single(
    kind: str, value: type[Value], field: str = "data"
) -> tuple[Callable[[Value], bytes], Callable[[bytes], Value]]:
    """Return functions that encode and decode messages of one value; decoding raises as `decode` does."""
    return partial(encode, kind), lambda data: value(getattr(decode(data, kind), field))


boolean, read_boolean = _single(BOOLEAN, bool)
number, read_number = _single(NUMBER, float)
text, read_text = _single(TEXT, str)
safety_mode, read_safety_mode = _single(SAFETY_MODE, int, "mode")
robot_mode, read_robot_mode = _single(ROBOT_MODE, int, "mode")

MOST_TEXT = 65_536  #: Longest JSON text that is read [characters]; ours have some hundreds. Source: ours.


def _printable(value: Any) -> Any:
    """Return a value of JSON without control characters in its texts: terminals and pages show them."""
    match value:
        case str():
            return printable(value, kept="")
        case list():
            return [_printable(each) for each in value]
        case dict():
            return {_printable(name): _printable(each) for name, each in value.items()}
    return value


def read_json(data: bytes) -> dict[str, Any]:
    """Decode a text that is a JSON object; raise DeploymentError for any other, too long or too deep one."""
    written = read_text(data)
    if len(written) > MOST_TEXT:
        raise DeploymentError(f"a text has {len(written)} characters; at most {MOST_TEXT} are read.")
    try:
        return _printable(json_object(written))
    except InvalidValueError as error:
        fix = "check the program that publishes it"
        raise DeploymentError(f"a text is no JSON object ({error}): {fix}.") from error


def activity(states: Mapping[str, int], stamp: float) -> bytes:
    """Encode the states of controllers by name, such as `ACTIVE`."""
    state, named = STORE.types["lifecycle_msgs/msg/State"], STORE.types[_CONTROLLER]
    controllers = [named(name, state(number, "")) for name, number in states.items()]
    return encode(ACTIVITY, header(stamp), controllers, [])


def read_active_controllers(data: bytes) -> frozenset[str]:
    """Decode the names of the active controllers; raises as `decode` does."""
    return frozenset(each.name for each in decode(data, ACTIVITY).controllers if each.state.id == ACTIVE)


LARGEST_JPEG = 65_500  #: Largest width and height of a JPEG [px]. Source: libjpeg.
MOST_PIXELS = 2**25  #: Of an image that is unpacked; 50 times what the policies look at. Source: ours.
FORMAT = "rgb8; jpeg compressed bgr8"  #: Format of compressed images. Source: image_transport.
SUFFIX = "/compressed"  #: Suffix of the topic of compressed images. Source: image_transport.


def compressed_topic(topic: Topic) -> Topic:
    """Return the topic of the compressed images of a topic."""
    return replace(topic, name=topic.name + SUFFIX, type=COMPRESSED_IMAGE)


def compress(data: bytes) -> bytes:
    """Convert an image message to a JPEG message; raises as `read_image` does, and for too large an image."""
    import cv2

    reading = read_image(data)
    if max(reading.pixels.shape) > LARGEST_JPEG:
        size = f"an image of shape {reading.pixels.shape} is too large for a JPEG"
        raise DeploymentError(f"{size}; {LARGEST_JPEG} is the most.")
    _, jpeg = cv2.imencode(".jpg", cv2.cvtColor(reading.pixels, cv2.COLOR_RGB2BGR))
    return encode(COMPRESSED_IMAGE, header(reading.stamp, OPTICAL_FRAME), FORMAT, jpeg)


def unpacked_image(data: bytes) -> Pixels | None:
    """Decode a JPEG, PNG, BMP or TIFF of 8 bits; return None if it is damaged or exceeds `MOST_PIXELS`."""
    from PIL import Image, ImageOps

    try:
        with Image.open(BytesIO(data), formats=("JPEG", "PNG", "BMP", "TIFF")) as file:
            is_read = file.width * file.height <= MOST_PIXELS and file.mode[0] not in "IF"  # of 16 or 32 bits
            return np.asarray(ImageOps.exif_transpose(file).convert("RGB")) if is_read else None
    except Exception:  # each format has errors of its own
        return None


def uncompress(data: bytes) -> bytes:
    """Convert a JPEG message to an image message; raises as `decode`, and where the JPEG is damaged."""
    message = decode(data, COMPRESSED_IMAGE)
    if (pixels := unpacked_image(bytes(message.data))) is None:
        raise DeploymentError("a compressed image cannot be read: it is damaged.")
    return image(pixels, seconds(message.header))
