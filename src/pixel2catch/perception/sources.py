"""Where images come from, a video, a ROS 2 bag or a camera, and how they are scaled to the policies' size.

All sources give ticks of the control clock. A recording is played on the clock of its stamps. Of a camera
only the newest image is kept, and a camera that stalls does not block the caller.
"""

import threading
import time
from collections.abc import Generator, Iterable, Iterator
from dataclasses import dataclass, replace
from math import ceil
from pathlib import Path

import av
import cv2
import numpy as np
from av.error import FFmpegError
from jaxtyping import UInt8

from pixel2catch.camera.image import Edges, Image, Pixels
from pixel2catch.errors import PerceptionError
from pixel2catch.perception.bag_images import bag_images
from pixel2catch.ros2.bags import BAG_SUFFIXES
from pixel2catch.ros2.messages import MOST_PIXELS
from pixel2catch.scene.constants import CONTROL_DT, RGB_CAMERA

PHASE = 0.5
"""Control steps from the first image to the first tick. Source: ours; with half a step, the jitter of a
camera of 30 Hz makes no tick miss its image."""

LONGEST_PAUSE = 150  #: Most ticks without a new image for a pause in a recording: 5 s. Source: ours.

FIRST_IMAGE_TIMEOUT = 5.0
"""Time in which a camera must give its first image [s]. Source: ours; webcams need up to two."""

LONGEST_STALL = 10.0  #: Time without a new image after which a camera counts as unplugged [s]. Source: ours.

RETRY, POLL = 0.01, 0.002
"""Time between attempts to read a camera without an image, and between checks for a new image [s]."""

DEVICES = Path("/dev")

OPTIONS = {
    "format_whitelist": "mov,mp4,m4a,3gp,3g2,mj2,matroska,webm,avi,mpeg,mpegts,ogg,gif",
    "protocol_whitelist": "file",
    "max_pixels": str(MOST_PIXELS),
}
"""Options of FFmpeg: formats, none of which refers to other files, and the largest number of pixels."""

Size = tuple[int, int]  #: Width and height [px].


@dataclass(frozen=True, kw_only=True)
class ImageFit:
    """Scales images of one size to another, equally along both axes, with a black frame."""

    own: Size  #: Of the images as they are.
    size: Size = (RGB_CAMERA.width, RGB_CAMERA.height)  #: Of the scaled images with their frame.

    @property
    def changes(self) -> bool:
        """Whether the two sizes differ."""
        return self.own != self.size

    @property
    def _inner(self) -> Size:
        """Size of the scaled image in the frame."""
        scale = min(self.size[0] / self.own[0], self.size[1] / self.own[1])
        return round(scale * self.own[0]), round(scale * self.own[1])

    @property
    def _corner(self) -> Size:
        """Column and row of the first pixel of the scaled image in the frame."""
        return (self.size[0] - self._inner[0]) // 2, (self.size[1] - self._inner[1]) // 2

    def image(self, image: Pixels) -> UInt8[np.ndarray, "rows columns 3"]:
        """Return the scaled image; an image of an unexpected size is returned as it is."""
        if not self.changes or (image.shape[1], image.shape[0]) != self.own:
            return image
        (left, top), (width, height) = self._corner, self._inner
        method = cv2.INTER_AREA if width < self.own[0] else cv2.INTER_LINEAR
        inner = cv2.resize(image, self._inner, interpolation=method)
        right, bottom = self.size[0] - left - width, self.size[1] - top - height
        return cv2.copyMakeBorder(inner, top, bottom, left, right, cv2.BORDER_CONSTANT)

    def box(self, box: Edges) -> Edges:
        """Return a box of an image in the scaled image."""
        (left, top), (width, height) = self._corner, self._inner
        fx, fy = width / self.own[0], height / self.own[1]
        xmin, ymin, xmax, ymax = box
        return fx * xmin + left, fy * ymin + top, fx * xmax + left, fy * ymax + top


@dataclass(frozen=True, kw_only=True)
class Tick:
    """One control step: the newest image, which may be that of the step before."""

    image: Image
    now: float  #: The time, by the clock of the stamps [s].


@dataclass(frozen=True, kw_only=True)
class SourceCfg:
    """Where to find images."""

    name: str  #: A video file; the folder, .mcap or .db3 file of a bag; or the number or device of a camera.
    topic: str | None = None  #: The topic of a bag's images; None for the only one.
    joints: tuple[str, ...] = ()  #: Names in the bag's joint states, in joint order; empty to read none.


def ticks_of(cfg: SourceCfg, notes: list[str], fit: ImageFit | None = None) -> Generator[Tick, None, None]:
    """Yield the newest image of every control step; the images of a recording may be scaled.

    Problems that do not end the stream are added to the notes.

    Raises:
        PerceptionError: There is no such source, or it has no image.
    """
    if is_camera(cfg.name):
        return live_ticks(open_camera(cfg.name), notes)
    images = file_images(cfg, notes)
    if fit is not None:
        images = (replace(image, pixels=fit.image(image.pixels)) for image in images)
    return on_control_clock(images, notes)


def file_images(cfg: SourceCfg, notes: list[str]) -> Iterator[Image]:
    """Yield the images of a recording.

    Raises:
        PerceptionError: As `ticks_of`.
    """
    path = Path(cfg.name)
    if not (path.is_file() or path.is_dir()):
        raise PerceptionError(
            f"there is no file '{path}'; a source is a video file, a rosbag2, or a camera: its number or "
            "/dev/videoN."
        )
    if path.suffix in BAG_SUFFIXES or path.is_dir():
        return bag_images(path, cfg.topic, cfg.joints, notes)
    return video_images(path, notes)


def image_size(cfg: SourceCfg) -> Size | None:
    """Return width and height of the first image of a recording [px]; None for a camera.

    Raises:
        PerceptionError: As `ticks_of`, or there is no image.
    """
    if is_camera(cfg.name):
        return None
    first = next(iter(file_images(cfg, [])), None)
    if first is None:
        raise PerceptionError(f"{cfg.name} has no images.")
    return first.pixels.shape[1], first.pixels.shape[0]


def on_control_clock(images: Iterable[Image], notes: list[str]) -> Generator[Tick, None, None]:
    """Yield a tick in every control step of a recording, with its newest image.

    The images come in the order of the recording. Problems with their stamps are added to the notes.
    """
    newest, num_older, start = None, 0, 0.0
    tick = 0
    for image in images:
        if newest is not None and not image.stamp > newest.stamp:
            num_older += 1
            continue
        start = image.stamp if newest is None else start
        due = max(int((image.stamp - start) / CONTROL_DT + 1.0 - PHASE), 0)
        if due - tick > LONGEST_PAUSE:
            pause, played = (steps * CONTROL_DT for steps in (due - tick, tick))
            notes.append(f"{pause:.1f} s without an image after {played:.1f} s.")
            tick = due - LONGEST_PAUSE
        while newest is not None and tick < due:
            yield Tick(image=newest, now=start + (tick + PHASE) * CONTROL_DT)
            tick += 1
        newest = image
    if newest is not None:
        yield Tick(image=newest, now=start + (tick + PHASE) * CONTROL_DT)
    if num_older:
        notes.append(f"images no newer than those before them, passed over: {num_older}.")


def video_images(path: Path, notes: list[str]) -> Iterator[Image]:
    """Yield the images of a video file with their stamps, rotated as a player shows them.

    A damaged file ends at the damage, with a note.

    Raises:
        PerceptionError: It is no video, or its first image cannot be read.
    """
    num_images, stamp = 0, 0.0
    try:
        with av.open(str(path), options=OPTIONS, metadata_errors="replace") as container:
            if not container.streams.video:
                raise PerceptionError(f"{path} has no video stream; give a video file.")
            period = 1.0 / float(container.streams.video[0].average_rate or 30)
            for frame in container.decode(video=0):
                stamp = float(frame.time) if frame.time is not None else stamp + period
                turned = np.rot90(frame.to_ndarray(format="rgb24"), round(frame.rotation / 90))
                yield Image(pixels=np.ascontiguousarray(turned), stamp=stamp)
                num_images += 1
    except (FFmpegError, ValueError, OverflowError) as error:
        reason = getattr(error, "strerror", error)
        if not num_images:
            raise PerceptionError(f"{path} cannot be read as a video: {reason}.") from error
        notes.append(f"the video is damaged after {num_images} images: {reason}.")


def is_camera(source: str) -> bool:
    """Return whether this names a camera: a number, or a video device such as /dev/video0."""
    return source.isdecimal() or source.startswith(f"{DEVICES}/video")


def open_camera(source: str) -> cv2.VideoCapture:
    """Open a camera by its number or device, and set the policies' image size and 30 images a second.

    Raises:
        PerceptionError: There is no such camera, or another program uses it.
    """
    level = cv2.utils.logging.getLogLevel()  # the error below replaces what OpenCV would print
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        capture = cv2.VideoCapture(int(source) if source.isdecimal() else source, cv2.CAP_V4L2)
    finally:
        cv2.utils.logging.setLogLevel(level)
    if not capture.isOpened():
        found = ", ".join(sorted(str(path) for path in DEVICES.glob("video*"))) or "none"
        raise PerceptionError(
            f"the camera '{source}' cannot be opened; video devices here: {found}. Plug it in, close other "
            "programs that use it, and be a member of the group 'video'."
        )
    capture.set(cv2.CAP_PROP_FRAME_WIDTH, RGB_CAMERA.width)
    capture.set(cv2.CAP_PROP_FRAME_HEIGHT, RGB_CAMERA.height)
    capture.set(cv2.CAP_PROP_FPS, round(1.0 / CONTROL_DT))
    capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)
    return capture


class CameraReader:
    """Reads a camera in a thread and keeps the newest image; use it as a context manager.

    The stamp of an image is its arrival, by `time.monotonic`. The camera is closed at the end.
    """

    def __init__(self, capture: cv2.VideoCapture) -> None:
        """Start to read."""
        self._capture = capture
        self._newest: Image | None = None
        self._has_image, self._is_over = threading.Event(), threading.Event()
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()

    def first(self) -> Image:
        """Wait for the first image.

        Raises:
            PerceptionError: None comes.
        """
        if not self._has_image.wait(FIRST_IMAGE_TIMEOUT):
            raise PerceptionError(
                f"the camera is open but gave no image in {FIRST_IMAGE_TIMEOUT:g} s: plug it in again, "
                "or try another USB port."
            )
        return self.newest()

    def newest(self) -> Image:
        """Return the newest image; call `first` before."""
        assert self._newest is not None
        return self._newest

    def __enter__(self) -> "CameraReader":
        """Return the reader itself."""
        return self

    def __exit__(self, *exception: object) -> None:
        """Stop reading; the thread closes the camera, even if it must wait for the last image."""
        self._is_over.set()
        self._thread.join(timeout=1.0)

    def _read(self) -> None:
        while not self._is_over.is_set():
            is_read, image = self._capture.read()
            if not is_read:
                self._is_over.wait(RETRY)
                continue
            stamp = time.monotonic()
            self._newest = Image(pixels=cv2.cvtColor(image, cv2.COLOR_BGR2RGB), stamp=stamp)
            self._has_image.set()
        self._capture.release()


def live_ticks(
    capture: cv2.VideoCapture, notes: list[str], longest_stall: float = LONGEST_STALL
) -> Generator[Tick, None, None]:
    """Yield a tick in every control step of an open camera, and close it at the end.

    A control step that the caller misses is left out. The stream ends, with a note, after the longest stall
    without a new image [s].

    Raises:
        PerceptionError: No first image comes.
    """
    with CameraReader(capture) as reader:
        start, step = reader.first().stamp, 0
        while True:
            image, now = reader.newest(), time.monotonic()
            if now - image.stamp > longest_stall:
                notes.append(f"the camera gave no image for {longest_stall:g} s: ended. Is it unplugged?")
                return
            yield Tick(image=image, now=now)
            step = max(step + 1, ceil((time.monotonic() - start) / CONTROL_DT))
            time.sleep(max(start + step * CONTROL_DT - time.monotonic(), 0.0))
