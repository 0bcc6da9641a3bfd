"""Taking the images of a calibration: which are suitable, and what to show the camera next.

An image is taken when the board is found, still, sharp and unlike the images before. Texts ask for the
missing tilts, parts of the image, distances and turns of the hand.
"""

import csv
import io
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import final

import cv2
import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from pixel2catch.camera.image import Image, Pixels
from pixel2catch.files import write_atomically
from pixel2catch.perception.calibration.target import BoardView, CharucoBoard
from pixel2catch.ros2 import messages
from pixel2catch.ros2.profile import Profile
from pixel2catch.ros2.transport import Transport

TABLE = "views.csv"  #: File beside the images.
NUM_VIEWS = 15  #: Wanted images. Source: ours; then the camera's position is known to a few millimetres.
MOST_VIEWS = 30  #: Images after which the capture ends even if something is missing. Source: ours.

STILL_TIME = 0.3  #: Time for which board and arm must be still [s]. Source: ours.
STILL_PIXELS, STILL_JOINTS = 0.7, 1e-3
"""Largest motion from image to image that counts as still: of corners [px], of joints [rad]. Source: ours;
corners are found within a few tenths of a pixel."""

LARGEST_BLUR = 1.25
"""Largest standard deviation of an edge's spread in a sharp image [px]. Source: ours; sharp images have 0.6
to 1, and from 1.5 on a far board is not found."""

ALIKE_PIXELS, ALIKE_TURN = 25.0, np.radians(8.0)
"""A view that is closer to a taken one, by corners [px] and the board's turn [rad], adds nothing (ours)."""

CELLS = 3  #: Columns and rows of the parts of the image.
PLACES = (
    ("upper left", "top", "upper right"),
    ("left", "middle", "right"),
    ("lower left", "bottom", "lower right"),
)
TILT = np.radians(15.0)  #: Smallest tilt that is wanted. Source: ours.
TILTS = {
    (1, 1.0): "tilt its lower edge away from the camera",
    (1, -1.0): "tilt its upper edge away from the camera",
    (0, 1.0): "tilt its right edge away from the camera",
    (0, -1.0): "tilt its left edge away from the camera",
}
"""Texts of the wanted tilts, by their axis and sign in `Taken.tilt`."""

NEARNESS = 1.25  #: Smallest ratio of the farthest and nearest distance. Source: ours.
TURN = np.radians(15.0)  #: Smallest turn of the hand about each of two axes. Source: ours.
WAIT = 0.2  #: Longest wait for an image [s]. Source: ours.


@dataclass(frozen=True, kw_only=True, eq=False)
class Candidate:
    """A board in an image, with its approximate pose."""

    view: BoardView  #: The corners.
    turn: Rotation  #: Orientation of the board in the camera.
    distance: float  #: Distance of the board [m].


@dataclass(frozen=True, kw_only=True, eq=False)
class Taken(Candidate):
    """A view that was taken."""

    name: str  #: Name of its image.
    joint_pos: Float[np.ndarray, " num_joints"]  #: Positions of the arm's joints [rad]; empty for a video.
    palm: Rotation | None  #: Orientation of the palm in the world; None if it is unknown.

    @property
    def tilt(self) -> tuple[float, float]:
        """Tilt of the right and of the lower edge in the image away from the camera [rad]."""
        right, down, _ = (-self.turn.as_matrix()[:, 2]).tolist()  # the board's normal
        return float(np.arcsin(right)), float(np.arcsin(down))


def located(view: BoardView, matrix: np.ndarray) -> Candidate | None:
    """Return the approximate pose of a board, for an approximate lens matrix; None if there is none."""
    flags = cv2.SOLVEPNP_IPPE
    is_found, turn, pos = cv2.solvePnP(view.points, view.pixels[:, None], matrix, np.zeros(4), flags=flags)
    if not is_found:
        return None
    return Candidate(view=view, turn=Rotation.from_rotvec(turn.ravel()), distance=float(np.linalg.norm(pos)))


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


def missing_views(taken: Sequence[Taken], size: tuple[int, int]) -> Iterator[str]:
    """Yield, as texts, which views are missing among the taken ones, of images of a size [px]."""
    tilts = np.array([each.tilt for each in taken]).reshape(-1, 2)
    yield from (words for (axis, sign), words in TILTS.items() if not (sign * tilts[:, axis] > TILT).any())
    for (row, column), count in np.ndenumerate(covered(taken, size)):
        if not count:
            yield f"move the board to the {PLACES[row][column]} of the image"
    distances = [each.distance for each in taken]
    if distances and max(distances) < NEARNESS * min(distances):
        yield "move it nearer to the camera, or farther away"
    palms = [each.palm for each in taken if each.palm is not None]
    if palms and _second_turn(palms) < TURN / 2:
        yield "turn the hand about another axis, by another joint of the wrist"


def _second_turn(palms: Sequence[Rotation]) -> float:
    """Root mean square turn of the hand about its second axis of rotation [rad]."""
    turns = np.array([(palms[0].inv() * palm).as_rotvec() for palm in palms])
    spread = np.linalg.svd(turns - turns.mean(axis=0), compute_uv=False) / np.sqrt(len(turns))
    return float(spread[1]) if len(spread) > 1 else 0.0


def covered(taken: Sequence[Taken], size: tuple[int, int]) -> np.ndarray:
    """Return the number of views with a corner in each part of the image, shape (CELLS, CELLS)."""
    counts = np.zeros((CELLS, CELLS), dtype=int)
    for each in taken:
        cells = np.clip((CELLS * each.view.pixels / size).astype(int), 0, CELLS - 1)
        columns, rows = np.unique(cells, axis=0).T
        counts[rows, columns] += 1
    return counts


@final
class Capture:
    """Judges one image after another, and writes the taken ones and their table at once."""

    def __init__(self, folder: Path, board: CharucoBoard, matrix: np.ndarray, joints: Sequence[str]) -> None:
        """Start without images, with the approximate matrix of the lens."""
        self.taken: list[Taken] = []
        self._folder, self._board, self._matrix, self._joints = folder, board, matrix, joints
        self._before: tuple[Image, BoardView] | None = None
        self._still_since = -np.inf
        self._size = (0, 0)
        folder.mkdir(parents=True, exist_ok=True)

    @property
    def is_done(self) -> bool:
        """Whether there are enough views."""
        number = len(self.taken)
        return number >= MOST_VIEWS or (number >= NUM_VIEWS and not any(self.missing))

    @property
    def missing(self) -> list[str]:
        """Which views are missing, as texts."""
        return list(missing_views(self.taken, self._size))

    def look(self, image: Image, palm: Rotation | None) -> str:
        """Take an image if it is suitable; return what was done, or what is wrong with it."""
        self._size = (image.pixels.shape[1], image.pixels.shape[0])
        view = self._board.find(image.pixels)
        is_still = self._is_still(image, view)
        candidate = located(view, self._matrix) if view else None
        if view is None or candidate is None:
            return f"no board: show all of it, in the light; {self._next}"
        if self._joints and image.joint_pos is None:
            return "no positions of the arm's joints yet: is its driver running?"
        if not is_still:
            return f"hold still; {self._next}"
        if (spread := blur(image.pixels, view)) > LARGEST_BLUR:
            return f"blurred ({spread:.1f} px): hold still, focus, expose for a shorter time"
        if twin := next((each for each in self.taken if _is_alike(each, candidate)), None):
            return f"like {twin.name}; {self._next}"
        self._take(image, candidate, palm)
        done = "all wanted views are there" if self.is_done else self._next
        return f"{len(self.taken)} of {NUM_VIEWS}: wrote {self.taken[-1].name}; {done}"

    @property
    def _next(self) -> str:
        return next(missing_views(self.taken, self._size), "any view unlike the others")

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

    def _take(self, image: Image, found: Candidate, palm: Rotation | None) -> None:
        """Write the image, then the table."""
        name = f"pose{len(self.taken) + 1:02d}.png"
        joint_pos = np.zeros(0) if image.joint_pos is None else image.joint_pos
        content = cv2.imencode(".png", cv2.cvtColor(image.pixels, cv2.COLOR_RGB2BGR))[1].tobytes()
        write_atomically({self._folder / name: content})
        self.taken.append(Taken(**vars(found), name=name, joint_pos=joint_pos, palm=palm))
        text = io.StringIO()
        rows = [[each.name, *map(repr, each.joint_pos.tolist())] for each in self.taken]
        csv.writer(text).writerows([["image", *self._joints], *rows])
        write_atomically({self._folder / TABLE: text.getvalue().encode()})


def _is_alike(taken: Taken, found: Candidate) -> bool:
    if len(taken.view.pixels) != len(found.view.pixels):
        return False
    distance = np.linalg.norm(taken.view.pixels - found.view.pixels, axis=-1).max()
    return bool(distance < ALIKE_PIXELS and (taken.turn.inv() * found.turn).magnitude() < ALIKE_TURN)


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
            profile.camera.require(image)
            yield Image(pixels=image.pixels, stamp=image.stamp, joint_pos=known)
        if not newest:
            yield None
