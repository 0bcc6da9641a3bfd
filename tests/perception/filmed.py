"""The images that perception is tested with, painted with known truth; one throw of them as files."""

from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from pixel2catch.camera.image import Mask, Pixels
from pixel2catch.files import json_text
from pixel2catch.perception.background import BackgroundSubtraction
from pixel2catch.perception.foreground import Foreground
from pixel2catch.perception.labels import FORMAT_VERSION, Labels
from pixel2catch.perception.segmenter import Prompt, Segmentation, Segmenter
from pixel2catch.rendering.video import write_video
from pixel2catch.scene.constants import RGB_CAMERA
from ros_bags import EPOCH, TYPES, Message, header

HEIGHT, WIDTH = 240, 320
RED = (200, 40, 30)
BLUE = (30, 60, 200)
NUM_EMPTY = 40


@dataclass(frozen=True, kw_only=True)
class Disc:
    path: np.ndarray
    radius: float
    color: tuple[int, int, int] = RED
    transparency: float = 0.0  # share of the light behind it

    def mask(self, step: int) -> Mask:
        (u, v), (rows, columns) = self.path[step], np.ogrid[:HEIGHT, :WIDTH]
        return (columns + 0.5 - u) ** 2 + (rows + 0.5 - v) ** 2 <= self.radius**2


class Follower:
    def __init__(self, segmenter: Segmenter | None = None) -> None:
        self.segmenter = segmenter or BackgroundSubtraction()
        self.foreground = Foreground()

    def find(
        self, image: Pixels, prompt: Prompt = None, ignored: Mask | None = None, interval: float = 1.0
    ) -> Segmentation:
        motion = self.foreground.step(image, ignored)
        motion = motion if prompt is None else self.foreground.reveal(motion, prompt)
        found = self.segmenter.find(image, motion, prompt, interval)
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
            mask, share = disc.mask(step), disc.transparency
            picture[mask] = share * picture[mask] + (1.0 - share) * np.array(disc.color)
        yield np.clip(picture + rng.normal(0, noise, picture.shape), 0, 255).astype(np.uint8)


def thrown(num_still: int, num_flying: int) -> np.ndarray:
    """Away, held still at the left, then thrown to the right: middle of the object in every image [px]."""
    away = np.full((NUM_EMPTY, 2), -100.0)
    start = np.array((40.0, 150.0))
    times = np.arange(1, num_flying + 1)[:, None]
    flight = start + times * (11.0, -14.0) + 0.5 * times**2 * (0.0, 1.2)
    return np.concatenate((away, np.tile(start, (num_still, 1)), flight))


def box_of(mask: Mask) -> np.ndarray:
    rows, columns = np.nonzero(mask)
    return np.array((columns.min(), rows.min(), columns.max() + 1, rows.max() + 1), dtype=float)


NUM_STILL, NUM_FLYING = 5, 15
PATH = thrown(NUM_STILL, NUM_FLYING)
DISC = Disc(path=PATH, radius=7)
HELD = 41
"""An image in which the object is held still."""

CAMERA = replace(RGB_CAMERA, width=WIDTH, height=HEIGHT, cx=WIDTH / 2, cy=HEIGHT / 2)
"""A camera of the size of the painted images: a quarter of the pixels, a quarter of the time."""


def save_labels(path: Path, labels: Labels) -> None:
    path.write_text(json_text({"format_version": FORMAT_VERSION, **asdict(labels)}))


def throw() -> Iterator[Pixels]:
    return images((DISC,), len(PATH))


def box_at(step: int) -> list[str]:
    """The object's box, as words of a command."""
    (u, v), reach = PATH[step], DISC.radius + 1.0
    return [f"{edge:g}" for edge in (u - reach, v - reach, u + reach, v + reach)]


def save_video(path: Path, pictures: Iterable[Pixels], fps: int = 30) -> Path:
    write_video(path, pictures, fps=fps, crf=12)
    return path


def stamp_of(step: int) -> int:
    """When an image was taken [ns]."""
    return EPOCH * 10**9 + step * 33_333_333


def raw(step: int, pixels: np.ndarray, encoding: str = "rgb8", padding: int = 0) -> Message:
    """A `sensor_msgs/Image`, received 20 ms after it was taken, with unused bytes at the end of each row."""
    height, width, channels = pixels.shape
    rows = np.zeros((height, channels * width + padding), dtype=np.uint8)
    rows[:, : channels * width] = pixels.reshape(height, -1)
    size = {"height": height, "width": width, "step": rows.shape[1], "is_bigendian": 0}
    stamp = stamp_of(step)
    message = TYPES["sensor_msgs/msg/Image"](
        header=header(stamp), encoding=encoding, data=rows.reshape(-1), **size
    )
    return "/camera/image_raw", stamp + 20_000_000, message


def compressed(step: int, data: bytes, kind: str = "rgb8; jpeg compressed bgr8") -> Message:
    """A `sensor_msgs/CompressedImage`."""
    stamp = stamp_of(step)
    message = TYPES["sensor_msgs/msg/CompressedImage"](
        header=header(stamp), format=kind, data=np.frombuffer(data, dtype=np.uint8)
    )
    return "/camera/image_raw/compressed", stamp + 20_000_000, message


def jpeg(image: Pixels) -> bytes:
    return cv2.imencode(".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR))[1].tobytes()
