"""Where images come from: a video, a bag of ROS 2 or a camera, all as ticks of the control clock.

A recording is played on the clock of its stamps. Of a live camera one image waits, the newest, and one that
stalls blocks nobody.
"""

import threading
import time
from collections.abc import Generator, Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from math import ceil
from pathlib import Path

import av
import cv2
import numpy as np
from av.error import FFmpegError

from pixel2catch.camera.image import Image
from pixel2catch.errors import PerceptionError
from pixel2catch.perception.image_fit import ImageFit, Size
from pixel2catch.perception.rosbag_images import bag_frames
from pixel2catch.ros2.bags import BAG_SUFFIXES
from pixel2catch.ros2.messages import MOST_PIXELS
from pixel2catch.scene.constants import CONTROL_DT, RGB_CAMERA, CameraSpec

PHASE = 0.5
"""Control steps from the first image to the first tick. Source: ours; half a step, so that no jitter of a
camera of 30 Hz makes a tick miss its image."""

LONGEST_PAUSE = 150
"""Ticks without a new image that a pause in a recording makes at most: 5 s. Source: ours."""

FIRST_IMAGE_TIMEOUT = 5.0
"""Time in which a camera must give its first image [s]. Source: ours; webcams need up to two."""

LONGEST_STALL = 10.0  #: Time without a new image after which a camera is taken to be gone [s]. Source: ours.

RETRY, POLL = 0.01, 0.002
"""Time between attempts to read a camera that gives nothing, and between looks for a new image [s]."""

DEVICES = Path("/dev")

OPTIONS = {
    "format_whitelist": "mov,mp4,m4a,3gp,3g2,mj2,matroska,webm,avi,mpeg,mpegts,ogg,gif",
    "protocol_whitelist": "file",
    "max_pixels": str(MOST_PIXELS),
}
"""Of FFmpeg: kinds of video, none of which names other files, and pixels of an image."""


@dataclass(frozen=True, kw_only=True)
class Tick:
    """One control step: the newest image, be it the same as before, and the time by the stamps' clock [s]."""

    image: Image
    now: float


@dataclass(frozen=True, kw_only=True)
class SourceCfg:
    """Where to find images."""

    name: str  #: A video file; the folder, .mcap or .db3 file of a bag; or the number or device of a camera.
    topic: str | None = None  #: The topic of a bag's images; None for the only one.
    joint_states: str = "/joint_states"  #: The topic of a bag's joint states.
    joints: tuple[str, ...] = ()  #: Of the robot, in joint order; none if they are not asked for.


def ticks_of(cfg: SourceCfg, notes: list[str], fit: ImageFit | None = None) -> Generator[Tick, None, None]:
    """Yield what a controller would get in every control step; notes get what is wrong but no reason to end.

    The images of a recording may be made to fit another size; a camera is asked for the right one.

    Raises:
        PerceptionError: If there is no such source, or no image in it; the message says what to do.
    """
    if is_camera(cfg.name):
        return live_ticks(open_camera(cfg.name), notes)
    frames = file_frames(cfg, notes)
    if fit is not None:
        frames = (replace(frame, pixels=fit.image(frame.pixels)) for frame in frames)
    return on_control_clock(frames, notes)


def file_frames(cfg: SourceCfg, notes: list[str]) -> Iterator[Image]:
    """Yield the images of a recording, each once.

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
        return bag_frames(path, cfg.topic, cfg.joint_states, cfg.joints, notes)
    return video_frames(path, notes)


def image_size(cfg: SourceCfg) -> Size | None:
    """Return width and height of the first image of a recording [px]; None of a camera.

    Raises:
        PerceptionError: As `ticks_of`, or there is no image.
    """
    if is_camera(cfg.name):
        return None
    first = next(iter(file_frames(cfg, [])), None)
    if first is None:
        raise PerceptionError(f"{cfg.name} has no images.")
    return first.pixels.shape[1], first.pixels.shape[0]


def on_control_clock(frames: Iterable[Image], notes: list[str]) -> Generator[Tick, None, None]:
    """Yield a tick in every control step of a recording; of several new images it has the newest.

    The frames come in the order of the recording; notes get what is wrong with their stamps.
    """
    newest, num_older, start = None, 0, 0.0
    tick = 0
    for frame in frames:
        if newest is not None and not frame.stamp > newest.stamp:
            num_older += 1
            continue
        start = frame.stamp if newest is None else start
        due = max(int((frame.stamp - start) / CONTROL_DT + 1.0 - PHASE), 0)
        if due - tick > LONGEST_PAUSE:
            pause, played = (steps * CONTROL_DT for steps in (due - tick, tick))
            notes.append(f"{pause:.1f} s without an image after {played:.1f} s.")
            tick = due - LONGEST_PAUSE
        while newest is not None and tick < due:
            yield Tick(image=newest, now=start + (tick + PHASE) * CONTROL_DT)
            tick += 1
        newest = frame
    if newest is not None:
        yield Tick(image=newest, now=start + (tick + PHASE) * CONTROL_DT)
    if num_older:
        notes.append(f"images no newer than those before them, passed over: {num_older}.")


def video_frames(path: Path, notes: list[str]) -> Iterator[Image]:
    """Yield the images of a video file with their own stamps; a damaged file ends where notes get to know.

    They are upright as a player shows them, such as those of a telephone that was held upright.

    Raises:
        PerceptionError: If this is no video, or none of its images can be read.
    """
    num_frames, stamp = 0, 0.0
    try:
        with av.open(str(path), options=OPTIONS, metadata_errors="replace") as container:
            if not container.streams.video:
                raise PerceptionError(f"{path} has no video stream; give a video file.")
            period = 1.0 / float(container.streams.video[0].average_rate or 30)
            for frame in container.decode(video=0):
                stamp = float(frame.time) if frame.time is not None else stamp + period
                turned = np.rot90(frame.to_ndarray(format="rgb24"), round(frame.rotation / 90))
                yield Image(pixels=np.ascontiguousarray(turned), stamp=stamp)
                num_frames += 1
    except (FFmpegError, ValueError, OverflowError) as error:
        reason = getattr(error, "strerror", error)
        if not num_frames:
            raise PerceptionError(f"{path} cannot be read as a video: {reason}.") from error
        notes.append(f"the video is damaged after {num_frames} images: {reason}.")


def is_camera(source: str) -> bool:
    """Return whether this names a camera: a number, or a video device such as /dev/video0."""
    return source.isdecimal() or source.startswith(f"{DEVICES}/video")


def open_camera(source: str, camera: CameraSpec = RGB_CAMERA) -> cv2.VideoCapture:
    """Open a camera, by its number or device, and ask it for the policies' size of image and 30 a second.

    Raises:
        PerceptionError: If there is no such camera, or another program has it.
    """
    level = cv2.utils.logging.getLogLevel()  # the error below says what OpenCV would print
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
    capture.set(cv2.CAP_PROP_FRAME_WIDTH, camera.width)
    capture.set(cv2.CAP_PROP_FRAME_HEIGHT, camera.height)
    capture.set(cv2.CAP_PROP_FPS, round(1.0 / CONTROL_DT))
    capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)
    return capture


class CameraReader:
    """Reads a camera in a thread of its own and keeps the newest image; use it as a context manager.

    The stamp of an image is the time of its arrival, of `time.monotonic`. The camera is closed at the end.
    """

    def __init__(self, capture: cv2.VideoCapture) -> None:
        """Begin to read."""
        self._capture = capture
        self._newest: Image | None = None
        self._has_image, self._is_over = threading.Event(), threading.Event()
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()

    def first(self) -> Image:
        """Wait for the first image.

        Raises:
            PerceptionError: If none comes.
        """
        if not self._has_image.wait(FIRST_IMAGE_TIMEOUT):
            raise PerceptionError(
                f"the camera is open but gave no image in {FIRST_IMAGE_TIMEOUT:g} s: plug it in again, "
                "or try another USB port."
            )
        return self.newest()

    def newest(self) -> Image:
        """Return the newest image; there is one."""
        assert self._newest is not None
        return self._newest

    def __enter__(self) -> "CameraReader":
        """Return the reader itself."""
        return self

    def __exit__(self, *exception: object) -> None:
        """Stop reading; the thread closes the camera, even if that must wait for it."""
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
    """Yield a tick in every control step, until the camera is gone; a step that is late is left out.

    The open camera is closed at the end. It is taken to be gone after the longest stall without a new image
    [s]; notes get why it ended.

    Raises:
        PerceptionError: If no first image comes.
    """
    with CameraReader(capture) as reader:
        start, step = reader.first().stamp, 0
        while True:
            frame, now = reader.newest(), time.monotonic()
            if now - frame.stamp > longest_stall:
                notes.append(f"the camera gave no image for {longest_stall:g} s: ended. Is it unplugged?")
                return
            yield Tick(image=frame, now=now)
            step = max(step + 1, ceil((time.monotonic() - start) / CONTROL_DT))
            time.sleep(max(start + step * CONTROL_DT - time.monotonic(), 0.0))


@dataclass(frozen=True, kw_only=True)
class CameraReport:
    """What a camera delivers: images of a size [px], so many a second, with a longest pause [s]."""

    width: int
    height: int
    rate: float
    pause: float


def measure_camera(capture: cv2.VideoCapture, seconds: float) -> CameraReport:
    """Watch an open camera, which is closed at the end, for a time after its first image [s].

    Raises:
        PerceptionError: If no first image comes.
    """
    with CameraReader(capture) as reader:
        stamps = [reader.first().stamp]
        end = stamps[0] + seconds
        while time.monotonic() < end:
            time.sleep(POLL)
            stamp = reader.newest().stamp
            if stamp > stamps[-1]:
                stamps.append(stamp)
        height, width = reader.newest().pixels.shape[:2]
    pauses = [after - before for before, after in pairwise([*stamps, max(end, stamps[-1])])]
    return CameraReport(width=width, height=height, rate=(len(stamps) - 1) / seconds, pause=max(pauses))
