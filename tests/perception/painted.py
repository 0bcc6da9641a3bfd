"""Painted image streams with known truth: things that move over a textured background, and sensor noise."""

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np

from pixel2catch.camera.image import Mask, Pixels
from pixel2catch.perception.background import BackgroundSubtraction
from pixel2catch.perception.foreground import Foreground
from pixel2catch.perception.segmenter import BoxPrompt, Segmentation, Segmenter

HEIGHT, WIDTH = 240, 320
RED = (200, 40, 30)
BLUE = (30, 60, 200)
NUM_EMPTY = 40


@dataclass(frozen=True, kw_only=True)
class Disc:
    """A disc at one place in every image."""

    path: np.ndarray
    radius: float
    color: tuple[int, int, int] = RED

    def mask(self, step: int) -> Mask:
        (u, v), (rows, columns) = self.path[step], np.ogrid[:HEIGHT, :WIDTH]
        return (columns + 0.5 - u) ** 2 + (rows + 0.5 - v) ** 2 <= self.radius**2


class Follower:
    """A segmenter with its foreground, as the tracker uses them."""

    def __init__(self, segmenter: Segmenter | None = None) -> None:
        self.segmenter = segmenter or BackgroundSubtraction()
        self.foreground = Foreground()

    def start(self, image: Pixels, prompt: BoxPrompt, ignored: Mask | None = None) -> Segmentation:
        motion = self.foreground.reveal(self.foreground.step(image, ignored), prompt)
        return self._kept(self.segmenter.start(image, prompt, motion))

    def track(self, image: Pixels, ignored: Mask | None = None) -> Segmentation:
        return self._kept(self.segmenter.track(image, self.foreground.step(image, ignored)))

    def settle(self) -> None:
        self.foreground.settle()
        self.segmenter.settle()

    def _kept(self, found: Segmentation) -> Segmentation:
        self.foreground.keep(found.mask)
        return found


def background(seed: int = 0) -> np.ndarray:
    """A texture of grey levels 60 to 190."""
    noise = np.random.default_rng(seed).normal(size=(HEIGHT, WIDTH))
    smooth = cv2.GaussianBlur(noise, (0, 0), 4)
    grey = 125 + 65 * np.clip(smooth / (3 * smooth.std()), -1, 1)
    return np.repeat(grey[..., None], 3, axis=2)


def images(discs: tuple[Disc, ...], num_steps: int, noise: float = 3.0) -> Iterator[Pixels]:
    """The discs, later ones in front, over the background, with Gaussian noise of this deviation."""
    rng, still = np.random.default_rng(1), background()
    for step in range(num_steps):
        picture = still.copy()
        for disc in discs:
            picture[disc.mask(step)] = disc.color
        yield np.clip(picture + rng.normal(0, noise, picture.shape), 0, 255).astype(np.uint8)


def thrown(num_still: int, num_flying: int) -> np.ndarray:
    """Away, held still at the left, then thrown to the right: middle of the object in every image [px]."""
    away = np.full((NUM_EMPTY, 2), -100.0)
    start = np.array((40.0, 150.0))
    times = np.arange(1, num_flying + 1)[:, None]
    flight = start + times * (11.0, -14.0) + 0.5 * times**2 * (0.0, 1.2)
    return np.concatenate((away, np.tile(start, (num_still, 1)), flight))


def box_of(mask: Mask) -> np.ndarray:
    """The box around a mask [px]."""
    rows, columns = np.nonzero(mask)
    return np.array((columns.min(), rows.min(), columns.max() + 1, rows.max() + 1), dtype=float)
