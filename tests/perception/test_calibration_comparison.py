"""How far a camera is from a policy's: hand-worked displacements, and what is advised."""

from dataclasses import replace
from math import radians, tan

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pixel2catch.camera.camera_file import NO_POSE_ERROR, CameraFile
from pixel2catch.mdp.throws import ThrowCfg, sample_paths
from pixel2catch.perception.calibration.comparison import Comparison, advice, compare
from pixel2catch.scene.constants import RGB_CAMERA, CameraSpec

PATHS = sample_paths(ThrowCfg(), 50).reshape(-1, 3).numpy()


def turned(axis: tuple[float, float, float], angle: float) -> CameraSpec:
    """The policies' camera turned about an axis of its own [rad]."""
    turn = Rotation.from_quat(RGB_CAMERA.quat, scalar_first=True) * Rotation.from_rotvec(
        angle * np.array(axis)
    )
    w, x, y, z = turn.as_quat(scalar_first=True).tolist()
    return replace(RGB_CAMERA, quat=(w, x, y, z))


def compared(camera: CameraSpec, points: np.ndarray = PATHS, **more) -> Comparison:
    return compare(CameraFile(camera=camera, **more), RGB_CAMERA, points)


def test_a_shift_of_the_optical_axis_shifts_all():
    result = compared(replace(RGB_CAMERA, cx=RGB_CAMERA.cx + 3.0, cy=RGB_CAMERA.cy - 4.0))
    assert (result.mean, result.largest) == pytest.approx((5.0, 5.0))


def test_a_turn_displaces_the_middle_by_the_focal_length_times_its_tangent():
    angle = radians(2.0)
    axis = Rotation.from_quat(RGB_CAMERA.quat, scalar_first=True).as_matrix()[:, 2]
    middle = (np.array(RGB_CAMERA.pos) + 2.0 * axis)[None]
    result = compared(turned((0.0, 1.0, 0.0), angle), middle)
    assert result.mean == pytest.approx(RGB_CAMERA.fx * tan(angle), rel=1e-6)
    assert result.turn == pytest.approx((0.0, -angle, 0.0), abs=1e-9)


@pytest.mark.parametrize(
    ("camera", "words"),
    [
        (turned((1.0, 0.0, 0.0), radians(5.0)), "-5.0° up"),
        (turned((0.0, 1.0, 0.0), radians(5.0)), "-5.0° right"),
        (
            replace(RGB_CAMERA, pos=(RGB_CAMERA.pos[0] + 0.2, RGB_CAMERA.pos[1], RGB_CAMERA.pos[2] - 0.1)),
            "move the camera by (-20.0, +0.0, +10.0) cm",
        ),
    ],
)
def test_a_camera_that_was_moved_is_to_be_moved_back(camera: CameraSpec, words: str):
    assert words in " ".join(advice(compared(camera)))


def test_a_lens_displaces_as_its_formula_says():
    """With k1 alone a point at (x, y) is seen at (1 + k1 r²) times that."""
    k1, right = -0.1, Rotation.from_quat(RGB_CAMERA.quat, scalar_first=True).apply((0.3, 0.0, 1.0))
    point = (np.array(RGB_CAMERA.pos) + 2.0 * right)[None]
    result = compared(RGB_CAMERA, point, distortion=(k1, 0.0, 0.0, 0.0))
    assert result.lens == pytest.approx(RGB_CAMERA.fx * 0.3 * 0.1 * 0.3**2, rel=1e-6)
    assert result.mean == pytest.approx(result.lens)
    assert "--rectified" in " ".join(advice(result))


def test_uncertainty_is_given_in_pixels():
    """A turn about the optical axis's own down direction moves the middle by the focal length times it."""
    level = Rotation.from_quat(RGB_CAMERA.quat, scalar_first=True)
    middle = (np.array(RGB_CAMERA.pos) + 2.0 * level.apply((0, 0, 1)))[None]
    down = level.apply((0, 1, 0))
    covariance = np.array(NO_POSE_ERROR)
    covariance[3:, 3:] = 0.02**2 * np.outer(down, down)
    rows = tuple(tuple(row) for row in covariance.tolist())
    result = compared(RGB_CAMERA, middle, pose_covariance=rows)
    assert result.uncertainty == pytest.approx(RGB_CAMERA.fx * 0.02, rel=0.15)
    assert "add images" in " ".join(advice(result))
