"""Take the images of a calibration: each with the board found, still, sharp and unlike the images before."""

import csv
import io
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import final

import cv2
import numpy as np
from jaxtyping import Float

from pixel2catch.camera.image import Image, Pixels
from pixel2catch.errors import DeploymentError
from pixel2catch.files import write_atomically
from pixel2catch.perception.calibration.lens import BoardView, CharucoBoard
from pixel2catch.ros2 import messages
from pixel2catch.ros2.profile import Profile
from pixel2catch.ros2.transport import Transport

TABLE = "views.csv"  #: File beside the images.
NUM_VIEWS = 15  #: Images to take. Source: ours; then the camera's position is known to a few millimetres.

STILL_TIME = 0.3  #: Time for which board and arm must be still [s]. Source: ours.
STILL_PIXELS, STILL_JOINTS = 0.7, 1e-3
"""Largest motion from image to image that counts as still: of corners [px], of joints [rad]. Source: ours;
corners are found within a few tenths of a pixel."""

LARGEST_BLUR = 1.25
"""Largest standard deviation of an edge's spread in a sharp image [px]. Source: ours; sharp images have 0.6
to 1, and from 1.5 on a far board is not found."""

LEAST_CHANGE = 15.0
"""Smallest motion of a corner from every image that was taken to a new one [px]. Source: ours."""

WAIT = 0.2  #: Longest wait for an image [s]. Source: ours.


@dataclass(frozen=True, kw_only=True, eq=False)
class Taken:
    """A view that was taken."""

    name: str  #: Name of its image.
    view: BoardView  #: The corners.
    joint_pos: Float[np.ndarray, " num_joints"]  #: Positions of the arm's joints [rad].


def blur(image: Pixels, view: BoardView) -> float:
    """Return the standard deviation of the spread of the edges about the corners of a board [px].

    An edge of contrast c that is spread by a Gaussian of deviation σ has the gradient c / (√(2π) σ).
    """
    gray = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32)
    low, high = np.floor(view.pixels.min(axis=0)).astype(int), np.ceil(view.pixels.max(axis=0)).astype(int)
    part = gray[max(low[1], 0) : high[1] + 1, max(low[0], 0) : high[0] + 1]
    dx, dy = np.gradient(cv2.GaussianBlur(part, (0, 0), 0.5))
    steepest = float(np.quantile(np.hypot(dx, dy), 0.98))
    contrast = float(np.ptp(np.quantile(part, (0.05, 0.95))))
    return contrast / (np.sqrt(2.0 * np.pi) * max(steepest, 1e-6))


@final
class Capture:
    """Judges one image after another, and writes the suitable ones and their table at once."""

    def __init__(self, folder: Path, board: CharucoBoard, joints: Sequence[str]) -> None:
        """Start without images."""
        self.taken: list[Taken] = []
        self._folder, self._board, self._joints = folder, board, joints
        self._before: tuple[Image, BoardView] | None = None
        self._still_since = -np.inf
        folder.mkdir(parents=True, exist_ok=True)

    @property
    def is_done(self) -> bool:
        """Whether there are enough views."""
        return len(self.taken) >= NUM_VIEWS

    def look(self, image: Image) -> str:
        """Take an image if it is suitable; return what was done, or what is wrong with it."""
        view = self._board.find(image.pixels)
        is_still = self._is_still(image, view)
        if view is None:
            return "no board: show all of it, in the light"
        if image.joint_pos is None:
            return "no positions of the arm's joints yet: is its driver running?"
        if not is_still:
            return "hold still"
        if (spread := blur(image.pixels, view)) > LARGEST_BLUR:
            return f"blurred ({spread:.1f} px): hold still, focus, expose for a shorter time"
        if twin := next((each for each in self.taken if _is_alike(each.view, view)), None):
            return f"like {twin.name}: move or tilt the board"
        name = f"pose{len(self.taken) + 1:02d}.png"
        self._take(image.pixels, Taken(name=name, view=view, joint_pos=image.joint_pos))
        return f"{len(self.taken)} of {NUM_VIEWS}: wrote {name}"

    def _is_still(self, image: Image, view: BoardView | None) -> bool:
        """Whether board and arm have been still for `STILL_TIME`."""
        before, self._before = self._before, (image, view) if view else None
        if before is None or view is None or len(before[1].pixels) != len(view.pixels):
            self._still_since = image.stamp
            return False
        last, seen = before
        is_moving = np.abs(view.pixels - seen.pixels).max() > STILL_PIXELS
        if image.joint_pos is not None and last.joint_pos is not None:
            is_moving |= np.abs(image.joint_pos - last.joint_pos).max() > STILL_JOINTS
        if is_moving:
            self._still_since = image.stamp
        return image.stamp - self._still_since >= STILL_TIME

    def _take(self, pixels: Pixels, view: Taken) -> None:
        """Write the image, then the table."""
        content = cv2.imencode(".png", cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR))[1].tobytes()
        write_atomically({self._folder / view.name: content})
        self.taken.append(view)
        text = io.StringIO()
        rows = [[each.name, *map(repr, each.joint_pos.tolist())] for each in self.taken]
        csv.writer(text).writerows([["image", *self._joints], *rows])
        write_atomically({self._folder / TABLE: text.getvalue().encode()})


def _is_alike(view: BoardView, other: BoardView) -> bool:
    if len(view.pixels) != len(other.pixels):
        return False
    return bool(np.linalg.norm(view.pixels - other.pixels, axis=-1).max() < LEAST_CHANGE)


def topic_images(transport: Transport, profile: Profile, joints: Sequence[str]) -> Iterator[Image | None]:
    """Yield the newest images of a robot's camera as they arrive, or None after `WAIT` without one.

    Each has the newest positions of some joints, once all of them have been received.
    """
    parts = [part for part in profile.robots if {*part.joints} & {*joints}]
    states = [(part, transport.subscription(part.state_topic, 64)) for part in parts]
    images = transport.subscription(profile.camera.image, 1)
    order = list(profile.robots[0].joint_order)
    columns = [order.index(joint) for joint in joints]
    joint_pos = np.full(len(order), np.nan)
    while True:
        transport.wait(WAIT)
        for part, subscription in states:
            for message in subscription.take():
                part.merge(messages.read_joint_state(message.data), joint_pos)
        newest = images.take()[-1:]
        known = joint_pos[columns].copy() if np.isfinite(joint_pos[columns]).all() else None
        for message in newest:
            image = messages.read_image(message.data)
            if wrong := profile.camera.wrong_format(image):
                raise DeploymentError(wrong)
            yield Image(pixels=image.pixels, stamp=image.stamp, joint_pos=known)
        if not newest:
            yield None
