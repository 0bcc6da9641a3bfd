"""A first guess of where the camera and the board are: closed form, and undisturbed by some wrong images.

A X = Z B of robotics: with A the palm in the world, B the board in the camera, Y the board in the hand and X
the camera in the world, A Y = X B in every image.
"""

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Float

from pixel2catch.errors import PerceptionError

NUM_DRAWS = 40
"""Guesses from a few images each: where a third of the images is wrong, 12 are from right ones only."""

LEAST_DEPTH = 1e-3
"""A point nearer to the camera's plane, or behind it, is taken to be there [m]."""

Pose = Float[np.ndarray, "4 4"]
"""A homogeneous matrix [m]."""


def image_points(
    camera: Pose, matrix: Float[np.ndarray, "3 3"], points: Float[np.ndarray, "num_points 3"]
) -> Float[np.ndarray, "num_points 2"]:
    """Where a pinhole in this pose sees points of the world [px]."""
    seen = (points - camera[:3, 3]) @ camera[:3, :3]
    rays = seen[:, :2] / np.maximum(seen[:, 2:], LEAST_DEPTH)
    return rays * matrix.diagonal()[:2] + matrix[:2, 2]


def find_start(
    palms: Sequence[Pose],
    seen: Sequence[tuple[np.ndarray, np.ndarray]],
    matrix: Float[np.ndarray, "3 3"],
    board: Pose | None,
) -> tuple[Pose, Pose]:
    """Guess the poses of the camera in the world and of the board in the hand.

    Args:
        palms: Pose of the palm in each image.
        seen: Corners in the frame of the board [m], and where a pinhole sees them [px], in each image.
        matrix: Focal lengths and optical axis [px].
        board: Pose of the board in the hand, if it is known.

    Returns:
        Of guesses from three images each, or from one if the board's pose is known, the one with the smallest
        median error over all images.

    Raises:
        PerceptionError: If too few images tell where the board is.
    """
    boards = {i: pose for i, view in enumerate(seen) if (pose := _board_in_camera(*view, matrix)) is not None}
    num_drawn = 3 if board is None else 1
    if len(boards) < num_drawn:
        raise PerceptionError("no image tells where the board is: take images nearer and sharper.")
    rng = np.random.default_rng(0)
    guesses = []
    for _ in range(NUM_DRAWS):
        few = rng.choice(list(boards), num_drawn, replace=False)
        guess = _solve([palms[i] for i in few], [boards[i] for i in few], board)
        errors = [
            _rms(image_points(guess[0], matrix, _in(palm @ guess[1], points)) - pixels)
            for palm, (points, pixels) in zip(palms, seen, strict=True)
        ]
        guesses.append((float(np.median(errors)), guess))
    return min(guesses, key=lambda guess: guess[0])[1]


def _rms(errors: np.ndarray) -> float:
    return float(np.sqrt((errors**2).sum(-1).mean()))


def _in(pose: Pose, points: np.ndarray) -> np.ndarray:
    """Points, given in the frame of a pose, in the frame that the pose is given in."""
    return points @ pose[:3, :3].T + pose[:3, 3]


def _board_in_camera(points: np.ndarray, pixels: np.ndarray, matrix: np.ndarray) -> Pose | None:
    """Pose of a plane from its corners, None if they do not tell it."""
    is_found, turn, pos = cv2.solvePnP(points, pixels[:, None], matrix, np.zeros(4), flags=cv2.SOLVEPNP_IPPE)
    if not is_found:
        return None
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = cv2.Rodrigues(turn)[0], pos.ravel()
    return pose


def _solve(palms: Sequence[Pose], boards: Sequence[Pose], board: Pose | None) -> tuple[Pose, Pose]:
    """Camera X and board Y from some images: A Y = X B, first the rotations, then the positions.

    The rotations are the singular vector of the smallest singular value of (1 ⊗ A) vec Y - (Bᵀ ⊗ 1) vec X,
    which is zero for exact ones.
    """
    if board is not None:
        return palms[0] @ board @ np.linalg.inv(boards[0]), board
    one = np.eye(3)
    rows = [
        np.hstack((np.kron(one, palm[:3, :3]), -np.kron(seen[:3, :3].T, one)))
        for palm, seen in zip(palms, boards, strict=True)
    ]
    vector = np.linalg.svd(np.vstack(rows))[2][-1]
    in_hand, camera = (_rotation(half.reshape(3, 3, order="F")) for half in np.split(vector, 2))
    sides = [np.hstack((one, -palm[:3, :3])) for palm in palms]
    values = [palm[:3, 3] - camera @ seen[:3, 3] for palm, seen in zip(palms, boards, strict=True)]
    places = np.linalg.lstsq(np.vstack(sides), np.concatenate(values))[0]
    return _pose(camera, places[:3]), _pose(in_hand, places[3:])


def _rotation(matrix: np.ndarray) -> np.ndarray:
    """The rotation nearest to a multiple of a matrix."""
    left, _, right = np.linalg.svd(np.sign(np.linalg.det(matrix)) * matrix)
    return left @ right


def _pose(rotation: np.ndarray, pos: np.ndarray) -> Pose:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, pos
    return pose
