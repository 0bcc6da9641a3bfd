"""Take the images of a calibration: each with the board found, still, sharp and unlike the images before."""

import csv
import io
from collections.abc import Iterator, MutableSequence, Sequence
from pathlib import Path
from typing import final

import cv2
import numpy as np

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

LEAST_CHANGE = 15.0  #: Smallest motion of a corner from each image that was taken [px]. Source: ours.
WAIT = 0.2  #: Longest wait for an image [s]. Source: ours.


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
        self.taken: list[BoardView] = []
        self._folder, self._board = folder, board
        self._rows: list[list[str]] = [["image", *joints]]
        self._before: tuple[Image, BoardView] | None = None
        self._still_since = -np.inf
        folder.mkdir(parents=True, exist_ok=True)

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
        for (name, *_), taken in zip(self._rows[1:], self.taken, strict=True):
            if _change(taken, view) < LEAST_CHANGE:
                return f"like {name}: move or tilt the board"
        self.taken.append(view)
        name = f"pose{len(self.taken):02d}.png"
        self._write(name, image.pixels, image.joint_pos)
        return f"{len(self.taken)} of {NUM_VIEWS}: wrote {name}"

    def _is_still(self, image: Image, view: BoardView | None) -> bool:
        before, self._before = self._before, (image, view) if view else None
        is_moving = before is None or view is None or _change(view, before[1]) > STILL_PIXELS
        last = before[0].joint_pos if before else None
        if image.joint_pos is not None and last is not None:
            is_moving |= np.abs(image.joint_pos - last).max() > STILL_JOINTS
        if is_moving:
            self._still_since = image.stamp
        return image.stamp - self._still_since >= STILL_TIME

    def _write(self, name: str, pixels: Pixels, joint_pos: np.ndarray) -> None:
        content = cv2.imencode(".png", cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR))[1].tobytes()
        write_atomically({self._folder / name: content})
        self._rows.append([name, *map(repr, joint_pos.tolist())])
        text = io.StringIO()
        csv.writer(text).writerows(self._rows)
        write_atomically({self._folder / TABLE: text.getvalue().encode()})


def _change(view: BoardView, other: BoardView) -> float:
    """Largest motion of a corner between two views [px]; infinite if they have other numbers of corners."""
    if len(view.pixels) != len(other.pixels):
        return np.inf
    return float(np.linalg.norm(view.pixels - other.pixels, axis=-1).max())


def topic_images(
    transport: Transport,
    profile: Profile,
    joints: Sequence[str],
    states: MutableSequence[tuple[float, np.ndarray]],
    most: int = 1,
) -> Iterator[Image | None]:
    """Yield images of a robot's camera as they arrive, or None after `WAIT` without one.

    Each has the newest positions of some joints, once all of them have been received. Raises DeploymentError
    for images of another format than the profile's.

    Args:
        transport: The network.
        profile: Names of the topics.
        joints: Names of the joints.
        states: Gets stamps [s] and positions of the joints [rad], of which the last is used here.
        most: Most images that wait; older ones are left out.
    """
    parts = [part for part in profile.robots if {*part.joints} & {*joints}]
    subscriptions = [(part, transport.subscription(part.state_topic, 512)) for part in parts]
    images = transport.subscription(profile.camera.image, most)
    order = list(profile.robots[0].joint_order)
    columns, joint_pos = [order.index(joint) for joint in joints], np.full(len(order), np.nan)
    while True:
        transport.wait(WAIT)
        for part, subscription in subscriptions:
            for message in subscription.take():
                reading = messages.read_joint_state(message.data)
                found, ids = part.columns(reading.names)
                joint_pos[ids] = reading.position[found]
                if len(ids) and np.isfinite(joint_pos[columns]).all():
                    states.append((reading.stamp, joint_pos[columns].copy()))
        newest, known = images.take()[-most:], states[-1][1] if states else None
        for message in newest:
            image = messages.read_image(message.data)
            if wrong := profile.camera.wrong_format(image):
                raise DeploymentError(wrong)
            yield Image(pixels=image.pixels, stamp=image.stamp, joint_pos=known)
        if not newest:
            yield None
