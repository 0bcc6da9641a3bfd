"""Taking the images of a calibration: which are good enough, and what to show the camera next.

An image is taken when the board is found, still, sharp and unlike those before. What is still wanted is told
in words: tilts, parts of the image, distances, and turns of the hand.
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
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from scipy.spatial.transform import Rotation

from pixel2catch.camera.image import Image, Pixels
from pixel2catch.files import write_atomically
from pixel2catch.perception.calibration.target import Board, View
from pixel2catch.ros2 import messages
from pixel2catch.ros2.profile import Profile
from pixel2catch.ros2.transport import Transport

TABLE, PICTURE = "views.csv", "coverage.svg"  #: Files beside the images.

STILL_TIME = 0.3  #: How long board and arm must have rested [s]. Source: ours.
STILL_PIXELS, STILL_JOINTS = 0.7, 1e-3
"""Motion from image to image that is rest: of corners [px], of joints [rad]. Source: ours; corners are found
within a few tenths of a pixel."""

LARGEST_BLUR = 1.25
"""Standard deviation of an edge's spread that is still sharp [px]. Source: ours; sharp images have 0.6 to 1,
and from 1.5 on a far board is not found."""

ALIKE_PIXELS, ALIKE_TURN = 25.0, np.radians(8.0)
"""A view nearer to a taken one, by corners [px] and the board's turn [rad], tells nothing new (ours)."""

CELLS = 3  #: Columns and rows of the parts of the image.
PLACES = (
    ("upper left", "top", "upper right"),
    ("left", "middle", "right"),
    ("lower left", "bottom", "lower right"),
)
TILT = np.radians(15.0)  #: Tilt that counts as one. Source: ours.
NEARNESS = 1.25  #: Ratio of the farthest and nearest distance that counts as two distances. Source: ours.
TURN = np.radians(15.0)  #: Turn of the hand that counts, about each of two axes. Source: ours.
WAIT = 0.2  #: Longest time for which it is waited for an image [s]. Source: ours.
MOST_SHARE = 2.0  #: So many times the wanted images at most, whatever is not covered. Source: ours.


@dataclass(frozen=True, kw_only=True)
class Candidate:
    """A board in an image, about where it is."""

    view: View  #: The corners.
    turn: Rotation  #: Orientation of the board in the camera.
    distance: float  #: Distance of the board [m].


@dataclass(frozen=True, kw_only=True)
class Taken(Candidate):
    """A view that was taken."""

    name: str  #: Name of its image.
    joint_pos: Float[np.ndarray, " num_joints"]  #: Positions of the arm's joints [rad]; none of a video.
    palm: Rotation | None  #: Orientation of the palm in the world; None if it is not known.

    @property
    def tilt(self) -> tuple[float, float]:
        """How far what is right, and what is below in the image, is tilted away from the camera [rad].

        Where the board's normal has a part to the right, the board's right is nearer.
        """
        right, down, _ = (-self.turn.as_matrix()[:, 2]).tolist()
        return float(np.arcsin(right)), float(np.arcsin(down))


def located(view: View, matrix: np.ndarray) -> Candidate | None:
    """Where a board is by a lens that need not be known well."""
    flags = cv2.SOLVEPNP_IPPE
    is_found, turn, pos = cv2.solvePnP(view.points, view.pixels[:, None], matrix, np.zeros(4), flags=flags)
    if not is_found:
        return None
    return Candidate(view=view, turn=Rotation.from_rotvec(turn.ravel()), distance=float(np.linalg.norm(pos)))


def blur(image: Pixels, view: View) -> float:
    """Standard deviation of the spread of the edges about the corners of a board [px].

    An edge of contrast c that is spread by a Gaussian of deviation σ has the gradient c / (√(2π) σ).
    """
    gray = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32)
    low, high = np.floor(view.pixels.min(axis=0)).astype(int), np.ceil(view.pixels.max(axis=0)).astype(int)
    part = gray[max(low[1], 0) : high[1] + 1, max(low[0], 0) : high[0] + 1]
    dx, dy = np.gradient(cv2.GaussianBlur(part, (0, 0), 0.5))
    steepest = float(np.quantile(np.hypot(dx, dy), 0.98))
    contrast = float(np.ptp(np.quantile(part, (0.05, 0.95))))
    return contrast / (np.sqrt(2.0 * np.pi) * max(steepest, 1e-6))


TILTS = {
    (1, 1.0): "tilt its lower edge away from the camera",
    (1, -1.0): "tilt its upper edge away from the camera",
    (0, 1.0): "tilt its right edge away from the camera",
    (0, -1.0): "tilt its left edge away from the camera",
}
"""Tilts that are wanted, by their axis and sign in `Taken.tilt`."""


def wants(taken: Sequence[Taken], size: tuple[int, int]) -> Iterator[str]:
    """What views are still wanted of images of a size [px], in words."""
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
    """How far the hand was turned about a second axis, root mean square [rad]."""
    turns = np.array([(palms[0].inv() * palm).as_rotvec() for palm in palms])
    spread = np.linalg.svd(turns - turns.mean(axis=0), compute_uv=False) / np.sqrt(len(turns))
    return float(spread[1]) if len(spread) > 1 else 0.0


def covered(taken: Sequence[Taken], size: tuple[int, int]) -> np.ndarray:
    """How many views have a corner in each part of the image, shape (CELLS, CELLS)."""
    counts = np.zeros((CELLS, CELLS), dtype=int)
    for each in taken:
        cells = np.clip((CELLS * each.view.pixels / size).astype(int), 0, CELLS - 1)
        columns, rows = np.unique(cells, axis=0).T
        counts[rows, columns] += 1
    return counts


@final
class Capture:
    """Judges image after image, and writes those that are taken, with their table, at once."""

    def __init__(
        self, folder: Path, board: Board, matrix: np.ndarray, joints: Sequence[str], num: int
    ) -> None:
        """Begin with none; the matrix is about the lens, and so many views are wanted."""
        self.taken: list[Taken] = []
        self._folder, self._board, self._matrix, self._joints, self._num = folder, board, matrix, joints, num
        self._before: tuple[Image, View] | None = None
        self._still_since = -np.inf
        self._size = (0, 0)
        folder.mkdir(parents=True, exist_ok=True)

    @property
    def is_done(self) -> bool:
        """Whether there are enough views, and nothing is wanted any more or will come."""
        enough = len(self.taken) >= self._num
        return enough and (not any(self.wanted) or len(self.taken) >= MOST_SHARE * self._num)

    @property
    def wanted(self) -> list[str]:
        """What is still wanted, in words."""
        return list(wants(self.taken, self._size))

    def look(self, frame: Image, palm: Rotation | None) -> str:
        """Take an image if it is worth it; say what was done with it, or what is wrong."""
        self._size = (frame.pixels.shape[1], frame.pixels.shape[0])
        view = self._board.find(frame.pixels)
        is_still = self._is_still(frame, view)
        candidate = located(view, self._matrix) if view else None
        if view is None or candidate is None:
            return f"no board: show all of it, in the light; {self._next}"
        if self._joints and frame.joint_pos is None:
            return "no positions of the arm's joints yet: is its driver running?"
        if not is_still:
            return f"hold still; {self._next}"
        if (spread := blur(frame.pixels, view)) > LARGEST_BLUR:
            return f"blurred ({spread:.1f} px): hold still, focus, expose for a shorter time"
        if twin := next((each for each in self.taken if _is_alike(each, candidate)), None):
            return f"like {twin.name}; {self._next}"
        self._take(frame, candidate, palm)
        done = "all that is wanted is there" if self.is_done else self._next
        return f"{len(self.taken)} of {self._num}: wrote {self.taken[-1].name}; {done}"

    @property
    def _next(self) -> str:
        """What to do next."""
        return next(wants(self.taken, self._size), "any view unlike the others")

    def _is_still(self, frame: Image, view: View | None) -> bool:
        """Whether board and arm have rested for long enough."""
        before, self._before = self._before, (frame, view) if view else None
        if before is None or view is None or len(before[1].pixels) != len(view.pixels):
            self._still_since = frame.stamp
            return False
        last, seen = before
        is_moving = np.abs(view.pixels - seen.pixels).max() > STILL_PIXELS
        if frame.joint_pos is not None and last.joint_pos is not None:
            is_moving |= np.abs(frame.joint_pos - last.joint_pos).max() > STILL_JOINTS
        if is_moving:
            self._still_since = frame.stamp
        return frame.stamp - self._still_since >= STILL_TIME

    def _take(self, frame: Image, found: Candidate, palm: Rotation | None) -> None:
        """Write the image, then the table."""
        name = f"pose{len(self.taken) + 1:02d}.png"
        joint_pos = np.zeros(0) if frame.joint_pos is None else frame.joint_pos
        content = cv2.imencode(".png", cv2.cvtColor(frame.pixels, cv2.COLOR_RGB2BGR))[1].tobytes()
        write_atomically({self._folder / name: content})
        self.taken.append(Taken(**vars(found), name=name, joint_pos=joint_pos, palm=palm))
        text = io.StringIO()
        rows = [[each.name, *map(repr, each.joint_pos.tolist())] for each in self.taken]
        csv.writer(text).writerows([["image", *self._joints], *rows])
        write_atomically({self._folder / TABLE: text.getvalue().encode()})

    def draw(self) -> None:
        """Write a picture of what is covered."""
        page = io.BytesIO()
        coverage_figure(self.taken, self._size).savefig(page, format="svg")
        write_atomically({self._folder / PICTURE: page.getvalue()})


def _is_alike(taken: Taken, found: Candidate) -> bool:
    """Whether a view tells nothing that another one did not."""
    if len(taken.view.pixels) != len(found.view.pixels):
        return False
    distance = np.linalg.norm(taken.view.pixels - found.view.pixels, axis=-1).max()
    return bool(distance < ALIKE_PIXELS and (taken.turn.inv() * found.turn).magnitude() < ALIKE_TURN)


def coverage_figure(taken: Sequence[Taken], size: tuple[int, int]) -> Figure:
    """Where boards were in the image, and how they were tilted."""
    figure = Figure(figsize=(10.0, 4.4), layout="constrained")
    image, tilts = figure.subplots(1, 2, width_ratios=(1.35, 1.0))
    for number, each in enumerate(taken):
        hull = cv2.convexHull(each.view.pixels.astype(np.float32))[:, 0]
        image.fill(*hull.T, alpha=0.25, color=f"C{number % 10}")
        image.plot(*each.view.pixels.T, ".", color=f"C{number % 10}", markersize=3)
        image.annotate(str(number + 1), hull.mean(axis=0), ha="center", va="center", fontsize=8)
    width, height = size
    for part in range(1, CELLS):
        image.axvline(part * width / CELLS, color="0.8", linewidth=0.8, zorder=0)
        image.axhline(part * height / CELLS, color="0.8", linewidth=0.8, zorder=0)
    image.set(
        xlim=(0, width), ylim=(height, 0), aspect="equal", xlabel="[px]", title="the board in the image"
    )
    limit = np.degrees(TILT)
    for number, each in enumerate(taken):
        right, lower = np.degrees(each.tilt)
        tilts.annotate(str(number + 1), (right, lower), ha="center", va="center", fontsize=8)
    tilts.add_patch(Rectangle((-limit, -limit), 2 * limit, 2 * limit, fill=False, color="0.7"))
    tilts.set(
        xlim=(-60, 60),
        ylim=(60, -60),
        aspect="equal",
        xlabel="right edge away [°]",
        ylabel="lower edge away [°]",
        title="its tilt: some on each side of the square",
    )
    return figure


def topic_frames(transport: Transport, profile: Profile, joints: Sequence[str]) -> Iterator[Image | None]:
    """Yield the newest images of a robot's camera as they arrive, or None if none came for a moment.

    Each has the newest positions of some joints, once all of them have been heard.
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
            reading = messages.read_image(message.data)
            profile.camera.require(reading)
            yield Image(pixels=reading.pixels, stamp=reading.stamp, joint_pos=known)
        if not newest:
            yield None
