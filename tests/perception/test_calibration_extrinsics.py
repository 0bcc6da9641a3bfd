"""The camera's pose from corners of a board in the hand, and how far it is from a policy's camera."""

from dataclasses import replace
from math import radians, tan
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from calibration_views import (
    CORNERS,
    HOME,
    board_in_camera,
    drawn_lens,
    hand_views,
    lens,
    near_views,
    palm,
    pixels_of,
)
from scipy.spatial.transform import Rotation

from pixel2catch.camera.camera_file import NO_POSE_ERROR, CameraFile
from pixel2catch.errors import PerceptionError
from pixel2catch.mdp.throws import ThrowCfg, sample_paths
from pixel2catch.perception.calibration.comparison import Comparison, advice, compare
from pixel2catch.perception.calibration.extrinsics import Calibration, HandView, calibrate, given_last
from pixel2catch.perception.calibration.lens import BoardView, lens_of_views
from pixel2catch.scene.constants import RGB_CAMERA, CameraSpec

NOISE = 0.3
LEVEL = Rotation.from_quat(RGB_CAMERA.quat, scalar_first=True)


def offset(result: Calibration) -> tuple[np.ndarray, np.ndarray]:
    """Way from the true camera [m], and turn [rad]."""
    found = result.file.camera
    turn = Rotation.from_quat(found.quat, scalar_first=True) * LEVEL.inv()
    return np.subtract(found.pos, RGB_CAMERA.pos), turn.as_rotvec()


def errors(result: Calibration) -> tuple[float, float]:
    """Distance [m] and angle [rad] to the true camera."""
    distance, angle = map(np.linalg.norm, offset(result))
    return float(distance), float(angle)


@pytest.mark.slow
@pytest.mark.parametrize("source", ["camera_info", "near_images", "same_images"])
def test_the_intervals_hold_for_lenses_that_are_not_known(source: str):
    """Of 50 drawn lenses, 90 % and more of the coordinates are within their 95 % intervals.

    The lens given is a CameraInfo whose focal length is 0.3 % and whose axis is 1 px off, that of 12 images
    of the board near the camera, or that of the 15 images themselves. `pytest -s` prints the figures.
    """
    shares, sizes = [], []
    for seed in range(50):
        rng = np.random.default_rng(seed)
        true = drawn_lens(rng)
        views = hand_views(15, seed=seed, noise=0.2, shaking=3e-4, offset=1e-3, square=0.002, true_lens=true)
        if source == "camera_info":
            cx, cy = (rng.normal(value, 1.0) for value in (true.camera.cx, true.camera.cy))
            camera = replace(true.camera, fx=RGB_CAMERA.fx, fy=RGB_CAMERA.fy, cx=cx, cy=cy)
            given = replace(true, camera=camera)
        else:
            near = near_views(rng, 12, true) if source == "near_images" else [each.view for each in views]
            given = lens_of_views(Path("views"), near, (640, 480))
        result = calibrate(views, given)
        found, stds = np.array(offset(result)), np.reshape(result.pose_std, (2, 3))
        shares.append(np.abs(found) < 1.96 * stds)
        sizes.append((np.linalg.norm(found, axis=1), np.linalg.norm(stds, axis=1)))
    position, rotation = np.mean(shares, axis=(0, 2))
    (moved, turned), (moved_std, turned_std) = np.sqrt(np.mean(np.square(sizes), axis=0))
    print(
        f"\n| {source} | {100 * position:.0f} % | {1e3 * moved:.1f} mm | {1e3 * moved_std:.1f} mm "
        f"| {100 * rotation:.0f} % | {np.degrees(turned):.2f}° | {np.degrees(turned_std):.2f}° |"
    )
    assert min(position, rotation) >= 0.9


def test_a_few_stated_deviations_cover_the_truth():
    """Blur, an arm that shakes and is off, squares and a lens that are off, all together."""
    troubles: Any = {"shift": 0.1, "shaking": 3e-4, "offset": 1e-3, "square": 0.005, "focal": 0.002}
    rows = []
    for seed in range(4):
        result = calibrate(hand_views(12, seed=seed, noise=0.15, **troubles), lens())
        rows.append(np.concatenate(offset(result)) / result.pose_std)
    assert (np.abs(rows) < 1.96).mean() > 0.85


@pytest.mark.parametrize(
    ("true_size", "camera", "words"),
    [
        (1.06, {}, r"the squares are 1\.06.* measure one on the paper"),
        (1.0, {"fx": 556.0, "fy": 556.0}, r"focal length is 6\d\d ± . px, not the given 556"),
        (1.0, {"cx": 0.0, "cy": 0.0}, r"error is 6\.\d\d px RMS.*axis is at 0, 0 px"),
    ],
)
def test_squares_and_lenses_of_another_size_are_refused(true_size: float, camera: Any, words: str):
    with pytest.raises(PerceptionError, match=words):
        calibrate(hand_views(12, true_size=true_size), CameraFile(camera=replace(RGB_CAMERA, **camera)))


def test_squares_that_a_ruler_mismeasured_are_found():
    """By 1 %: the arm's motion tells, and the camera is where it was without that."""
    result = calibrate(hand_views(15, noise=0.15, true_size=1.01), lens())
    ratio, std = result.square_ratio
    assert ratio == pytest.approx(1.01, abs=3 * std)
    assert std < 3e-3
    assert errors(result)[0] < 4e-3


def test_finds_the_camera_in_spite_of_noise_and_a_wrong_row():
    offsets = np.zeros((12, 6))
    offsets[4, 3] = 0.2
    result = calibrate(hand_views(12, noise=NOISE, offsets=offsets), lens())
    distance, angle = errors(result)
    assert distance < 5e-3
    assert angle < np.radians(0.3)
    assert result.left_out == ("view4",)
    assert result.errors["view4"] > 10.0
    # A distance of two coordinates is √2 times their noise; 12 of 132 numbers were fitted.
    assert result.rms == pytest.approx(np.sqrt(2) * NOISE * np.sqrt(1 - 12 / 132), rel=0.2)


def test_exact_corners_give_the_exact_camera_and_a_lens_is_straightened():
    result = calibrate(hand_views(6, noise=0.0), lens())
    assert errors(result) == pytest.approx((0.0, 0.0), abs=1e-6)
    assert result.rms < 1e-6
    assert result.square_ratio == pytest.approx((1.0, 0.0), abs=1e-6)
    # What remains is not in the images: 0.2 % of focal length, and what a ruler may be off.
    assert max(result.pose_std[:3]) < 3e-3
    bent = lens((-0.2, 0.05, 1e-3, -1e-3))
    views = hand_views(10, noise=0.0, distortion=bent.distortion)
    assert errors(calibrate(views, bent))[0] < 1e-4
    assert errors(calibrate(views, lens()))[0] > 5e-3


def test_the_arms_motion_tells_the_focal_length():
    """2 % longer than that of a lens known to 3 %; a lens that is stated to be exact is kept."""
    true = replace(lens(), camera=replace(RGB_CAMERA, fx=1.02 * RGB_CAMERA.fx, fy=1.02 * RGB_CAMERA.fy))
    views = hand_views(15, noise=0.1, true_lens=true)
    result = calibrate(views, replace(lens(), focal_std=0.03))
    ratio, std = result.focal_ratio
    assert ratio == pytest.approx(1.02, abs=3 * std)
    assert result.file.focal_std == std < 0.01
    assert result.file.camera.fx == pytest.approx(ratio * RGB_CAMERA.fx)
    # A turn about y cancels an error of the axis in the image: that turn alone is known better.
    assert result.file.pose_std[4] < 0.5 * result.pose_std[4]
    assert compare(result.file, RGB_CAMERA, PATHS).uncertainty < 2.0
    kept = calibrate(hand_views(8), replace(lens(), focal_std=0.0))
    assert kept.focal_ratio == (1.0, 0.0)
    assert kept.file.camera.cx == RGB_CAMERA.cx


def test_what_is_known_of_one_parameter_is_taken_from_another():
    """With variances of 4 and a covariance of 2, a known one leaves 4 - 2² / 4."""
    covariance = np.array([[4.0, 2.0, 0.0], [2.0, 4.0, 0.0], [0.0, 0.0, 0.0]])
    assert given_last(covariance, 2) == pytest.approx(np.array([[3.0]]))


def test_turning_about_one_axis_only_is_refused():
    rng, views, shaken = np.random.default_rng(0), [], []
    for angle in np.linspace(-0.3, 0.3, 8):
        joint_pos = HOME + np.array((angle, 0, 0, 0, 0, 0))
        view = BoardView(points=CORNERS, pixels=pixels_of(board_in_camera(joint_pos), CORNERS, lens()))
        views.append(HandView(name=f"{angle:.2f}", view=view, palm=palm(joint_pos)))
        shaken.append(replace(views[-1], palm=palm(joint_pos + rng.normal(0, 5e-4, 6))))
    for turned in (views, shaken):
        with pytest.raises(PerceptionError, match="turned about one axis; add other turns"):
            calibrate(turned, lens())


def test_rows_of_other_images_are_refused():
    views = hand_views(8)
    pairs = zip(views, [*views[3:], *views[:3]], strict=True)
    mixed = [replace(view, palm=other.palm) for view, other in pairs]
    with pytest.raises(PerceptionError, match="do the table's rows fit them"):
        calibrate(mixed, lens())


PATHS = sample_paths(ThrowCfg(), 50).reshape(-1, 3).numpy()


def turned(axis: tuple[float, float, float], angle: float) -> CameraSpec:
    """The policies' camera turned about an axis of its own [rad]."""
    w, x, y, z = (LEVEL * Rotation.from_rotvec(angle * np.array(axis))).as_quat(scalar_first=True).tolist()
    return replace(RGB_CAMERA, quat=(w, x, y, z))


MOVED = (RGB_CAMERA.pos[0] + 0.2, RGB_CAMERA.pos[1], RGB_CAMERA.pos[2] - 0.1)


def two_metres_ahead(*direction: float) -> np.ndarray:
    """A point that the camera sees in a direction of its own axes: right, down, forward."""
    return (np.array(RGB_CAMERA.pos) + 2.0 * LEVEL.apply(direction))[None]


def compared(camera: CameraSpec, points: np.ndarray = PATHS, **more) -> Comparison:
    return compare(CameraFile(camera=camera, **more), RGB_CAMERA, points)


def test_a_shift_displaces_all_and_a_turn_by_the_focal_length_times_its_tangent():
    shifted = compared(replace(RGB_CAMERA, cx=RGB_CAMERA.cx + 3.0, cy=RGB_CAMERA.cy - 4.0))
    assert (shifted.mean, shifted.largest) == pytest.approx((5.0, 5.0))
    angle = radians(2.0)
    result = compared(turned((0.0, 1.0, 0.0), angle), two_metres_ahead(0.0, 0.0, 1.0))
    assert result.mean == pytest.approx(RGB_CAMERA.fx * tan(angle), rel=1e-6)
    assert result.turn == pytest.approx((0.0, -angle, 0.0), abs=1e-9)


@pytest.mark.parametrize(
    ("camera", "words"),
    [
        (turned((1.0, 0.0, 0.0), radians(5.0)), "-5.0° up"),
        (turned((0.0, 1.0, 0.0), radians(5.0)), "-5.0° right"),
        (replace(RGB_CAMERA, pos=MOVED), "move the camera by (-20.0, +0.0, +10.0) cm"),
    ],
)
def test_a_camera_that_was_moved_is_to_be_moved_back(camera: CameraSpec, words: str):
    assert words in " ".join(advice(compared(camera)))


def test_a_lens_displaces_as_its_formula_says():
    """With k1 alone a point at (x, y) is seen at (1 + k1 r²) times that."""
    result = compared(RGB_CAMERA, two_metres_ahead(0.3, 0.0, 1.0), distortion=(-0.1, 0.0, 0.0, 0.0))
    assert result.lens == pytest.approx(RGB_CAMERA.fx * 0.3 * 0.1 * 0.3**2, rel=1e-6)
    assert result.mean == pytest.approx(result.lens)
    assert "--rectified" in " ".join(advice(result))


def test_uncertainty_is_given_in_pixels():
    """A turn about the optical axis's own down direction moves the middle by the focal length times it."""
    down = LEVEL.apply((0, 1, 0))
    covariance = np.array(NO_POSE_ERROR)
    covariance[3:, 3:] = 0.02**2 * np.outer(down, down)
    rows = tuple(tuple(row) for row in covariance.tolist())
    result = compared(RGB_CAMERA, two_metres_ahead(0.0, 0.0, 1.0), pose_covariance=rows)
    assert result.uncertainty == pytest.approx(RGB_CAMERA.fx * 0.02, rel=0.15)
    assert "add images" in " ".join(advice(result))
