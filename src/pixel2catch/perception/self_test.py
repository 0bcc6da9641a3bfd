"""A test of a segmenter on three painted throws of a ball, whose boxes are known: it needs no video."""

from collections.abc import Iterator, Sequence

import cv2
import numpy as np

from pixel2catch.camera.image import Edges, Image, Verdict
from pixel2catch.errors import PerceptionError
from pixel2catch.mdp.sensing import SensingCfg
from pixel2catch.perception.background import BackgroundSubtraction
from pixel2catch.perception.segmenter import BoxPrompt, Segmenter
from pixel2catch.perception.tracker import ObjectTracker, Prompter
from pixel2catch.scene.constants import CONTROL_DT, RGB_CAMERA

KINDS = ("plain", "clutter", "occlusion")
NUM_EMPTY, NUM_FLYING = 40, 26  #: Images of the room alone, and of the flight.
RED, RADIUS = (200, 40, 30), 14.0  #: Of the ball: colour, and radius [px].
POST = slice(264, 284)  #: Columns of the post before the ball, in the throw with occlusion [px].
NUM_THINGS = 60  #: Coloured things behind the ball, in the throw with clutter.
LEAST_RIGHT = 0.75  #: Smallest share of images with a right box in each throw. Source: ours.


def agreement(segmenter: Segmenter, name: str) -> Iterator[str]:
    """Yield for each throw in how many images the boxes are right, then that they agree, or raise."""
    shares = list[float]()
    for kind in KINDS:
        throw = list(painted_throw(kind))
        shares.append(_share_right(segmenter, throw))
        other = _share_right(BackgroundSubtraction(), throw)
        yield f"{kind}: right boxes in {100 * shares[-1]:.0f} % by {name}, {100 * other:.0f} % by background."
    if min(shares) < LEAST_RIGHT:
        raise PerceptionError(f"{name} does not agree with the truth: try another one, or background.")
    yield f"{name} agrees with the truth."


def painted_throw(kind: str) -> Iterator[tuple[Image, Edges | None]]:
    """Yield images of a throw at the control rate, each with the ball's box [px] if all of it is visible."""
    rng, (width, height) = np.random.default_rng(0), (RGB_CAMERA.width, RGB_CAMERA.height)
    texture = cv2.GaussianBlur(rng.normal(size=(height, width, 1)), (0, 0), 4)[..., None]
    room = np.repeat(125 + 25 * texture / texture.std(), 3, axis=2).astype(np.int16)
    noise = rng.normal(0.0, 2.5, room.shape).astype(np.int16)
    for _ in range(NUM_THINGS if kind == "clutter" else 0):
        u, v = rng.integers(0, (width, height))
        room[v : v + rng.integers(10, 50), u : u + rng.integers(10, 50)] = rng.integers(0, 256, 3)
    rows, columns = np.ogrid[:height, :width]
    for step in range(NUM_EMPTY + NUM_FLYING):
        picture, time = room.copy(), step - NUM_EMPTY
        u, v = 60.0 + 18.0 * time, 300.0 - 13.0 * time + 0.375 * time**2
        is_visible = time >= 0
        if is_visible:
            picture[(columns + 0.5 - u) ** 2 + (rows + 0.5 - v) ** 2 <= RADIUS**2] = RED
        if kind == "occlusion":
            picture[:, POST] = room[:, POST] // 2
            is_visible &= not POST.start - RADIUS < u < POST.stop + RADIUS
        noisy = np.clip(picture + np.roll(noise, 37 * step, axis=1), 0, 255).astype(np.uint8)
        box = (u - RADIUS, v - RADIUS, u + RADIUS, v + RADIUS)
        yield Image(pixels=noisy, stamp=step * CONTROL_DT), box if is_visible else None


def _share_right(segmenter: Segmenter, throw: Sequence[tuple[Image, Edges | None]]) -> float:
    """Return the share of images whose box is within the noise of training; the first box is given."""
    prompter, right = Prompter(), list[bool]()
    tracker = ObjectTracker(segmenter, prompter, waits=True)
    for image, truth in throw:
        if truth and not right:
            tracker.reset()
            prompter.give(BoxPrompt(box=truth))
        box = tracker.step(image, image.stamp)
        if truth:
            error = np.abs(np.subtract(box.edges, truth)).max()
            right.append(box.verdict is Verdict.SEEN and bool(error <= SensingCfg().corner_noise))
    return sum(right) / len(right)
