"""What differs from a background that is learned from the images themselves."""

from dataclasses import dataclass

import cv2
import numpy as np

from pixel2catch.perception.segmenter import Image, Mask

SPECK = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
"""What is smaller than this cross is noise [px]."""

GAP = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (5, 5))
"""Pieces of one thing that are no further apart than this belong together [px]."""

FOREGROUND = 255
"""What OpenCV calls the foreground; shadows are 127."""


@dataclass(frozen=True, kw_only=True)
class ForegroundCfg:
    """How the background is learned.

    Attributes:
        memory: Images that the background is made of. Source: ours: 10 s at 30 Hz.
        threshold: Squared distance of a pixel from the background, in variances, from which it differs.
            Source: OpenCV, its default.
        learning_images: Images that a pixel must have been seen in without the robot before its changes mean
            anything: a tenth of the memory, after which OpenCV takes something new for background.
    """

    memory: int = 300
    threshold: float = 16.0
    learning_images: int = 30


class Foreground:
    """Which pixels differ from the background, in a stream of images.

    Where pixels are ignored the background is not learned: the robot that waits for a throw is not taken for
    background, and neither is what it uncovers taken for an object.
    """

    def __init__(self, cfg: ForegroundCfg) -> None:
        """Know no background."""
        self._cfg = cfg
        self._model = cv2.createBackgroundSubtractorMOG2(cfg.memory, cfg.threshold, detectShadows=True)
        self._scene = np.empty((0, 0, 3), dtype=np.uint8)
        self._num_seen = np.empty((0, 0), dtype=np.uint8)

    def step(self, image: Image, ignored: Mask | None) -> tuple[Mask, Mask]:
        """Learn an image.

        Args:
            image: The next image.
            ignored: Pixels of it that do not belong to the scene; None for no such pixel.

        Returns:
            Which pixels differ from the background; and in which that cannot be told.
        """
        if self._scene.shape != image.shape:
            self._scene = image.copy()
            self._num_seen = np.zeros(image.shape[:2], dtype=np.uint8)
        counted = np.ones_like(self._num_seen) if ignored is None else (~ignored).view(np.uint8)
        cv2.copyTo(image, counted, self._scene)
        cv2.add(self._num_seen, counted, self._num_seen)
        pixels = (self._model.apply(self._scene) == FOREGROUND).view(np.uint8)
        pixels = cv2.morphologyEx(pixels, cv2.MORPH_OPEN, SPECK)
        unknown = (counted == 0) | (self._num_seen < self._cfg.learning_images)
        return (pixels > 0) & ~unknown, unknown
