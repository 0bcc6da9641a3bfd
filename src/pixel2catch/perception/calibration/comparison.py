"""How far a calibrated camera is from the one that a policy was trained with [px], and what to do."""

from collections.abc import Iterator
from dataclasses import dataclass
from math import degrees

import cv2
import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from pixel2catch.camera.camera_file import CameraFile
from pixel2catch.camera.pinhole import is_in_view, project
from pixel2catch.mdp.sensing import SensingCfg
from pixel2catch.perception.calibration.lens import lens_values
from pixel2catch.scene.constants import CameraSpec, Vec3

NUM_DRAWS = 100  #: Cameras that are drawn to estimate the effect of the uncertainty.

LARGEST_LENS_ERROR = 1.0  #: By the lens without rectified images [px]. Source: ours, 1/5 of training's noise.
LARGEST_UNSEEN = 0.02  #: Largest share of the paths out of the image. Source: ours.


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """Where points that the policy's camera sees are in the calibrated camera's image."""

    mean: float  #: Mean distance between the two places [px].
    largest: float  #: Largest distance [px].
    unseen: float  #: Share of the points that are out of the calibrated camera's image.
    lens: float  #: Largest distance by the lens's distortion alone [px].
    uncertainty: float  #: Root mean square distance by the uncertainty of the calibration [px].
    move: Vec3  #: Translation from the camera to the policy's, world frame [m].
    turn: Vec3  #: Rotation that then turns it to the policy's, about its own right, down, forward [rad].


def compare(
    calibrated: CameraFile, policy: CameraSpec, points: Float[np.ndarray, "num_points 3"]
) -> Comparison:
    """Compare a laboratory's camera with a policy's of the same image size, at points of flights [m]."""
    wanted, in_view = _pixels(policy, points)
    points, wanted = points[in_view], wanted[in_view]
    straight, is_seen = _pixels(calibrated.camera, points)
    bent = (_lens_pixels(calibrated, points) - straight) * is_seen[:, None]
    distance = np.linalg.norm(straight + bent - wanted, axis=-1)
    drawn = calibrated.sample(NUM_DRAWS, torch.Generator().manual_seed(0))
    everywhere = torch.from_numpy(points).float().expand(NUM_DRAWS, -1, -1)
    spread = drawn.pixels(everywhere)[0].numpy() - straight
    turn = (_rotation(calibrated.camera).inv() * _rotation(policy)).as_rotvec()
    return Comparison(
        mean=float(distance.mean()),
        largest=float(distance.max()),
        unseen=1.0 - float(is_seen.mean()),
        lens=float(np.linalg.norm(bent, axis=-1).max()),
        uncertainty=float(np.sqrt((spread**2).sum(-1).mean())),
        move=tuple(np.subtract(policy.pos, calibrated.camera.pos).tolist()),
        turn=tuple(turn.tolist()),
    )


def advice(comparison: Comparison) -> Iterator[str]:
    """Yield what to do, sentence by sentence."""
    noise, is_unseen = SensingCfg().corner_noise, comparison.unseen > LARGEST_UNSEEN
    if is_unseen:
        yield f"{100 * comparison.unseen:.0f} % of the paths that the policy would see are out of the image."
    if is_unseen or comparison.mean > noise:
        x, y, z = (100 * metres for metres in comparison.move)
        up, right, clockwise = (degrees(angle) for angle in comparison.turn)
        yield (
            f"Policies are trained for {noise:g} px of noise on each edge: move the camera by ({x:+.1f}, "
            f"{y:+.1f}, {z:+.1f}) cm along the world's axes, turn it {up:+.1f}° up, {right:+.1f}° right, "
            f"{clockwise:+.1f}° clockwise, and calibrate again; or train a policy with this camera."
        )
    else:
        yield f"That is within the noise of {noise:g} px on each edge that policies are trained for."
    if comparison.lens > LARGEST_LENS_ERROR:
        yield (
            f"The lens moves pixels by up to {comparison.lens:.1f} px, and policies expect a pinhole: give "
            "them rectified images (image_proc's image_rect), and calibrate with --rectified."
        )
    if comparison.uncertainty > noise:
        yield "The calibration is less certain than that noise: add images, nearer and turned differently."


def _pixels(camera: CameraSpec, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return where a pinhole camera projects points [px], and which of them are in its image."""
    pixels, depth = project(camera, torch.from_numpy(points)[None])
    return pixels[0].numpy(), is_in_view(camera, pixels, depth)[0].numpy()


def _lens_pixels(calibrated: CameraFile, points: np.ndarray) -> np.ndarray:
    """Return where a camera projects points through its lens [px]."""
    inverse, lens = _rotation(calibrated.camera).inv(), lens_values(calibrated)[4:]
    turn, move = inverse.as_rotvec(), -inverse.apply(calibrated.camera.pos)
    return cv2.projectPoints(points, turn, move, np.array(calibrated.camera.matrix), lens)[0][:, 0]


def _rotation(camera: CameraSpec) -> Rotation:
    return Rotation.from_quat(camera.quat, scalar_first=True)
