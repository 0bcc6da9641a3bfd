"""Images of a video, a ROS 2 bag or a camera, on the control clock, and how they are scaled."""

import re
import time
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import chain, islice
from pathlib import Path
from typing import TYPE_CHECKING

import av
import cv2
import numpy as np
from av.error import FFmpegError
from jaxtyping import UInt8

from pixel2catch.camera.image import Edges, Image, Pixels
from pixel2catch.errors import DeploymentError, PerceptionError
from pixel2catch.files import read_bytes, reading
from pixel2catch.ros2.bags import METADATA, BagMessage, decoded, is_bag, opened_bag
from pixel2catch.ros2.messages import COMPRESSED_IMAGE, IMAGE, MOST_PIXELS, pixels_of, unpacked_image
from pixel2catch.scene.constants import CONTROL_DT, RGB_CAMERA

if TYPE_CHECKING:
    from rosbags.interfaces import Connection

PHASE = 0.5
"""Control steps from the first image to the first tick. Source: ours; with half a step, the jitter of a
camera of 30 Hz makes no tick miss its image."""

LARGEST_QUANTISER, MEASURED_IMAGES = 32.0, 30
"""Largest mean quantiser of H.264 that is usual, and first images that measure it. Source: public videos
have 32 at most; a constant rate factor of 42 makes 33 or more of each of them."""

LONGEST_PAUSE = 150  #: Most ticks without a new image for a pause in a recording: 5 s. Source: ours.

FORMATS = "mov,mp4,m4a,3gp,3g2,mj2,matroska,webm,avi,mpeg,mpegts,ogg,gif"
OPTIONS = {"format_whitelist": FORMATS, "protocol_whitelist": "file", "max_pixels": str(MOST_PIXELS)}
"""Options of FFmpeg: formats, none of which refers to other files, and the largest number of pixels."""

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff")
MOST_IMAGE = 2**27  #: Largest image file [bytes]. Source: ours.

Size = tuple[int, int]  #: Width and height [px].


@dataclass(frozen=True, kw_only=True)
class ImageFit:
    """Scales images of one size to another, equally along both axes, with a black frame."""

    own: Size  #: Of the images as they are.
    size: Size = (RGB_CAMERA.width, RGB_CAMERA.height)  #: Of the scaled images with their frame.

    @property
    def changes(self) -> bool:
        """Whether the two sizes differ."""
        return self.own != self.size

    @property
    def _place(self) -> tuple[int, int, int, int]:
        """Left column, upper row, width and height of the scaled image in the frame [px]."""
        scale = min(self.size[0] / self.own[0], self.size[1] / self.own[1])
        width, height = round(scale * self.own[0]), round(scale * self.own[1])
        return (self.size[0] - width) // 2, (self.size[1] - height) // 2, width, height

    def image(self, image: Pixels) -> UInt8[np.ndarray, "rows columns 3"]:
        """Return the scaled image; an image of an unexpected size is returned as it is."""
        if not self.changes or (image.shape[1], image.shape[0]) != self.own:
            return image
        left, top, width, height = self._place
        method = cv2.INTER_AREA if width < self.own[0] else cv2.INTER_LINEAR
        inner = cv2.resize(image, (width, height), interpolation=method)
        right, bottom = self.size[0] - left - width, self.size[1] - top - height
        return cv2.copyMakeBorder(inner, top, bottom, left, right, cv2.BORDER_CONSTANT)

    def box(self, box: Edges) -> Edges:
        """Return a box of an image in the scaled image."""
        left, top, width, height = self._place
        fx, fy = width / self.own[0], height / self.own[1]
        xmin, ymin, xmax, ymax = box
        return fx * xmin + left, fy * ymin + top, fx * xmax + left, fy * ymax + top


@dataclass(frozen=True, kw_only=True)
class Tick:
    """One control step: the newest image, which may be that of the step before."""

    image: Image
    now: float  #: The time, by the clock of the stamps [s].


def images_of(source: str, notes: list[str], topic: str | None = None) -> Iterator[Image]:
    """Yield the images of a video file, a folder, a bag or a camera.

    Args:
        source: A video file; a folder of images; the folder, .mcap or .db3 file of a bag; the number or
            device of a camera.
        notes: Get problems that do not end the stream.
        topic: The topic of a bag's images; None for the only one.

    Raises:
        PerceptionError: There is no such source, or it has no image.
    """
    if is_camera(source):
        return camera_images(source, notes)
    path = Path(source)
    if not (path.is_file() or path.is_dir()):
        kinds = "a video file, a folder of images, a rosbag2, or a camera: its number or /dev/videoN"
        raise PerceptionError(f"there is no file '{path}'; a source is {kinds}.")
    if path.suffix.lower() in IMAGE_SUFFIXES:
        raise PerceptionError(f"{path} is a single image; give the folder of all images, or a video.")
    if path.is_dir() and not is_bag(path):
        if not (files := image_files(path)):
            endings = ", ".join(IMAGE_SUFFIXES)
            raise PerceptionError(f"{path} has no images ({endings}) and is no rosbag2 ({METADATA}).")
        notes.append("files of images have no times: 30 images a second are assumed.")
        return (Image(pixels=read_image(file), stamp=i * CONTROL_DT) for i, file in enumerate(files))
    return bag_images(path, notes, topic) if is_bag(path) else video_images(path, notes)


def image_files(folder: Path) -> list[Path]:
    """Return the image files of a folder, in the order of the numbers in their names."""
    found = [path for path in folder.iterdir() if path.suffix.lower() in IMAGE_SUFFIXES]
    return sorted(found, key=lambda path: ([*map(int, re.findall(r"\d+", path.stem))], path.name))


def read_image(path: Path) -> Pixels:
    """Read an image file, or raise PerceptionError."""
    with reading("image", path, "Correct its name, or leave it out.", PerceptionError):
        pixels = unpacked_image(read_bytes(path, MOST_IMAGE))
        if pixels is None:
            raise PerceptionError(f"not a readable image of 8 bits and {MOST_PIXELS:,} pixels at most")
    return pixels


def on_control_clock(
    images: Iterable[Image], notes: list[str], fit: ImageFit | None = None
) -> Iterator[Tick]:
    """Yield a tick in every control step, with the newest image; problems with stamps are added to notes."""
    newest, num_older, start, tick = None, 0, 0.0, 0
    for image in images:
        if newest is not None and not image.stamp > newest.stamp:
            num_older += 1
            continue
        start = image.stamp if newest is None else start
        due = max(int((image.stamp - start) / CONTROL_DT + 1.0 - PHASE), 0)
        if due - tick > LONGEST_PAUSE:
            pause, played = (steps * CONTROL_DT for steps in (due - tick, tick))
            notes.append(f"{pause:.1f} s without an image after {played:.1f} s.")
            tick = due - LONGEST_PAUSE
        while newest is not None and tick < due:
            yield Tick(image=newest, now=start + (tick + PHASE) * CONTROL_DT)
            tick += 1
        newest = replace(image, pixels=fit.image(image.pixels)) if fit else image
    if newest is not None:
        yield Tick(image=newest, now=start + (tick + PHASE) * CONTROL_DT)
    if num_older:
        notes.append(f"images no newer than those before them, passed over: {num_older}.")


def is_camera(source: str) -> bool:
    """Return whether this names a camera: a number, or a video device such as /dev/video0."""
    return source.isdecimal() or source.startswith("/dev/video")


def camera_images(source: str, notes: list[str]) -> Iterator[Image]:
    """Yield the images of a camera until one fails, with a note. The stamp is the time of arrival."""
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)  # the error replaces OpenCV's lines
    capture = cv2.VideoCapture(int(source) if source.isdecimal() else source)
    try:
        capture.set(cv2.CAP_PROP_FRAME_WIDTH, RGB_CAMERA.width)
        capture.set(cv2.CAP_PROP_FRAME_HEIGHT, RGB_CAMERA.height)
        capture.set(cv2.CAP_PROP_FPS, round(1.0 / CONTROL_DT))
        capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)
        is_read, image = capture.read()
        if not is_read:
            fix = "plug it in, close other programs that use it, and be a member of the group 'video'"
            raise PerceptionError(f"the camera '{source}' gives no image: {fix}.")
        while is_read:
            yield Image(pixels=cv2.cvtColor(image, cv2.COLOR_BGR2RGB), stamp=time.monotonic())
            is_read, image = capture.read()
        notes.append("the camera gives no more images. Is it unplugged?")
    finally:
        capture.release()


def video_images(path: Path, notes: list[str]) -> Iterator[Image]:
    """Yield the images of a video file with their stamps, rotated as a player shows them.

    A damaged file ends at the damage, and strong compression by H.264 is measured, each with a note.
    """
    num_images, stamp, quantisers = 0, 0.0, list[float]()
    try:
        with av.open(str(path), options=OPTIONS, metadata_errors="replace") as container:
            if not container.streams.video:
                raise PerceptionError(f"{path} has no video stream; give a video file.")
            stream = container.streams.video[0]
            period, codec = 1.0 / float(stream.average_rate or 30), stream.codec_context
            if codec.name == "h264":
                codec.options = {"export_side_data": "venc_params"}
            for frame in container.decode(video=0):
                coding = frame.side_data.get("VIDEO_ENC_PARAMS")
                if coding is not None and num_images < MEASURED_IMAGES:
                    quantisers.append(float(coding.qp_map().mean()))
                    notes.extend(_compression_notes(quantisers))
                stamp = float(frame.time) if frame.time is not None else stamp + period
                turned = np.rot90(frame.to_ndarray(format="rgb24"), round(frame.rotation / 90))
                yield Image(pixels=np.ascontiguousarray(turned), stamp=stamp)
                num_images += 1
    except (FFmpegError, ValueError, OverflowError) as error:
        reason = getattr(error, "strerror", error)
        if not num_images:
            raise PerceptionError(f"{path} cannot be read as a video: {reason}.") from error
        notes.append(f"the video is damaged after {num_images} images: {reason}.")


def _compression_notes(quantisers: list[float]) -> Iterator[str]:
    """Yield what the mean quantisers of the first images of H.264 show, once all are measured."""
    usual = float(np.median(quantisers))
    if len(quantisers) == MEASURED_IMAGES and usual > LARGEST_QUANTISER:
        yield (
            f"strong compression: the mean quantiser of H.264 is {usual:.0f}, at most "
            f"{LARGEST_QUANTISER:.0f} is suitable. Boxes are inaccurate: record with -crf 18."
        )


def bag_images(path: Path, notes: list[str], topic: str | None = None) -> Iterator[Image]:
    """Yield the images of a bag: arguments and errors as of `images_of`.

    The stamp is that of the header, or the time of recording if the first two headers have none or the same.
    Damaged images are left out, with a note.
    """
    with opened_bag(path) as reader:
        images = connections_of(path, reader.connections, (IMAGE, COMPRESSED_IMAGE), topic)
        damaged: list[str] = []
        stream = decoded(reader, images)
        first = list(islice(stream, 2))
        is_stamped = len({message.stamp for message in first} - {0}) == len(first)
        if not is_stamped:
            notes.append("the images have no stamps that increase: their times of recording are used.")
        for message in chain(first, stream):
            stamp = (message.stamp if is_stamped else message.received) / 1e9
            if (pixels := _pixels(message)) is None:
                damaged.append(f"of {len(message.content.data)} bytes at {stamp:.3f} s")
            else:
                yield Image(pixels=pixels, stamp=stamp)
        if damaged:
            notes.append(f"damaged images, passed over: {len(damaged)}; the last {damaged[-1]}.")


def connections_of(
    path: Path, connections: "Collection[Connection]", types: Collection[str], topic: str | None
) -> "list[Connection]":
    """Return the connections of a topic with messages of some types; None for the only topic."""
    found = [each for each in connections if each.msgtype in types and each.msgcount]
    topics = sorted({each.topic for each in found})
    chosen = [each for each in topics if topic in (None, each)]
    if len(chosen) == 1:
        return [each for each in found if each.topic == chosen[0]]
    raise PerceptionError(
        f"{path}: {' or '.join(types)} is on {', '.join(topics) or 'no topic'}; record the camera, and "
        "choose one of its topics with --topic."
    )


def _pixels(message: BagMessage) -> Pixels | None:
    """The pixels of a message; None if it is damaged."""
    content = message.content
    if message.type == COMPRESSED_IMAGE:
        name = content.format.lower()
        is_known = not name or any(known in name for known in ("jpeg", "jpg", "png"))
        if not is_known or any(other in name for other in ("depth", "16", "bayer")):
            problem = f"topic {message.topic}: format '{content.format}' is not read"
            raise PerceptionError(f"{problem}; record jpeg or png of rgb8 or bgr8.")
        return unpacked_image(bytes(content.data))
    try:
        return pixels_of(content)
    except DeploymentError as error:
        raise PerceptionError(f"topic {message.topic}: {error}") from error
