"""A live camera on the control clock: one image waits, the newest, and a camera that stalls blocks nobody."""

import threading
import time
from collections.abc import Generator
from dataclasses import dataclass
from itertools import pairwise
from math import ceil
from pathlib import Path

import cv2

from pixel2catch.errors import PerceptionError
from pixel2catch.perception.finder import CameraFrame
from pixel2catch.perception.ticks import Tick
from pixel2catch.robot.constants import CONTROL_DT, RGB_CAMERA, CameraSpec

FIRST_IMAGE_TIMEOUT = 5.0
"""Time in which a camera must give its first image [s]. Source: ours; webcams need up to two."""

LONGEST_STALL = 10.0
"""Time without a new image after which a camera is taken to be gone [s]. Source: ours."""

RETRY = 0.01
"""Time between two attempts to read a camera that gives nothing [s]."""

POLL = 0.002
"""Time between two looks for a new image [s]."""

DEVICES = Path("/dev")


def is_camera(source: str) -> bool:
    """Return whether this names a camera: a number, or a video device such as /dev/video0."""
    return source.isdecimal() or source.startswith(f"{DEVICES}/video")


def open_camera(source: str, camera: CameraSpec = RGB_CAMERA) -> cv2.VideoCapture:
    """Open a camera and ask it for our size of image and 30 images a second.

    Args:
        source: Its number or device.
        camera: The camera that the policies know, for the size of the image.

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

    The stamp of an image is the time of its arrival, of `time.monotonic`.

    Args:
        capture: The open camera; it is closed at the end.
    """

    def __init__(self, capture: cv2.VideoCapture) -> None:
        """Begin to read."""
        self._capture = capture
        self._newest: CameraFrame | None = None
        self._has_image, self._is_over = threading.Event(), threading.Event()
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()

    def first(self) -> CameraFrame:
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

    def newest(self) -> CameraFrame:
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
        """Keep the newest image until it is over."""
        while not self._is_over.is_set():
            is_read, image = self._capture.read()
            if not is_read:
                self._is_over.wait(RETRY)
                continue
            stamp = time.monotonic()
            self._newest = CameraFrame(image=cv2.cvtColor(image, cv2.COLOR_BGR2RGB), stamp=stamp)
            self._has_image.set()
        self._capture.release()


@dataclass(frozen=True, kw_only=True)
class CameraReport:
    """What a camera delivers.

    Attributes:
        width: Of its images [px].
        height: Of its images [px].
        rate: Images a second.
        pause: Longest time without a new image [s].
    """

    width: int
    height: int
    rate: float
    pause: float


def measure_camera(capture: cv2.VideoCapture, seconds: float) -> CameraReport:
    """Watch a camera.

    Args:
        capture: The open camera; it is closed at the end.
        seconds: For how long, after the first image [s].

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
        height, width = reader.newest().image.shape[:2]
    pauses = [after - before for before, after in pairwise([*stamps, max(end, stamps[-1])])]
    return CameraReport(width=width, height=height, rate=(len(stamps) - 1) / seconds, pause=max(pauses))


def live_ticks(
    capture: cv2.VideoCapture, notes: list[str], longest_stall: float = LONGEST_STALL
) -> Generator[Tick, None, None]:
    """Yield a tick in every control step, until the camera is gone; a step that is late is left out.

    Args:
        capture: The open camera; it is closed at the end.
        notes: Gets why it ended.
        longest_stall: Time without a new image after which the camera is taken to be gone [s].

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
            yield Tick(frame=frame, now=now)
            step = max(step + 1, ceil((time.monotonic() - start) / CONTROL_DT))
            time.sleep(max(start + step * CONTROL_DT - time.monotonic(), 0.0))
