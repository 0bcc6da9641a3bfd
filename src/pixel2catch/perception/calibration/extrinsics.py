"""Where the camera stands: from images of a board in the hand at several poses of the palm.

With the palm's pose A from the robot's joints, a corner c of the board is at A Y c in the world, Y being the
board's pose in the hand, and the camera with the pose X sees it at X⁻¹ A Y c. X and Y are chosen for the
smallest distances between seen and computed pixels, of all corners in all images at once. The camera stands
where the policies look for it: in the world frame, as the robot's kinematics has it.

The first guess is in closed form (A X = Z B of robotics): with B the board in the camera, A Y = X B in every
image. Some wrong images do not disturb it.

What all images have in common is fitted, too, as far as they tell it: the size of the squares, which the
arm's own motion measures, and constant errors of its joints. What they leave open of that, and what the lens
leaves open, is a part of the stated uncertainty.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

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
Common = Float[np.ndarray, " num_common"]
"""What images have in common: relative error of the square's edge, and of each joint a constant one [rad]."""

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

JOINT_ERROR = 1e-3  #: Standard deviation of a constant error of each joint [rad]. Source: release.

SQUARE_ERROR = 0.005
"""Standard deviation of the edge of a square as measured, relative. Source: ours, 0.3 mm of 60."""

LARGEST_SQUARE_ERROR = 0.03
"""Relative error of the edge of a square from which nothing is calibrated. Source: ours, six times what a
ruler may be off; 3 % move the camera by 14 mm."""

SURE = 3.0  #: Standard deviations from which an error of the square is one. Source: ours.

FOCAL_ERROR = 0.002
"""Standard deviation of the focal length where nobody states one, relative. Source: ours; what 20 images of a
board leave open."""

LEAST_NOISE = 0.05  #: Corners are never found better [px]. Source: ours.
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
    #: How the pose changes with each joint [1/rad]; without, errors of joints are not thought of.
    palm_rates: Float[np.ndarray, "num_joints 4 4"] = field(default_factory=lambda: np.zeros((0, 4, 4)))


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
    #: Edge of the squares by the arm's motion over what was said of it, and its standard deviation.
    square_ratio: tuple[float, float]
    rms: float  #: Root mean square distance of seen and computed corners in the images used [px].


@dataclass(frozen=True, kw_only=True)
class _Corners:
    """The corners of some images in one array."""

    points: Float[np.ndarray, "num_points 3"]  #: In the frame of the board [m].
    pixels: Float[np.ndarray, "num_points 2"]  #: Where a pinhole would see them [px].
    owner: Int[np.ndarray, " num_points"]  #: Number of each corner's image.
    palms: Float[np.ndarray, "num_views 4 4"]  #: Pose of the palm in the world in every image.
    palm_rates: Float[np.ndarray, "num_views num_joints 4 4"]  #: Its change with each joint [1/rad].
    matrix: Float[np.ndarray, "3 3"]  #: Focal lengths and optical axis [px].

    def of(self, is_meant: np.ndarray) -> "_Corners":
        """The corners of some of the images."""
        rows = is_meant[self.owner]
        return replace(self, points=self.points[rows], pixels=self.pixels[rows], owner=self.owner[rows])

    def errors(
        self, camera: Pose, board: Pose, common: Common | None = None
    ) -> Float[np.ndarray, "num_points 2"]:
        """Computed minus seen pixels [px]."""
        common = np.zeros(1 + self.palm_rates.shape[1]) if common is None else common
        palms = self.palms + np.einsum("j,njkl->nkl", common[1:], self.palm_rates)
        palms = palms[self.owner]
        in_hand = (1.0 + common[0]) * self.points @ board[:3, :3].T + board[:3, 3]
        in_world = np.einsum("nij,nj->ni", palms[:, :3, :3], in_hand) + palms[:, :3, 3]
        seen = (in_world - camera[:3, 3]) @ camera[:3, :3]
        rays = seen[:, :2] / np.maximum(seen[:, 2:], LEAST_DEPTH)
        return rays * self.matrix.diagonal()[:2] + self.matrix[:2, 2] - self.pixels

    def rms(self, camera: Pose, board: Pose, common: Common | None = None) -> Float[np.ndarray, " num_views"]:
        """Root mean square distance of seen and computed corners in each image [px]."""
        squares = np.bincount(self.owner, (self.errors(camera, board, common) ** 2).sum(-1))
        return np.sqrt(squares / np.bincount(self.owner))


@dataclass(frozen=True, kw_only=True)
class _Fit:
    """The poses of camera and board with the smallest errors, and what was fitted beside them.

    The columns of the Jacobian are position and turn of the camera, and then of the board if it was free, and
    what is common to all images, if that was fitted. For each of the latter a row follows those of the
    corners: how far it is from what was expected, in pixels.
    """

    camera: Pose
    board: Pose
    common: Common
    residuals: Float[np.ndarray, " rows"]  #: Computed minus seen pixels, and the rows of what is common [px].
    jacobian: Float[np.ndarray, "rows parameters"]
    num_poses: int  #: Columns of poses.


def calibrate(views: Sequence[HandView], intrinsics: Intrinsics, board: Pose | None = None) -> Calibration:
    """Find the camera; the pose of the board in the hand's frame at the palm is found, too, or given.

    Raises:
        PerceptionError: If images are too few, contradict each other, or do not tell the pose; or if the
            squares are of another size than was said.
    """
    _require_enough(len(views), "images show the board in the hand")
    corners = _Corners(
        points=np.concatenate([view.view.points for view in views]),
        pixels=intrinsics.undistorted(np.concatenate([view.view.pixels for view in views])),
        owner=np.repeat(np.arange(len(views)), [len(view.view.points) for view in views]),
        palms=np.stack([view.palm for view in views]),
        palm_rates=np.stack([view.palm_rates for view in views]),
        matrix=intrinsics.matrix,
    )
    is_free = board is None
    rough = _fit(corners, *_first_guess(corners, board), is_board_free=is_free, loss="cauchy")
    rms = corners.rms(rough.camera, rough.board)
    is_used = rms <= np.clip(OUTLIER_FACTOR * np.median(rms), ERRORS_USED, ERRORS_WRONG)
    _require_enough(
        int(is_used.sum()), "images agree with each other (are the rows of the table those of the images?)"
    )
    used = corners.of(is_used)
    poses = _fit(used, rough.camera, rough.board, is_board_free=is_free, loss="linear")
    _require_turns(poses)
    square_ratio = _square_ratio(used, poses)
    fit = _fit_with_common(used, poses, SQUARE_ERROR)
    errors = used.errors(fit.camera, fit.board, fit.common)
    every = corners.rms(fit.camera, fit.board, fit.common)
    return Calibration(
        file=_camera_file(fit.camera, _covariance(fit, used, intrinsics), intrinsics),
        board=fit.board,
        views=tuple(
            ViewError(name=view.name, rms=float(rms), is_used=bool(used))
            for view, rms, used in zip(views, every, is_used, strict=True)
        ),
        square_ratio=square_ratio,
        rms=float(np.sqrt((errors**2).sum(-1).mean())),
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


def _fit(
    corners: _Corners,
    camera: Pose,
    board: Pose,
    *,
    is_board_free: bool,
    loss: str,
    weights: Common | None = None,
) -> _Fit:
    """Minimise the errors, from poses that are about right.

    With weights, what is common to all images is fitted, too: each is expected to be 0, and costs so many
    pixels per unit if it is not.
    """
    weights = np.zeros(0) if weights is None else weights
    num_poses = 12 if is_board_free else 6

    def residuals(step: np.ndarray) -> np.ndarray:
        common = step[num_poses:] if len(weights) else None
        errors = corners.errors(_moved(camera, step[:6]), _moved(board, step[6:num_poses]), common)
        return np.concatenate((errors.ravel(), weights * step[num_poses:]))

    start = np.zeros(num_poses + len(weights))
    best = least_squares(residuals, start, loss=loss, f_scale=ROBUST_SCALE, x_scale="jac")
    return _Fit(
        camera=_moved(camera, best.x[:6]),
        board=_moved(board, best.x[6:num_poses]),
        common=best.x[num_poses:],
        residuals=residuals(best.x),
        jacobian=best.jac,
        num_poses=num_poses,
    )


def _fit_with_common(corners: _Corners, poses: _Fit, square_error: float) -> _Fit:
    """Fit what is common to all images beside the poses; the square is known that well, or not at all: ∞.

    Where corners of an image err together, images tell less than their corners do one by one: as much less as
    the poses scatter more than corners alone would make them.
    """
    spare = max(len(poses.residuals) - poses.num_poses, 1)
    noise = max(float(np.linalg.norm(poses.residuals)) / np.sqrt(spare), LEAST_NOISE)
    alone = noise**2 * np.diagonal(np.linalg.inv(poses.jacobian.T @ poses.jacobian))
    noise *= max(np.sqrt(float(np.median(_deviations(poses, corners.owner) ** 2 / alone))), 1.0)
    stds = np.array([square_error, *(JOINT_ERROR,) * corners.palm_rates.shape[1]])
    is_free = poses.num_poses == 12
    start = (poses.camera, poses.board)
    return _fit(corners, *start, is_board_free=is_free, loss="linear", weights=noise / stds)


def _square_ratio(corners: _Corners, poses: _Fit) -> tuple[float, float]:
    """Edge of the squares by the arm's motion over what was said, and its standard deviation.

    Raises:
        PerceptionError: If it is surely another one.
    """
    fit = _fit_with_common(corners, poses, np.inf)
    error, std = float(fit.common[0]), float(_deviations(fit, corners.owner)[poses.num_poses])
    if abs(error) > max(LARGEST_SQUARE_ERROR, SURE * std):
        raise PerceptionError(
            f"by the arm's motion the squares are {1.0 + error:.3f} ± {std:.3f} times as large as --square "
            f"says: measure one on the paper, and give its edge. If it is right, the lens is not: its focal "
            "length is off by about as much, or the table has positions of another arm."
        )
    return 1.0 + error, std


def _moved(pose: Pose, step: np.ndarray) -> Pose:
    """A pose moved [m] and turned about its own origin [rad], along the axes it is given in; none stays."""
    if not len(step):
        return pose
    return _pose(Rotation.from_rotvec(step[3:]).as_matrix() @ pose[:3, :3], pose[:3, 3] + step[:3])


def _require_turns(poses: _Fit) -> None:
    """Refuse images that do not tell the pose."""
    if np.linalg.cond(poses.jacobian / np.linalg.norm(poses.jacobian, axis=0)) > LARGEST_CONDITION:
        raise PerceptionError(
            "the images do not tell where the camera stands, because the hand turned about one axis only; "
            "add images with the wrist turned about others."
        )


def _covariance(fit: _Fit, corners: _Corners, intrinsics: Intrinsics) -> np.ndarray:
    """Covariance (6, 6) of the camera's pose: of the images, and of what they have in common."""
    gain = np.linalg.pinv(fit.jacobian)
    num_common = len(fit.common)
    weights = np.diagonal(fit.jacobian[-num_common:, -num_common:])
    expected = gain[:, -num_common:] * weights * np.array([SQUARE_ERROR, *(JOINT_ERROR,) * (num_common - 1)])
    seen = corners.errors(fit.camera, fit.board, fit.common) + corners.pixels
    zoom = np.concatenate(((seen - corners.matrix[:2, 2]).ravel(), np.zeros(num_common)))
    focal = gain @ zoom * (intrinsics.focal_std or FOCAL_ERROR)
    total = _jackknife(fit, corners.owner) + expected @ expected.T + np.outer(focal, focal)
    return total[:6, :6]


def _deviations(fit: _Fit, owner: np.ndarray) -> np.ndarray:
    """Standard deviations of all parameters, by the images alone."""
    return np.sqrt(np.diagonal(_jackknife(fit, owner)))


def _jackknife(fit: _Fit, owner: np.ndarray) -> np.ndarray:
    """Covariance of all parameters, from what leaving out each image changes.

    All corners of an image share its blur and the arm's error, so it is images that are independent, not
    corners. An image tells at most as much as a pose, and the poses of two are needed: of few images it is
    enlarged, so that a normal distribution has the variance of Student's t with as many degrees of freedom
    as there are more.
    """
    numbers, num_common = np.unique(owner), len(fit.residuals) - 2 * len(owner)
    rows = np.concatenate((np.repeat(owner, 2), np.full(num_common, -1)))
    changes = np.stack(
        [-np.linalg.lstsq(fit.jacobian[rows != i], fit.residuals[rows != i])[0] for i in numbers]
    )
    changes -= changes.mean(axis=0)
    num = len(numbers)
    return (num - 1) / num * (num - 2) / (num - 4) * changes.T @ changes


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
