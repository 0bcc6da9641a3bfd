"""The camera's pose, from images of a board in the hand at several poses of the palm.

With the palm's pose A from the robot's joints, a corner c of the board is at A Y c in the world, where Y is
the board's pose in the hand. A camera with the pose X sees it at X⁻¹ A Y c. X and Y minimise the squared
distances between seen and computed pixels, of all corners at once. Images with much larger errors than the
others are left out. The first guess is in closed form (A X = Z B of robotics): with B the board's pose in the
camera, A Y = X B in every image. It tolerates some wrong images.

The size of the squares, constant errors of the joints and the lens are the same in all images. They are
fitted about their given values, as far as the images determine them. What they leave uncertain is part of the
stated uncertainty.
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
from pixel2catch.perception.calibration.lens import BoardView, lens_spread, lens_values

Pose = Float[np.ndarray, "4 4"]  #: A homogeneous matrix [m].
Common = Float[np.ndarray, " num_common"]
"""What all images share: relative error of the square's edge, a constant error of each joint [rad], and
errors of the lens in the standard deviations of `lens_spread`."""

NUM_POSES = 12  #: Parameters of the poses of camera and board.

NUM_DRAWS, NUM_DRAWN = 40, 3
"""Random first guesses, and images for each. Source: ours; if a third of the images is wrong, 8 (of 6 images)
to 12 (of many) guesses use right images only."""

LEAST_DEPTH = 1e-3  #: Nearer points, and points behind the camera, get this distance from its plane [m].
MIN_VIEWS = 6  #: Fewest images for a pose. Source: ours; three would do without errors.
OUTLIER_FACTOR = 3.0  #: Error from which an image is left out, in medians. Source: ours.

ERRORS_USED, ERRORS_WRONG = 1.0, 5.0
"""Images with a smaller error are always used, those with a larger one never [px]. Source: ours; the corners
of a sharp image are found within a few tenths of a pixel, and errors of 3 mrad in each joint make 1 px."""
LARGEST_RMS = 1.5  #: Of all images that are used [px]. Source: ours, as above.

JOINT_ERROR = 1e-3  #: Standard deviation of a constant error of each joint [rad]. Source: release.
SQUARE_ERROR = 0.005  #: Relative standard deviation of a square's edge. Source: ours, 0.3 mm of 60.
LARGEST_ERROR = 0.03  #: Of a square or the focal length, relative. Source: ours; the camera moves 14, 23 mm.
SURE = 3.0  #: Standard deviations from which such an error is significant. Source: ours.
FIRST_NOISE, LEAST_NOISE = 0.5, 0.05  #: Assumed and smallest error of corners [px]. Source: ours.
ROBUST_SCALE = 1.0  #: Residuals far above this have less weight in the first fit [px].

LARGEST_CONDITION = 1e3
"""Condition of the Jacobian above which images do not determine the pose. Source: ours; turning about one
axis only gives 9e3 with joints that shake by 0.5 mrad, poses all about the workspace give 50."""


@dataclass(frozen=True, kw_only=True, eq=False)
class HandView:
    """One image of the board in the hand."""

    name: str  #: Name of the image, for messages.
    view: BoardView  #: The corners in it.
    palm: Pose  #: Pose of the palm in the world, by the robot's joints.
    #: Derivative of the pose by each joint [1/rad]; empty to assume joints without errors.
    palm_rates: Float[np.ndarray, "num_joints 4 4"] = field(default_factory=lambda: np.zeros((0, 4, 4)))


@dataclass(frozen=True, kw_only=True, eq=False)
class Calibration:
    """A camera and the evidence for it."""

    #: The camera and its uncertainty. The covariance of the pose is that for its optical axis and distortion,
    #: because a shift of the axis and a turn of the camera cancel in the image.
    file: CameraFile
    pose_std: tuple[float, ...]  #: Of position [m] and turn [rad] along the world's axes, for any lens.
    errors: dict[str, float]  #: Root mean square distance of seen and computed corners in each image [px].
    left_out: tuple[str, ...]  #: Names of the images that the fit does not use.
    #: Edge of the squares by the arm's motion over the given edge, and its standard deviation.
    square_ratio: tuple[float, float]
    focal_ratio: tuple[float, float]  #: Focal length over the lens's, and its relative standard deviation.
    rms: float  #: Root mean square distance of seen and computed corners in the images used [px].


@dataclass(frozen=True, kw_only=True, eq=False)
class _Corners:
    """The corners of some images in one array."""

    points: Float[np.ndarray, "num_points 3"]  #: In the frame of the board [m].
    pixels: Float[np.ndarray, "num_points 2"]  #: In the images [px].
    owner: Int[np.ndarray, " num_points"]  #: Number of each corner's image.
    palms: Float[np.ndarray, "num_views 4 4"]  #: Pose of the palm in the world in every image.
    palm_rates: Float[np.ndarray, "num_views num_joints 4 4"]  #: Its derivative by each joint [1/rad].
    lens: Float[np.ndarray, " num_values"]  #: Its given values, as of `lens_values`.
    spread: Float[np.ndarray, "num_values num_errors"]  #: Changes of these by one deviation of each error.

    def of(self, is_used: np.ndarray) -> "_Corners":
        """Return the corners of some of the images."""
        rows = is_used[self.owner]
        return replace(self, points=self.points[rows], pixels=self.pixels[rows], owner=self.owner[rows])

    def errors(self, camera: Pose, board: Pose, common: Common) -> Float[np.ndarray, "num_points 2"]:
        """Return computed minus seen pixels [px]."""
        num_joints = self.palm_rates.shape[1]
        joints, lens = common[1 : 1 + num_joints], common[1 + num_joints :]
        palms = (self.palms + np.einsum("j,njkl->nkl", joints, self.palm_rates))[self.owner]
        in_hand = (1.0 + common[0]) * self.points @ board[:3, :3].T + board[:3, 3]
        in_world = np.einsum("nij,nj->ni", palms[:, :3, :3], in_hand) + palms[:, :3, 3]
        seen = (in_world - camera[:3, 3]) @ camera[:3, :3]
        seen[:, 2] = np.maximum(seen[:, 2], LEAST_DEPTH)
        values, still = self.lens + self.spread @ lens, np.zeros(3)
        fx, fy, cx, cy = values[:4]
        matrix = np.array(((fx, 0.0, cx), (0.0, fy, cy), (0.0, 0.0, 1.0)))
        return cv2.projectPoints(seen, still, still, matrix, values[4:])[0][:, 0] - self.pixels

    @property
    def stds(self) -> Common:
        """Standard deviations of the common parameters without the images."""
        joints, lens = (JOINT_ERROR,) * self.palm_rates.shape[1], (1.0,) * self.spread.shape[1]
        return np.array([SQUARE_ERROR, *joints, *lens])

    def rms(self, camera: Pose, board: Pose, common: Common) -> Float[np.ndarray, " num_views"]:
        """Return the root mean square distance of seen and computed corners in each image [px]."""
        squares = np.bincount(self.owner, (self.errors(camera, board, common) ** 2).sum(-1))
        return np.sqrt(squares / np.bincount(self.owner))


@dataclass(frozen=True, kw_only=True, eq=False)
class _Fit:
    """The poses of camera and board with the smallest errors, and the common parameters.

    The columns of the Jacobian are position and turn of the camera, of the board, then the common parameters.
    For each of these a row follows those of the corners: its weighted distance from 0 [px].
    """

    camera: Pose
    board: Pose
    common: Common
    #: Computed minus seen pixels, and the rows of the common ones [px].
    residuals: Float[np.ndarray, " rows"]
    jacobian: Float[np.ndarray, "rows parameters"]


def calibrate(views: Sequence[HandView], lens: CameraFile) -> Calibration:
    """Find the pose of a camera with this lens, and the board's in the hand.

    Raises PerceptionError if images are too few, leave the pose open, or contradict each other or the lens.
    """
    _require_enough(len(views), "images show the board in the hand")
    corners = _Corners(
        points=np.concatenate([view.view.points for view in views]),
        pixels=np.concatenate([view.view.pixels for view in views]),
        owner=np.repeat(np.arange(len(views)), [len(view.view.points) for view in views]),
        palms=np.stack([view.palm for view in views]),
        palm_rates=np.stack([view.palm_rates for view in views]),
        lens=lens_values(lens),
        spread=lens_spread(lens),
    )
    weights = FIRST_NOISE / corners.stds
    rough = _fit(corners, *_first_guess(corners, lens), 0.0 * weights, weights, loss="cauchy")
    rms = corners.rms(rough.camera, rough.board, rough.common)
    is_used = rms <= np.clip(OUTLIER_FACTOR * np.median(rms), ERRORS_USED, ERRORS_WRONG)
    _require_enough(int(is_used.sum()), "images agree with each other (do the table's rows fit them?)")
    used = corners.of(is_used)
    poses = _fit(used, rough.camera, rough.board, rough.common, weights)
    moves = poses.jacobian[:, :NUM_POSES]
    if np.linalg.cond(moves / np.linalg.norm(moves, axis=0)) > LARGEST_CONDITION:
        raise PerceptionError("the pose is unclear: the hand turned about one axis; add other turns.")
    fit = _fit_with_common(used, poses, used.stds)
    every, names = corners.rms(fit.camera, fit.board, fit.common), [view.name for view in views]
    quat = Rotation.from_matrix(fit.camera[:3, :3]).as_quat(canonical=True, scalar_first=True)
    covariance, num_errors = _covariance(fit, used), used.spread.shape[1]
    values = used.lens + used.spread @ fit.common[-num_errors:]
    fx, fy, cx, cy, *distortion = values.tolist()
    focal, pose_std = used.spread[0] / fx, np.sqrt(covariance.diagonal()[:6])
    focal_std = float(np.sqrt(focal @ covariance[-num_errors:, -num_errors:] @ focal))
    pose = {"pos": tuple(fit.camera[:3, 3].tolist()), "quat": tuple(quat.tolist())}
    square_ratio = _require_given(used, poses, lens, fx)
    rms = float(np.sqrt((used.errors(fit.camera, fit.board, fit.common) ** 2).sum(-1).mean()))
    if rms > LARGEST_RMS:
        raise PerceptionError(
            f"the reprojection error is {rms:.2f} px RMS, at most {LARGEST_RMS} px are valid: check the lens "
            f"(its axis is at {lens.camera.cx:.0f}, {lens.camera.cy:.0f} px), --square, that the board is "
            f"fixed, that the arm stood still, and first {names[(is_used * every).argmax()]}."
        )
    return Calibration(
        file=CameraFile(
            camera=replace(lens.camera, fx=fx, fy=fy, cx=cx, cy=cy, **pose),
            distortion=tuple(distortion) if lens.distortion else (),
            pose_covariance=tuple(map(tuple, given_last(covariance, num_errors - 1)[:6, :6].tolist())),
            focal_std=focal_std,
        ),
        pose_std=tuple(pose_std.tolist()),
        errors=dict(zip(names, every.tolist(), strict=True)),
        left_out=tuple(name for name, used in zip(names, is_used, strict=True) if not used),
        square_ratio=square_ratio,
        focal_ratio=(fx / lens.camera.fx, focal_std),
        rms=rms,
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


def _first_guess(corners: _Corners, lens: CameraFile) -> tuple[Pose, Pose]:
    """Camera in the world, board in the hand: of guesses from three images, that with the least median."""
    boards: dict[int, Pose] = {}
    for i in range(len(corners.palms)):
        points, pixels = (each[corners.owner == i] for each in (corners.points, corners.pixels))
        given = (np.array(lens.camera.matrix), corners.lens[4:])
        is_found, turn, pos = cv2.solvePnP(points, pixels[:, None], *given, flags=cv2.SOLVEPNP_IPPE)
        if is_found:
            boards[i] = _pose(cv2.Rodrigues(turn)[0], pos.ravel())
    if len(boards) < NUM_DRAWN:
        raise PerceptionError("the board's pose is found in too few images: take them nearer and sharper.")
    rng = np.random.default_rng(0)
    draws = (rng.choice(list(boards), NUM_DRAWN, replace=False) for _ in range(NUM_DRAWS))
    guesses = (_solve([corners.palms[i] for i in few], [boards[i] for i in few]) for few in draws)
    return min(guesses, key=lambda guess: float(np.median(corners.rms(*guess, 0.0 * corners.stds))))


def _solve(palms: Sequence[Pose], boards: Sequence[Pose]) -> tuple[Pose, Pose]:
    """Camera X and board Y from some images: A Y = X B, first the rotations, then the positions.

    The rotations are the singular vector of the smallest singular value of (1 ⊗ A) vec Y - (Bᵀ ⊗ 1) vec X,
    replaced by the nearest rotations. OpenCV 5.0 has no binding of its `calibrateRobotWorldHandEye`.
    """
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
    corners: _Corners, camera: Pose, board: Pose, common: Common, weights: Common, loss: str = "linear"
) -> _Fit:
    """Minimise the errors and the weighted [px/unit] common parameters, from approximate values."""

    def residuals(step: np.ndarray) -> np.ndarray:
        moved = _moved(camera, step[:6]), _moved(board, step[6:NUM_POSES])
        errors = corners.errors(*moved, step[NUM_POSES:])
        return np.concatenate((errors.ravel(), weights * step[NUM_POSES:]))

    start = np.concatenate((np.zeros(NUM_POSES), common))
    best = least_squares(residuals, start, loss=loss, f_scale=ROBUST_SCALE, x_scale="jac")
    return _Fit(
        camera=_moved(camera, best.x[:6]),
        board=_moved(board, best.x[6:NUM_POSES]),
        common=best.x[NUM_POSES:],
        residuals=residuals(best.x),
        jacobian=best.jac,
    )


def _fit_with_common(corners: _Corners, poses: _Fit, stds: Common) -> _Fit:
    """Fit again, with common parameters of these standard deviations and the noise of the first fit.

    Errors of the corners of one image are correlated, so the noise is larger by the ratio of the jackknife's
    scatter to that of independent corners.
    """
    num_seen = 2 * len(corners.owner)
    spare = max(num_seen - NUM_POSES - len(stds), 1)
    noise = max(float(np.linalg.norm(poses.residuals[:num_seen])) / np.sqrt(spare), LEAST_NOISE)
    alone = noise**2 * (np.linalg.pinv(poses.jacobian)[:NUM_POSES, :num_seen] ** 2).sum(axis=1)
    scatter = np.diagonal(_jackknife(poses, corners.owner))[:NUM_POSES]
    noise *= max(np.sqrt(float(np.median(scatter / alone))), 1.0)
    return _fit(corners, poses.camera, poses.board, poses.common, noise / stds)


def _require_given(corners: _Corners, poses: _Fit, lens: CameraFile, focal: float) -> tuple[float, float]:
    """Return the squares' edge by the arm's motion over the given edge, and its standard deviation.

    Raises PerceptionError if it, or the focal length of the result, is not as both fit the images freely.
    """
    free = replace(corners, spread=lens_spread(replace(lens, focal_std=lens.focal_std or None)))
    stds, both = free.stds, [0, 1 + free.palm_rates.shape[1]]
    stds[both] = np.inf
    fit, scales = _fit_with_common(free, poses, stds), np.array((1.0, free.spread[0, 0]))
    variances = _jackknife(fit, free.owner).diagonal()[NUM_POSES:]
    (error, change), (std, focal_std) = scales * fit.common[both], scales * np.sqrt(variances[both])
    if abs(error) > max(LARGEST_ERROR, SURE * std):
        raise PerceptionError(
            f"by the arm's motion the squares are {1.0 + error:.3f} ± {std:.3f} times as large as --square "
            "says: measure one on the paper, and give its edge."
        )
    moved = free.lens[0] + change
    if abs(moved - focal) > max(LARGEST_ERROR * focal, SURE * focal_std):
        raise PerceptionError(
            f"by the arm's motion the focal length is {moved:.0f} ± {focal_std:.0f} px, not the given "
            f"{free.lens[0]:.0f}: give the lens of this camera at this resolution, or a folder of images."
        )
    return 1.0 + float(error), float(std)


def _moved(pose: Pose, step: np.ndarray) -> Pose:
    """A pose, translated [m] and turned about its own origin [rad], along the axes of its reference frame."""
    return _pose(Rotation.from_rotvec(step[3:]).as_matrix() @ pose[:3, :3], pose[:3, 3] + step[:3])


def _covariance(fit: _Fit, corners: _Corners) -> np.ndarray:
    """Covariance of all parameters: of the images, and of the given values of the common ones."""
    gain, num_common = np.linalg.pinv(fit.jacobian), len(fit.common)
    weights = np.diagonal(fit.jacobian[-num_common:, -num_common:])
    expected = gain[:, -num_common:] * weights * corners.stds
    return _jackknife(fit, corners.owner) + expected @ expected.T


def given_last(covariance: np.ndarray, num: int) -> np.ndarray:
    """Return the covariance of all parameters but the last ones, if these are known."""
    shared = covariance[:-num, -num:]
    return covariance[:-num, :-num] - shared @ np.linalg.pinv(covariance[-num:, -num:]) @ shared.T


def _jackknife(fit: _Fit, owner: np.ndarray) -> np.ndarray:
    """Covariance of all parameters, from the changes when each image is left out.

    Images are independent, corners of one image are not: they share its blur and the arm's error. Two images
    determine the poses. The covariance has the variance of Student's t with the other degrees of freedom.
    """
    numbers, num_common = np.unique(owner), len(fit.residuals) - 2 * len(owner)
    rows = np.concatenate((np.repeat(owner, 2), np.full(num_common, -1)))
    changes = np.stack(
        [-np.linalg.lstsq(fit.jacobian[rows != i], fit.residuals[rows != i])[0] for i in numbers]
    )
    changes -= changes.mean(axis=0)
    num = len(numbers)
    return (num - 1) / num * (num - 2) / (num - 4) * changes.T @ changes
