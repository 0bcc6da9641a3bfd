"""Images of any size made as large as those of the policies' camera, and boxes, points, cameras likewise."""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import UInt8

from pixel2catch.camera.image import Edges, Pixels
from pixel2catch.errors import PerceptionError
from pixel2catch.scene.constants import RGB_CAMERA, CameraSpec

Size = tuple[int, int]  #: Width and height [px].

SAME_SHAPE = 0.02
"""Largest relative difference of the aspect ratios of a camera file and of the images that it is for: what
rounding to whole pixels makes of one. Source: ours."""


@dataclass(frozen=True, kw_only=True)
class ImageFit:
    """How images of one size are made to have another: scaled alike along both axes, then framed in black."""

    own: Size  #: Of the images as they are.
    size: Size  #: Of the images as they are made.

    @property
    def changes(self) -> bool:
        """Whether images become others."""
        return self.own != self.size

    @property
    def _inner(self) -> Size:
        """Of the scaled image in the frame."""
        scale = min(self.size[0] / self.own[0], self.size[1] / self.own[1])
        return round(scale * self.own[0]), round(scale * self.own[1])

    @property
    def _factors(self) -> tuple[float, float]:
        """By which widths and heights are multiplied."""
        return self._inner[0] / self.own[0], self._inner[1] / self.own[1]

    @property
    def _corner(self) -> Size:
        """Where the scaled image is in the frame: column and row of its first pixel."""
        return (self.size[0] - self._inner[0]) // 2, (self.size[1] - self._inner[1]) // 2

    def image(self, image: Pixels) -> UInt8[np.ndarray, "rows columns 3"]:
        """Return an image as it is made; one of yet another size as it is."""
        if not self.changes or (image.shape[1], image.shape[0]) != self.own:
            return image
        method = cv2.INTER_AREA if self._factors[0] < 1.0 else cv2.INTER_LINEAR
        inner = cv2.resize(image, self._inner, interpolation=method)
        (left, top), (width, height) = self._corner, self._inner
        right, bottom = self.size[0] - left - width, self.size[1] - top - height
        return cv2.copyMakeBorder(inner, top, bottom, left, right, cv2.BORDER_CONSTANT)

    def point(self, point: tuple[float, float]) -> tuple[float, float]:
        """Return where a point of an image is in the image as it is made."""
        (fx, fy), (left, top) = self._factors, self._corner
        return fx * point[0] + left, fy * point[1] + top

    def box(self, box: Edges) -> Edges:
        """Return where a box of an image is in the image as it is made."""
        return *self.point(box[:2]), *self.point(box[2:])

    def camera(self, camera: CameraSpec) -> CameraSpec:
        """Return the camera that would take the images as they are made, of the one that takes them."""
        (fx, fy), (cx, cy) = self._factors, self.point((camera.cx, camera.cy))
        width, height = self.size
        return replace(camera, width=width, height=height, fx=fx * camera.fx, fy=fy * camera.fy, cx=cx, cy=cy)


def camera_for(own: Size, calibrated: CameraSpec | None) -> tuple[ImageFit, CameraSpec]:
    """Return how images of a size are made to fit, and the camera that would take them then.

    They become as large as the policies' images, except those of a calibrated camera that is no larger.

    Args:
        own: Of the images as they are.
        calibrated: The camera that took them, if it is known.

    Raises:
        PerceptionError: That camera's images have another shape.
    """
    usual = (RGB_CAMERA.width, RGB_CAMERA.height)
    fit = ImageFit(own=own, size=usual)
    if calibrated is None:
        return fit, RGB_CAMERA
    size = (calibrated.width, calibrated.height)
    if abs(own[0] * size[1] / (own[1] * size[0]) - 1.0) > SAME_SHAPE:
        raise PerceptionError(
            f"the images have {own[0]} by {own[1]} px, those of the camera file {size[0]} by {size[1]}, "
            "another shape: calibrate the camera at the size of the images, or leave --camera out."
        )
    if own == size and own[0] <= usual[0] and own[1] <= usual[1]:
        return ImageFit(own=own, size=own), calibrated
    return fit, fit.camera(ImageFit(own=size, size=own).camera(calibrated))
