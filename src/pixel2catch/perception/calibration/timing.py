"""Measure the camera's stamps by a moving board: their offset, and the readout time of a rolling shutter.

A corner of the board is a smooth function of the joint positions. Its time is the image's stamp, less the
offset, and later by the share of the readout time of its row. The two times are those with which a polynomial
in the joint positions fits the corners best.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import combinations_with_replacement

import numpy as np
from jaxtyping import Float

from pixel2catch.errors import PerceptionError
from pixel2catch.perception.calibration.capture import topic_images
from pixel2catch.perception.calibration.lens import BoardView, CharucoBoard
from pixel2catch.ros2.profile import Profile
from pixel2catch.ros2.transport import Clock, Transport

SECONDS = 20.0  #: Duration of the motion [s]. Source: ours.
LEAST_IMAGES = 100  #: Smallest number of images with the board. Source: ours, five for each coefficient.
LEAST_SHARE = 0.8  #: Share of the views of the best corner that a corner must have. Source: ours.
LEAST_MOTION = 0.002  #: Standard deviation from which joints moved in a direction [rad]. Source: ours.
LARGEST_STD = 1e-3  #: Standard deviation up to which a time counts as measured [s]. Source: ours.
STEP, NUM_STEPS = 1e-3, 5  #: Step of a difference [s] and number of steps of the fit. Source: ours.


@dataclass(frozen=True, kw_only=True)
class Timing:
    """Times of a camera, with their standard deviations [s]."""

    stamp_offset: float  #: From the middle of the exposure of the middle row to the stamp.
    readout_time: float  #: From the first row to the last.
    offset_std: float
    readout_std: float


@dataclass(frozen=True, kw_only=True)
class BoardMotion:
    """Views of a board, and joint positions, with their stamps [s]."""

    views: list[tuple[float, BoardView]] = field(default_factory=list)
    joints: list[tuple[float, Float[np.ndarray, " num_joints"]]] = field(default_factory=list)

    def timing(self, height: int) -> Timing:
        """Fit the times of a camera with images of a height [px]; refuse too little motion."""
        if min(len(self.views), len(self.joints)) < LEAST_IMAGES:
            raise PerceptionError(
                f"the board was found in {len(self.views)} images, with {len(self.joints)} joint states; "
                f"{LEAST_IMAGES} are needed: keep all of it in the image for {SECONDS:.0f} s"
            )
        seen: dict[tuple[float, ...], list[tuple[float, float, float]]] = {}
        for stamp, view in self.views:
            for point, (u, v) in zip(view.points, view.pixels, strict=True):
                seen.setdefault(tuple(point), []).append((stamp, u, v))
        most = max(map(len, seen.values()))
        tracks = [np.array(each) for each in seen.values() if len(each) >= LEAST_SHARE * most]
        times, scores = self._scores()

        def residuals(offset: float, readout: float) -> Float[np.ndarray, " num_residuals"]:
            left = []
            for stamp, u, v in (track.T for track in tracks):
                taken = stamp - offset + readout * (v / height - 0.5)
                pos = np.stack([np.interp(taken, times, score) for score in scores.T], axis=1)
                terms, pixels = _polynomial(pos), np.stack((u, v), axis=1)
                left.append(pixels - terms @ np.linalg.lstsq(terms, pixels, rcond=None)[0])
            return np.concatenate(left).ravel()

        fitted, slopes, remaining = np.zeros(2), np.zeros((2, 0)), np.zeros(0)
        for _ in range(NUM_STEPS):
            pairs = ((residuals(*(fitted + step)), residuals(*(fitted - step))) for step in STEP * np.eye(2))
            slopes = np.stack([(later - earlier) / (2.0 * STEP) for later, earlier in pairs])
            remaining = residuals(*fitted)
            fitted -= np.linalg.lstsq(slopes.T, remaining, rcond=None)[0]
        # Corners of one image share their errors, so that only images count.
        variance = np.mean(remaining**2) * 2.0 * len(tracks)
        deviations = np.sqrt(variance * np.diag(np.linalg.pinv(slopes @ slopes.T)))
        if deviations.max() > LARGEST_STD:
            known = f"the times are known to {1e3 * deviations.max():.1f} ms only"
            raise PerceptionError(f"{known}: move the board faster, over all rows of the image")
        (offset, readout), (offset_std, readout_std) = fitted.tolist(), deviations.tolist()
        return Timing(
            stamp_offset=offset, readout_time=readout, offset_std=offset_std, readout_std=readout_std
        )

    def _scores(self) -> tuple[Float[np.ndarray, " num_states"], Float[np.ndarray, "num_states num_axes"]]:
        """Return the stamps of the joint states [s], and their positions along the directions that moved."""
        times, joint_pos = (np.array(each) for each in zip(*self.joints, strict=True))
        moved = joint_pos - joint_pos.mean(axis=0)
        _, spread, axes = np.linalg.svd(moved, full_matrices=False)
        scores = moved @ axes[spread > LEAST_MOTION * np.sqrt(len(moved))].T
        if not scores.size:
            raise PerceptionError("the arm did not move: move the board fast, up and down in the image")
        return times, scores / scores.std(axis=0)


def _polynomial(values: Float[np.ndarray, "num size"]) -> Float[np.ndarray, "num terms"]:
    choices = [each for n in range(4) for each in combinations_with_replacement(range(values.shape[1]), n)]
    return np.stack([values[:, each].prod(axis=1) for each in choices], axis=1)


def watch(
    transport: Transport, clock: Clock, profile: Profile, joints: Sequence[str], board: CharucoBoard
) -> BoardMotion:
    """Collect views of a board and positions of some joints for `SECONDS`."""
    motion, end = BoardMotion(), clock.now() + SECONDS
    for image in topic_images(transport, profile, joints, motion.joints, 8):
        if image is not None and (view := board.find(image.pixels)):
            motion.views.append((image.stamp, view))
        if clock.now() >= end:
            break
    return motion
