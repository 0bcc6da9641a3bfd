"""The camera file, which a calibration writes and training, evaluation and perception read."""

from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from math import sqrt
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from pixel2catch.camera.pinhole import Projection, nominal_projection
from pixel2catch.checks import Share, Within, require_valid
from pixel2catch.devices import constant
from pixel2catch.errors import InvalidValueError
from pixel2catch.files import decoded, json_text, read_json_object, reading, take_version, write_atomically
from pixel2catch.robots.poses import quaternion
from pixel2catch.scene.constants import CAMERAS, CameraSpec

FORMAT_VERSION = 1  #: Version of the files. Raised when an older one can no longer be read.

LENS_SIZES = (0, 4, 5, 8)  #: Numbers of parameters of the lens models: none, and OpenCV's.
LARGEST_IMAGE = 8192  #: Width and height of the largest images [px]. Source: ours.
LARGEST_VARIANCE = 100.0  #: Of a position [m²] and of an orientation [rad²]. Source: ours.
NO_POSE_ERROR = ((0.0,) * 6,) * 6  #: Covariance of a pose without errors.

Covariance = Annotated[tuple[tuple[float, ...], ...], Within(-LARGEST_VARIANCE, LARGEST_VARIANCE)]


@dataclass(frozen=True, kw_only=True)
class CameraFile:
    """A calibrated camera and its uncertainty."""

    camera: CameraSpec  #: The camera as a pinhole; the middle of the first pixel is (0.5, 0.5).
    #: (k1, k2, p1, p2[, k3[, k4, k5, k6]]) of OpenCV; () if rectified.
    distortion: tuple[Annotated[float, Within(-1e3, 1e3)], ...] = ()
    #: Covariance (6 x 6) of position [m] and of a small turn about the centre [rad], along the world's axes.
    pose_covariance: Covariance = NO_POSE_ERROR
    focal_std: Share | None = None  #: Standard deviation, relative to the focal length; None if unknown.

    def __post_init__(self) -> None:
        require_valid(self)
        if len(self.distortion) not in LENS_SIZES:
            raise InvalidValueError(f"distortion has {len(self.distortion)} numbers, not 0, 4, 5 or 8")
        rows = self.pose_covariance
        if len(rows) != 6 or any(len(row) != 6 for row in rows):
            raise InvalidValueError("pose_covariance must have 6 rows of 6 numbers")
        matrix = np.array(rows)
        is_symmetric, rounding = np.allclose(matrix, matrix.T), 1e-6 * matrix.trace() + 1e-12
        if not is_symmetric or np.linalg.eigvalsh(matrix)[0] < -rounding:
            raise InvalidValueError("pose_covariance must be symmetric, without negative variances")

    @property
    def pose_std(self) -> tuple[float, ...]:
        """Standard deviations of position [m] and orientation [rad], along the axes of the world."""
        return tuple(sqrt(row[i]) for i, row in enumerate(self.pose_covariance))

    @property
    def is_exact(self) -> bool:
        """Whether neither the pose nor the focal length has an uncertainty."""
        return not any((*self.pose_std, self.focal_std))

    def sample(self, num_envs: int, generator: torch.Generator) -> Projection:
        """Draw cameras within the uncertainty of this one, on the generator's device, as pinholes."""
        draws = torch.randn(num_envs, 7, generator=generator, device=generator.device)
        spread = constant(_spread(self.pose_covariance), draws.device)
        pose: Float[Tensor, "num_envs 6"] = draws[:, :6] @ spread.T
        factor = 1.0 + (self.focal_std or 0.0) * draws[:, 6]
        nominal = nominal_projection(self.camera, draws)
        return nominal.zoomed(factor, self.camera).turned(pose[:, 3:]).moved(pose[:, :3])

    def drawn(self, seed: int) -> CameraSpec:
        """Return the camera that a seed draws within the uncertainty of this one."""
        if self.is_exact:
            return self.camera
        spec, drawn = self.camera, self.sample(1, torch.Generator().manual_seed(seed))
        u, v, forward = drawn.matrix[0].double().numpy()
        axes = np.stack((u - spec.cx * forward, v - spec.cy * forward, forward), axis=1)
        fx, fy, _ = sizes = np.linalg.norm(axes, axis=0).tolist()
        pos, quat = drawn.center[0].tolist(), quaternion(axes / sizes).tolist()
        return replace(spec, fx=fx, fy=fy, pos=tuple(pos), quat=tuple(quat))

    def save(self, path: Path) -> None:
        """Write the file, all of it or nothing. Its folder must exist."""
        write_atomically({path: json_text({"format_version": FORMAT_VERSION, **asdict(self)})})

    @classmethod
    def load(cls, path: Path) -> "CameraFile":
        """Read a file, or return the camera of a name in `CAMERAS` where no such file is."""
        if str(path) in CAMERAS and not path.exists():
            return cls(camera=CAMERAS[str(path)])
        with reading("camera file", path, "Calibrate again, or correct that entry."):
            content = read_json_object(path)
            take_version(content, FORMAT_VERSION)
            return decoded(cls, content)


@lru_cache(maxsize=16)
def _spread(covariance: tuple[tuple[float, ...], ...]) -> tuple[tuple[float, ...], ...]:
    """Return a factor L of a covariance L Lᵀ, 6 x 6."""
    shares, axes = np.linalg.eigh(np.asarray(covariance))
    return tuple(map(tuple, (axes * np.sqrt(shares.clip(min=0.0))).tolist()))
