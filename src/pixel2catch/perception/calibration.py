"""Where the camera stands: from images of a board in the hand at several joint positions.

With the palm's pose A from the arm's joints, a corner c of the board is at A Y c in the world, Y being the
board's pose in the hand, and the camera with the pose X sees it at X⁻¹ A Y c. X and Y are chosen for the
smallest distances between seen and computed pixels, of all corners in all images at once. The camera stands
where the policies look for it: in the world frame, as the arm's kinematics has it.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from pixel2catch.camera.camera_file import CameraFile
from pixel2catch.errors import InvalidValueError, PerceptionError
from pixel2catch.perception.calibration_intrinsics import Intrinsics
from pixel2catch.perception.calibration_start import find_start, image_points
from pixel2catch.perception.calibration_target import View
from pixel2catch.robot.constants import CameraSpec
from pixel2catch.robot.kinematics import palm_pose

MIN_VIEWS = 6
"""Images that a pose takes. Source: ours; three would do without errors."""

OUTLIER_FACTOR = 3.0
"""An image is left out if its error is more than so many times the median of all. Source: ours."""

ERRORS_USED, ERRORS_WRONG = 1.0, 5.0
"""Below the one an image is used, above the other it is left out, whatever the others are [px].

Source: ours; the corners of a sharp image are found within a few tenths of a pixel, and 3 mrad of error in
each of the arm's joints make 1 px.
"""

ROBUST_SCALE = 1.0
"""Residuals far above this count less in the first fit [px]."""

LARGEST_CONDITION = 1e3
"""Condition of the Jacobian above which a direction of the camera is not told.

Source: ours; turning about one axis only gives 9e3 with joints that shake by 0.5 mrad, poses all about the
workspace give 50.
"""


@dataclass(frozen=True, kw_only=True)
class HandView:
    """One image of the board in the hand.

    Attributes:
        name: Name of the image, for messages.
        view: The corners in it.
        joint_pos: Positions of the arm's joints [rad].
    """

    name: str
    view: View
    joint_pos: Float[np.ndarray, "6"]


@dataclass(frozen=True, kw_only=True)
class ViewError:
    """How well one image fits.

    Attributes:
        name: Name of the image.
        rms: Root mean square distance of seen and computed corners [px].
        is_used: Whether it was fitted, or left out as wrong.
    """

    name: str
    rms: float
    is_used: bool


@dataclass(frozen=True, kw_only=True)
class Calibration:
    """A camera and the evidence for it.

    Attributes:
        file: The camera, and how well it is known.
        board: Pose of the board in the hand's frame at the palm, as a homogeneous matrix [m].
        views: The error of each image.
        rms: Root mean square distance of seen and computed corners in the images used [px].
    """

    file: CameraFile
    board: Float[np.ndarray, "4 4"]
    views: tuple[ViewError, ...]
    rms: float


@dataclass(frozen=True, kw_only=True)
class _Corners:
    """All corners of some images in one array.

    Attributes:
        points: In the frame of the board [m].
        palms: Pose of the palm in the world, of each corner's image.
        pixels: Where a pinhole would see them [px].
        matrix: Focal lengths and optical axis [px].
        owner: Number of each corner's image.
    """

    points: Float[np.ndarray, "num_points 3"]
    palms: Float[np.ndarray, "num_points 4 4"]
    pixels: Float[np.ndarray, "num_points 2"]
    matrix: Float[np.ndarray, "3 3"]
    owner: np.ndarray

    def of(self, is_meant: np.ndarray) -> "_Corners":
        """The corners of some of the images."""
        rows = is_meant[self.owner]
        return _Corners(
            points=self.points[rows],
            palms=self.palms[rows],
            pixels=self.pixels[rows],
            matrix=self.matrix,
            owner=self.owner[rows],
        )

    def errors(self, camera: np.ndarray, board: np.ndarray) -> Float[np.ndarray, "num_points 2"]:
        """Computed minus seen pixels [px]."""
        in_hand = self.points @ board[:3, :3].T + board[:3, 3]
        in_world = np.einsum("nij,nj->ni", self.palms[:, :3, :3], in_hand) + self.palms[:, :3, 3]
        return image_points(camera, self.matrix, in_world) - self.pixels


@dataclass(frozen=True, kw_only=True)
class _Fit:
    """The smallest errors.

    Attributes:
        camera: Pose of the camera in the world.
        board: Pose of the board in the hand.
        errors: Computed minus seen pixels [px].
        jacobian: Their derivatives by position and turn of the camera, and then of the board if it was free.
    """

    camera: np.ndarray
    board: np.ndarray
    errors: Float[np.ndarray, "num_points 2"]
    jacobian: Float[np.ndarray, "rows parameters"]


def calibrate(
    views: Sequence[HandView], intrinsics: Intrinsics, board: Float[np.ndarray, "4 4"] | None = None
) -> Calibration:
    """Find the camera.

    Args:
        views: Images of the board in the hand.
        intrinsics: The lens.
        board: Pose of the board in the hand's frame at the palm [m], if it is known.

    Raises:
        PerceptionError: If images are too few, contradict each other, or do not tell the pose.
    """
    _require_enough(len(views), "images show the board in the hand")
    corners = _gathered(views, intrinsics)
    palms = [corners.palms[corners.owner == i][0] for i in range(len(views))]
    seen = [
        (corners.points[corners.owner == i], corners.pixels[corners.owner == i]) for i in range(len(views))
    ]
    camera, start = find_start(palms, seen, intrinsics.matrix, board)
    rough = _fit(corners, camera, start, is_board_free=board is None, loss="cauchy")
    is_used = _is_plausible(_view_rms(rough.errors, corners.owner, len(views)))
    _require_enough(
        int(is_used.sum()), "images agree with each other (are the rows of the table those of the images?)"
    )
    used = corners.of(is_used)
    fit = _fit(used, rough.camera, rough.board, is_board_free=board is None, loss="linear")
    rms = _view_rms(corners.errors(fit.camera, fit.board), corners.owner, len(views))
    errors = zip(views, rms, is_used, strict=True)
    return Calibration(
        file=_camera_file(fit.camera, _covariance(fit, used.owner), intrinsics),
        board=fit.board,
        views=tuple(ViewError(name=v.name, rms=float(r), is_used=bool(used)) for v, r, used in errors),
        rms=float(np.sqrt((fit.errors**2).sum(-1).mean())),
    )


def pose_matrix(pos: Sequence[float], quat: Sequence[float]) -> Float[np.ndarray, "4 4"]:
    """Homogeneous matrix of a position [m] and an orientation (w, x, y, z), a unit quaternion."""
    if abs(np.linalg.norm(quat) - 1.0) > 1e-3:
        raise InvalidValueError(f"{tuple(quat)} is no unit quaternion (w, x, y, z); divide it by its norm.")
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = Rotation.from_quat(quat, scalar_first=True).as_matrix(), pos
    return pose


def _require_enough(number: int, what: str) -> None:
    if number < MIN_VIEWS:
        raise PerceptionError(
            f"{number} {what}, {MIN_VIEWS} are needed and 15 are good: the board fully in the image, near "
            "and far, the hand turned about different axes."
        )


def _gathered(views: Sequence[HandView], intrinsics: Intrinsics) -> _Corners:
    """All corners, seen without the lens's distortion."""
    pos, quat = palm_pose(torch.from_numpy(np.stack([view.joint_pos for view in views])).double())
    palms = np.tile(np.eye(4), (len(views), 1, 1))
    palms[:, :3, :3] = Rotation.from_quat(quat.numpy(), scalar_first=True).as_matrix()
    palms[:, :3, 3] = pos.numpy()
    owner = np.repeat(np.arange(len(views)), [len(view.view.points) for view in views])
    return _Corners(
        points=np.concatenate([view.view.points for view in views]),
        palms=palms[owner],
        pixels=intrinsics.undistorted(np.concatenate([view.view.pixels for view in views])),
        matrix=intrinsics.matrix,
        owner=owner,
    )


def _fit(corners: _Corners, camera: np.ndarray, board: np.ndarray, *, is_board_free: bool, loss: str) -> _Fit:
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


def _moved(pose: np.ndarray, step: np.ndarray) -> np.ndarray:
    """A pose moved [m] and turned about its own origin [rad], along the axes it is given in; none stays."""
    if not len(step):
        return pose
    moved = np.eye(4)
    moved[:3, :3] = Rotation.from_rotvec(step[3:]).as_matrix() @ pose[:3, :3]
    moved[:3, 3] = pose[:3, 3] + step[:3]
    return moved


def _view_rms(errors: np.ndarray, owner: np.ndarray, num_views: int) -> np.ndarray:
    """Root mean square distance in each image [px]."""
    squares = np.bincount(owner, (errors**2).sum(-1), minlength=num_views)
    return np.sqrt(squares / np.bincount(owner, minlength=num_views))


def _is_plausible(rms: np.ndarray) -> np.ndarray:
    """Which images to use."""
    return rms <= np.clip(OUTLIER_FACTOR * np.median(rms), ERRORS_USED, ERRORS_WRONG)


def _covariance(fit: _Fit, owner: np.ndarray) -> np.ndarray:
    """Covariance (6, 6) of the camera's pose, from what leaving out each image changes: the jackknife.

    All corners of an image share the arm's error, so it is images that are independent, not corners.

    Raises:
        PerceptionError: If the images do not tell the pose.
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
