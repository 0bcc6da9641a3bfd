"""Throws painted into images of real or rendered rooms, with exact truth, and what can go wrong with images.

A fault is a pure function of images and truths; chance comes from a generator that it gets.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from io import BytesIO
from math import inf

import av
import cv2
import numpy as np

from pixel2catch.camera.image import Edges, Pixels
from pixel2catch.perception.labels import Truth

WIDTH, HEIGHT = 640, 480
GRAVITY = 0.55  #: Of a flight in the image [px per image²]: 4 m/s², 3 m away, at 30 Hz. Source: ours.
EXPOSURE, NUM_BLURS = 0.25, 6  #: In control steps, and instants in it that are averaged for 15 px of blur.
SHADE, SHADOW = 0.65, (1.3, 0.5)  #: Share of the light in a shadow; its half axes in radii of its thing.
MARGIN = 2  #: Of the patch that is painted [px].
SUBPIXEL = 4  #: Bits of the fraction of a painted coordinate.
RIM = 0.55  #: By how much OpenCV paints smooth polygons too large [px]. Source: ours, the area of discs.

Color = tuple[int, int, int]


@dataclass(frozen=True, kw_only=True)
class Thing:
    """What is thrown: a ball, or a box that turns and shows other faces."""

    colors: tuple[Color, ...]  #: One for a ball, several for the faces of a box.
    is_box: bool = False
    spin: float = 0.35  #: Turn of a box between two images [rad].
    contrast: float | None = None  #: It has the colours of what is behind it, brighter by so many levels.
    shadow: tuple[float, float] | None = None  #: Middle of its shadow, relative to the thing [px].
    exposure: float = EXPOSURE  #: Of the camera that films it [control steps].


@dataclass(frozen=True, kw_only=True)
class Flight:
    """Where a thing is: held, then in the air. Times are in control steps."""

    start: tuple[float, float]  #: [px]
    velocity: tuple[float, float]  #: After the release [px per control step].
    sizes: tuple[float, float]  #: Radius at the release and at the end [px].
    num_held: int = 15
    num_flying: int = 26
    gravity: float = GRAVITY  #: [px per control step²].
    bounce: float = inf  #: When it bounces, after the release.
    kept: tuple[float, float] = (1.0, 1.0)  #: Factors on its velocity when it bounces.
    begin: float = 0.0  #: After the release; another thing is there from then on.

    def at(self, time: float) -> tuple[float, float, float]:
        """Middle and radius [px] so long after the release; held before it."""
        after = max(time, 0.0)
        share = min(after / self.num_flying, 1.0)
        radius = self.sizes[0] + share * (self.sizes[1] - self.sizes[0])
        first, second = min(after, self.bounce), max(after - self.bounce, 0.0)
        fallen = self.velocity[1] + self.gravity * first
        u = self.start[0] + self.velocity[0] * (first + self.kept[0] * second)
        v = self.start[1] + 0.5 * (self.velocity[1] + fallen) * first
        return u, v + self.kept[1] * fallen * second + 0.5 * self.gravity * second**2, radius


def outline(thing: Thing, flight: Flight, time: float) -> tuple[np.ndarray, Color]:
    """Corners (n, 2) [px] of a thing as it is seen, and its colour."""
    u, v, radius = flight.at(time)
    turn = thing.spin * max(time, 0.0)
    if not thing.is_box:
        angles = np.linspace(0.0, 2.0 * np.pi, 40, endpoint=False)
        return np.stack([u + radius * np.cos(angles), v + radius * np.sin(angles)], axis=1), thing.colors[0]
    wide, high = radius * (0.45 + 0.55 * abs(np.cos(1.7 * turn))), radius * 0.8
    corners = np.array([(-wide, -high), (wide, -high), (wide, high), (-wide, high)])
    cos, sin = np.cos(turn), np.sin(turn)
    face = int(1.7 * turn / (0.5 * np.pi)) % len(thing.colors)
    return corners @ np.array([[cos, sin], [-sin, cos]]) + (u, v), thing.colors[face]


def paint(image: Pixels, thing: Thing, flight: Flight, time: float) -> Pixels:
    """An image with the thing in it, blurred by its motion during the exposure, before its shadow."""
    image = image if thing.shadow is None else shadowed(image, thing.shadow, flight.at(time))
    num_blurs = round(NUM_BLURS * thing.exposure / EXPOSURE)
    instants = [time + thing.exposure * share for share in np.linspace(-0.5, 0.5, num_blurs).tolist()]
    shapes = [outline(thing, flight, instant) for instant in instants]
    corners = np.concatenate([shape for shape, _ in shapes])
    low = np.maximum(np.floor(corners.min(axis=0)).astype(int) - MARGIN, 0)
    high = np.minimum(np.ceil(corners.max(axis=0)).astype(int) + MARGIN, (image.shape[1], image.shape[0]))
    if (high <= low).any():
        return image
    window = slice(low[1], high[1]), slice(low[0], high[0])
    behind = image[window].astype(np.float32)
    cover, light = np.zeros((*behind.shape[:2], 1), np.float32), np.zeros_like(behind)
    for shape, color in shapes:
        mask = np.zeros(behind.shape[:2], dtype=np.uint8)
        spokes = shape - shape.mean(axis=0)
        inner = shape - RIM * spokes / np.linalg.norm(spokes, axis=1, keepdims=True)
        points = np.round((inner - low - 0.5) * (1 << SUBPIXEL)).astype(np.int32)
        cv2.fillPoly(mask, [points], 255, cv2.LINE_AA, SUBPIXEL)
        share = mask[..., None].astype(np.float32) / (255.0 * num_blurs)
        cover += share
        light += share * np.array(color, dtype=np.float32)
    _, v, radius = flight.at(time)
    rows = np.arange(low[1], high[1], dtype=np.float32)[:, None, None]
    shade = 1.0 - 0.3 * np.clip((rows - v) / max(radius, 1.0), -0.6, 1.0)  # light from above
    painted = behind * (1.0 - cover) + light * shade
    if thing.contrast is not None:
        painted = behind + cover * thing.contrast
    result = image.copy()
    result[window] = np.clip(np.rint(painted), 0, 255).astype(np.uint8)
    return result


def shadowed(image: Pixels, shadow: tuple[float, float], place: tuple[float, float, float]) -> Pixels:
    """An image with the soft shadow on a surface of a thing at a place with a radius [px]."""
    u, v, radius = place
    rows, columns = np.ogrid[: image.shape[0], : image.shape[1]]
    across = (columns + 0.5 - u - shadow[0]) / (SHADOW[0] * radius)
    down = (rows + 0.5 - v - shadow[1]) / (SHADOW[1] * radius)
    dark = np.clip(2.5 * (1.2 - np.hypot(across, down)), 0.0, 1.0)
    return np.rint(image * (1.0 - (1.0 - SHADE) * dark[..., None])).astype(np.uint8)


def true_box(thing: Thing, flight: Flight, time: float) -> Edges | None:
    """The box of the part of a thing that is on the image; None where less than two pixels of it are."""
    corners, _ = outline(thing, flight, time)
    (xmin, ymin), (xmax, ymax) = corners.min(axis=0).tolist(), corners.max(axis=0).tolist()
    box = max(xmin, 0.0), max(ymin, 0.0), min(xmax, float(WIDTH)), min(ymax, float(HEIGHT))
    return box if min(box[2] - box[0], box[3] - box[1]) >= 2.0 else None


@dataclass(frozen=True, kw_only=True)
class Film:
    """Images and what they show; None for images in which nothing is held yet."""

    images: tuple[Pixels, ...]
    truths: tuple[Truth | None, ...]
    times: tuple[float, ...]  #: When the images were taken [control steps].


def film(
    backgrounds: Sequence[Pixels],
    thing: Thing,
    flight: Flight,
    num_empty: int,
    *others: Flight,
    period: float = 1.0,
) -> Film:
    """A throw before backgrounds, which repeat; others of the same thing are there at the same time.

    The period is that of the images, in control steps.
    """
    images, truths = [], []
    num_images = num_empty + int((flight.num_held + flight.num_flying) / period)
    times = tuple(period * number for number in range(num_images))
    for number in range(num_images):
        time = times[number] - period * num_empty - flight.num_held
        image = backgrounds[number % len(backgrounds)]
        for other in others:
            image = paint(image, thing, other, time) if time > other.begin else image
        if number < num_empty:
            images.append(image)
            truths.append(None)
            continue
        images.append(paint(image, thing, flight, time))
        phase = "flight" if time > 0 else "held"
        truths.append(Truth(phase=phase, box=true_box(thing, flight, time)))
    return Film(images=tuple(images), truths=tuple(truths), times=times)


Fault = Callable[[Film, np.random.Generator], Film]


def scaled(image: Pixels, gain: float) -> Pixels:
    """An image with another exposure."""
    return cv2.convertScaleAbs(image, alpha=gain)


def flicker(film: Film, rng: np.random.Generator, amplitude: float = 0.06) -> Film:
    """Lamps at 100 Hz seen at 30 Hz: a third of a period from image to image, and some chance."""
    phases = 2.0 * np.pi * (np.arange(len(film.images)) / 3.0 + rng.uniform()) + rng.normal(
        0.0, 0.2, len(film.images)
    )
    images = (
        scaled(image, 1.0 + amplitude * float(np.sin(p)))
        for image, p in zip(film.images, phases, strict=True)
    )
    return replace(film, images=tuple(images))


def exposure_step(film: Film, rng: np.random.Generator, step: float = 0.15) -> Film:
    """The camera's exposure changes in flight, and stays so."""
    flying = [i for i, truth in enumerate(film.truths) if truth and truth.phase == "flight"]
    begin = flying[int(rng.integers(3, 8))]
    gain = 1.0 + step * (1.0 if rng.uniform() < 0.5 else -1.0)
    images = (scaled(image, gain) if i >= begin else image for i, image in enumerate(film.images))
    return replace(film, images=tuple(images))


def jpeg(film: Film, _: np.random.Generator, quality: int = 30) -> Film:
    """Images as a camera compresses them that is short of bandwidth."""

    def coded(image: Pixels) -> Pixels:
        _, data = cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])
        decoded = cv2.imdecode(data, cv2.IMREAD_COLOR)
        assert decoded is not None
        return np.ascontiguousarray(decoded[..., ::-1])

    return replace(film, images=tuple(map(coded, film.images)))


def shake(film: Film, rng: np.random.Generator, amplitude: float = 2.0) -> Film:
    """The camera's stand trembles: every image is moved by up to so many pixels, and the truth with it."""
    images, truths = [], []
    for image, truth in zip(film.images, film.truths, strict=True):
        dx, dy = rng.uniform(-amplitude, amplitude, 2).tolist()
        shift = np.array([[1.0, 0.0, dx], [0.0, 1.0, dy]])
        images.append(cv2.warpAffine(image, shift, (WIDTH, HEIGHT), borderMode=cv2.BORDER_REPLICATE))
        truths.append(truth and replace(truth, box=truth.box and _moved(truth.box, dx, dy)))
    return replace(film, images=tuple(images), truths=tuple(truths))


def h264(film: Film, _: np.random.Generator, crf: int = 42) -> Film:
    """Images of a video that is compressed as messengers do."""
    file = BytesIO()
    with av.open(file, "w", format="mp4") as container:
        stream = container.add_stream("h264", rate=30, options={"crf": str(crf)})
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
        for image in film.images:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        container.mux(stream.encode(None))
    file.seek(0)
    with av.open(file, "r") as coded:
        images = tuple(frame.to_ndarray(format="rgb24") for frame in coded.decode(video=0))
    return replace(film, images=images)


def dropped(film: Film, rng: np.random.Generator, share: float = 0.3) -> Film:
    """Some images are lost, but never two together, and not the one in which the object is pointed out."""
    kept, first = [0], next(i for i, truth in enumerate(film.truths) if truth)
    for i in range(1, len(film.images)):
        if i == first or kept[-1] < i - 1 or rng.uniform() >= share:
            kept.append(i)
    return Film(
        images=tuple(film.images[i] for i in kept),
        truths=tuple(film.truths[i] for i in kept),
        times=tuple(film.times[i] for i in kept),
    )


def _moved(box: Edges, dx: float, dy: float) -> Edges:
    return box[0] + dx, box[1] + dy, box[2] + dx, box[3] + dy


def noisy(image: Pixels, rng: np.random.Generator, sigma: float = 2.5) -> Pixels:
    """An image with a sensor's noise. Source: ours, as `rendering.camera` at its middle levels."""
    noise = rng.normal(0.0, sigma, image.shape).astype(np.float32)
    return np.clip(np.rint(image + noise), 0, 255).astype(np.uint8)
