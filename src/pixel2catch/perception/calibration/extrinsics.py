"""Where the camera stands: from images of a board in the hand at several poses of the palm.

With the palm's pose A from the robot's joints, a corner c of the board is at A Y c in the world, Y being the
board's pose in the hand, and the camera with the pose X sees it at X⁻¹ A Y c. X and Y are chosen for the
smallest distances between seen and computed pixels, of all corners in all images at once. The camera stands
where the policies look for it: in the world frame, as the robot's kinematics has it.

The first guess is in closed form (A X = Z B of robotics): with B the board in the camera, A Y = X B in every
image. Some wrong images do not disturb it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Float, Int
from scipy.linalg import polar
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from pixel2catch.camera.camera_file import CameraFile
from pixel2catch.errors import PerceptionError
from pixel2catch.perception.calibration.intrinsics import Intrinsics
from pixel2catch.perception.calibration.target import View
from pixel2catch.scene.constants import CameraSpec

Pose = Float[np.ndarray, "4 4"]  #: A homogeneous matrix [m].

NUM_DRAWS = 40
"""First guesses from a few images each: where a third of the images is wrong, 12 are from right ones only."""

LEAST_DEPTH = 1e-3  #: A point nearer to the camera's plane, or behind it, is taken to be there [m].
MIN_VIEWS = 6  #: Images that a pose takes. Source: ours; three would do without errors.

OUTLIER_FACTOR = 3.0
"""An image is left out if its error is more than so many times the median of all. Source: ours."""

ERRORS_USED, ERRORS_WRONG = 1.0, 5.0
"""Below the one an image is used, above the other it is left out, whatever the others are [px]. Source: ours;
the corners of a sharp image are found within a few tenths of a pixel, and 3 mrad of error in each of the
arm's joints make 1 px."""

ROBUST_SCALE = 1.0  #: Residuals far above this count less in the first fit [px].

LARGEST_CONDITION = 1e3
"""Condition of the Jacobian above which a direction of the camera is not told. Source: ours; turning about
one axis only gives 9e3 with joints that shake by 0.5 mrad, poses all about the workspace give 50."""


@dataclass(frozen=True, kw_only=True)
class HandView:
    """One image of the board in the hand."""

    name: str  #: Name of the image, for messages.
    view: View  #: The corners in it.
    palm: Pose  #: Pose of the hand's frame at the palm in the world, by the robot's joints.


@dataclass(frozen=True, kw_only=True)
class ViewError:
    """How well an image fits: distance of seen and computed corners [px]; was it fitted, or left out?"""

    name: str
    rms: float
    is_used: bool


@dataclass(frozen=True, kw_only=True)
class Calibration:
    """A camera and the evidence for it."""

    file: CameraFile  #: The camera, and how well it is known.
    board: Pose  #: Pose of the board in the hand's frame at the palm.
    views: tuple[ViewError, ...]  #: The error of each image.
    rms: float  #: Root mean square distance of seen and computed corners in the images used [px].


@dataclass(frozen=True, kw_only=True)
class _Corners:
    """The corners of some images in one array."""

    points: Float[np.ndarray, "num_points 3"]  #: In the frame of the board [m].
    pixels: Float[np.ndarray, "num_points 2"]  #: Where a pinhole would see them [px].
    owner: Int[np.ndarray, " num_points"]  #: Number of each corner's image.
    palms: Float[np.ndarray, "num_views 4 4"]  #: Pose of the palm in the world in every image.
    matrix: Float[np.ndarray, "3 3"]  #: Focal lengths and optical axis [px].

    def of(self, is_meant: np.ndarray) -> "_Corners":
        """The corners of some of the images."""
        rows = is_meant[self.owner]
        return replace(self, points=self.points[rows], pixels=self.pixels[rows], owner=self.owner[rows])

    def errors(self, camera: Pose, board: Pose) -> Float[np.ndarray, "num_points 2"]:
        """Computed minus seen pixels [px]."""
        palms = self.palms[self.owner]
        in_hand = self.points @ board[:3, :3].T + board[:3, 3]
        in_world = np.einsum("nij,nj->ni", palms[:, :3, :3], in_hand) + palms[:, :3, 3]
        seen = (in_world - camera[:3, 3]) @ camera[:3, :3]
        rays = seen[:, :2] / np.maximum(seen[:, 2:], LEAST_DEPTH)
        return rays * self.matrix.diagonal()[:2] + self.matrix[:2, 2] - self.pixels

    def rms(self, camera: Pose, board: Pose) -> Float[np.ndarray, " num_views"]:
        """Root mean square distance of seen and computed corners in each image [px]."""
        squares = np.bincount(self.owner, (self.errors(camera, board) ** 2).sum(-1))
        return np.sqrt(squares / np.bincount(self.owner))


@dataclass(frozen=True, kw_only=True)
class _Fit:
    """The poses of camera and board with the smallest errors: computed minus seen pixels [px].

    The Jacobian is by position and turn of the camera, and then of the board if it was free.
    """

    camera: Pose
    board: Pose
    errors: Float[np.ndarray, "num_points 2"]
    jacobian: Float[np.ndarray, "rows parameters"]


def calibrate(views: Sequence[HandView], intrinsics: Intrinsics, board: Pose | None = None) -> Calibration:
    """Find the camera; the pose of the board in the hand's frame at the palm is found, too, or given.

    Raises:
        PerceptionError: If images are too few, contradict each other, or do not tell the pose.
    """
    _require_enough(len(views), "images show the board in the hand")
    corners = _Corners(
        points=np.concatenate([view.view.points for view in views]),
        pixels=intrinsics.undistorted(np.concatenate([view.view.pixels for view in views])),
        owner=np.repeat(np.arange(len(views)), [len(view.view.points) for view in views]),
        palms=np.stack([view.palm for view in views]),
        matrix=intrinsics.matrix,
    )
    rough = _fit(corners, *_first_guess(corners, board), is_board_free=board is None, loss="cauchy")
    rms = corners.rms(rough.camera, rough.board)
    is_used = rms <= np.clip(OUTLIER_FACTOR * np.median(rms), ERRORS_USED, ERRORS_WRONG)
    _require_enough(
        int(is_used.sum()), "images agree with each other (are the rows of the table those of the images?)"
    )
    used = corners.of(is_used)
    fit = _fit(used, rough.camera, rough.board, is_board_free=board is None, loss="linear")
    errors = zip(views, corners.rms(fit.camera, fit.board), is_used, strict=True)
    return Calibration(
        file=_camera_file(fit.camera, _covariance(fit, used.owner), intrinsics),
        board=fit.board,
        views=tuple(ViewError(name=v.name, rms=float(r), is_used=bool(used)) for v, r, used in errors),
        rms=float(np.sqrt((fit.errors**2).sum(-1).mean())),
    )


def _pose(rotation: np.ndarray, pos: np.ndarray) -> Pose:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, pos
    return pose


def _require_enough(number: int, what: str) -> None:
    if number < MIN_VIEWS:
        raise PerceptionError(
            f"{number} {what}, {MIN_VIEWS} are needed and 15 are good: the board fully in the image, near "
            "and far, the hand turned about different axes."
        )


def _first_guess(corners: _Corners, board: Pose | None) -> tuple[Pose, Pose]:
    """Poses of the camera in the world and of the board in the hand.

    Of guesses from three images each, or from one if the board's pose is known, the one with the smallest
    median error over all images.
    """
    boards: dict[int, Pose] = {}
    for i in range(len(corners.palms)):
        points, pixels = (each[corners.owner == i] for each in (corners.points, corners.pixels))
        lens = (corners.matrix, np.zeros(4))
        is_found, turn, pos = cv2.solvePnP(points, pixels[:, None], *lens, flags=cv2.SOLVEPNP_IPPE)
        if is_found:
            boards[i] = _pose(cv2.Rodrigues(turn)[0], pos.ravel())
    num_drawn = 3 if board is None else 1
    if len(boards) < num_drawn:
        raise PerceptionError("no image tells where the board is: take images nearer and sharper.")
    rng = np.random.default_rng(0)
    guesses = []
    for _ in range(NUM_DRAWS):
        few = rng.choice(list(boards), num_drawn, replace=False)
        guess = _solve([corners.palms[i] for i in few], [boards[i] for i in few], board)
        guesses.append((float(np.median(corners.rms(*guess))), guess))
    return min(guesses, key=lambda guess: guess[0])[1]


def _solve(palms: Sequence[Pose], boards: Sequence[Pose], board: Pose | None) -> tuple[Pose, Pose]:
    """Camera X and board Y from some images: A Y = X B, first the rotations, then the positions.

    The rotations are the singular vector of the smallest singular value of (1 ⊗ A) vec Y - (Bᵀ ⊗ 1) vec X,
    which is zero for exact ones; they are brought to the nearest rotations. OpenCV 5.0 has no binding of its
    `calibrateRobotWorldHandEye`.
    """
    if board is not None:
        return palms[0] @ board @ np.linalg.inv(boards[0]), board
    one = np.eye(3)
    rows = [
        np.hstack((np.kron(one, palm[:3, :3]), -np.kron(seen[:3, :3].T, one)))
        for palm, seen in zip(palms, boards, strict=True)
    ]
    vector = np.linalg.svd(np.vstack(rows))[2][-1]
    halves = [half.reshape(3, 3, order="F") for half in np.split(vector, 2)]
    in_hand, camera = (polar(np.sign(np.linalg.det(half)) * half)[0] for half in halves)
    sides = [np.hstack((one, -palm[:3, :3])) for palm in palms]
    values = [palm[:3, 3] - camera @ seen[:3, 3] for palm, seen in zip(palms, boards, strict=True)]
    places = np.linalg.lstsq(np.vstack(sides), np.concatenate(values))[0]
    return _pose(camera, places[:3]), _pose(in_hand, places[3:])


def _fit(corners: _Corners, camera: Pose, board: Pose, *, is_board_free: bool, loss: str) -> _Fit:
    """Minimise the errors, from poses that are about right."""

    def errors(step: np.ndarray) -> np.ndarray:
        return corners.errors(_moved(camera, step[:6]), _moved(board, step[6:])).ravel()

    num_free = 12 if is_board_free else 6
    best = least_squares(errors, np.zeros(num_free), loss=loss, f_scale=ROBUST_SCALE, x_scale="jac")
    return _Fit(
        camera=_moved(camera, best.x[:6]),
        board=_moved(board, best.x[6:]),
        errors=errors(best.x).reshape(-1, 2),
        jacobian=best.jac,
    )


def _moved(pose: Pose, step: np.ndarray) -> Pose:
    """A pose moved [m] and turned about its own origin [rad], along the axes it is given in; none stays."""
    if not len(step):
        return pose
    return _pose(Rotation.from_rotvec(step[3:]).as_matrix() @ pose[:3, :3], pose[:3, 3] + step[:3])


def _covariance(fit: _Fit, owner: np.ndarray) -> np.ndarray:
    """Covariance (6, 6) of the camera's pose, from what leaving out each image changes: the jackknife.

    All corners of an image share the arm's error, so it is images that are independent, not corners. It is a
    PerceptionError if they do not tell the pose.
    """
    if np.linalg.cond(fit.jacobian / np.linalg.norm(fit.jacobian, axis=0)) > LARGEST_CONDITION:
        raise PerceptionError(
            "the images do not tell where the camera stands, because the hand turned about one axis only; "
            "add images with the wrist turned about others."
        )
    rows, errors = np.repeat(owner, 2), fit.errors.ravel()
    numbers = np.unique(owner)
    changes = np.stack([-np.linalg.lstsq(fit.jacobian[rows != i], errors[rows != i])[0][:6] for i in numbers])
    changes -= changes.mean(axis=0)
    return (len(numbers) - 1) / len(numbers) * changes.T @ changes


def _camera_file(pose: np.ndarray, covariance: np.ndarray, intrinsics: Intrinsics) -> CameraFile:
    """The camera as plain numbers."""
    width, height = intrinsics.size
    (fx, _, cx), (_, fy, cy), _ = intrinsics.matrix.tolist()
    quat = Rotation.from_matrix(pose[:3, :3]).as_quat(canonical=True, scalar_first=True)
    x, y, z = pose[:3, 3].tolist()
    qw, qx, qy, qz = quat.tolist()
    camera = CameraSpec(
        width=width, height=height, fx=fx, fy=fy, cx=cx, cy=cy, pos=(x, y, z), quat=(qw, qx, qy, qz)
    )
    return CameraFile(
        camera=camera,
        distortion=intrinsics.distortion,
        pose_covariance=tuple(tuple(row) for row in covariance.tolist()),
        focal_std=intrinsics.focal_std,
    )
