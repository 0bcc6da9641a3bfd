"""Label files: where the object is in the images of a video, as a person labelled it.

`load_labels` reads this package's own file and exports of CVAT, of Label Studio, and in COCO's format.
"""

import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal, get_args
from xml.etree import ElementTree

import numpy as np

from pixel2catch.camera.camera_file import LARGEST_IMAGE
from pixel2catch.camera.image import Edges
from pixel2catch.errors import InvalidValueError
from pixel2catch.files import decoded, parse_json, read_json_object, read_text, reading, take_version
from pixel2catch.perception.sources import Size, images_of

FORMAT_VERSION = 1  #: Version of this package's own files. Raised when an older one can no longer be read.

SAME_TIME = 0.002  #: Difference of stamps of one image [s]. Source: ours, a third of a period at 150 Hz.

Phase = Literal["held", "flight", "near the hand"]  #: In the thrower's, in no, in the robot's hand.
PHASES: tuple[Phase, ...] = get_args(Phase)


@dataclass(frozen=True, kw_only=True)
class Truth:
    """What one image shows."""

    phase: Phase
    box: Edges | None  #: Of the visible part of the object; None where nothing of it is visible.


@dataclass(frozen=True, kw_only=True)
class Label(Truth):
    """What one image of a video shows."""

    image: int  #: Its number in the video, from 0.
    time: float  #: Its stamp [s].


@dataclass(frozen=True, kw_only=True)
class Labels:
    """What images of a video show; boxes are in the video's own pixels."""

    video: str  #: Name of the file.
    width: int  #: Of its images [px].
    height: int  #: Of its images [px].
    rate: float  #: Images a second.
    object: str = ""  #: What is thrown, such as "white ball".
    source: str = ""  #: Where the video is from, and under which licence.
    images: tuple[Label, ...] = ()  #: In the order of the video; all other images are not labelled.

    def __post_init__(self) -> None:
        if min(self.width, self.height) < 1 or max(self.width, self.height) > LARGEST_IMAGE:
            raise InvalidValueError(f"width and height must be from 1 to {LARGEST_IMAGE}")
        numbers = [label.image for label in self.images]
        if numbers != sorted(set(numbers)) or min(numbers, default=0) < 0:
            raise InvalidValueError("images must be in order, each once, numbered from 0")
        for label in self.images:
            xmin, ymin, xmax, ymax = label.box or (0, 0, 1, 1)
            if not (0 <= xmin < xmax <= self.width and 0 <= ymin < ymax <= self.height):
                raise InvalidValueError(
                    f"the box of image {label.image} is {label.box}; it must be xmin, ymin, xmax, ymax in an "
                    f"image of {self.width} by {self.height} px, null where nothing is visible"
                )

    def at(self, time: float) -> Label | None:
        """Return the label of the image with this stamp [s], if it has one."""
        return next((label for label in self.images if abs(label.time - time) < SAME_TIME), None)

    @classmethod
    def load(cls, path: Path) -> "Labels":
        """Read a file of this package's own format, or raise InvalidValueError."""
        with reading("label file", path, "Label the video again, or correct that entry."):
            content = read_json_object(path)
            take_version(content, FORMAT_VERSION)
            return decoded(cls, content)


def load_labels(path: Path, video: Path) -> Labels:
    """Read the labels of a video; the content of the file decides which program wrote it.

    It is an XML file of CVAT (for video or for images), a COCO file with one image per frame, a JSON file of
    Label Studio, or this package's own. The phase is the attribute `phase` or the label, if it names one,
    else `flight`. Stamps, and the size where the file has none, are the video's. A file that is damaged, of
    another format, or has two boxes in one image raises InvalidValueError.
    """
    fix = "Export it again from CVAT, Label Studio, or as COCO."
    with reading("label file", path, fix):
        text = read_text(path)
        content = None if text.lstrip().startswith("<") else parse_json(text)
        if isinstance(content, dict) and "format_version" in content:
            return Labels.load(path)
    stamps, size = [], (0, 0)
    for frame in images_of(str(video), []):
        stamps.append(frame.stamp)
        size = (frame.pixels.shape[1], frame.pixels.shape[0])
    with reading("label file", path, fix):
        match content:
            case None:
                size, marks = _cvat(text, len(stamps))
            case {"images": list(images), "annotations": list()} if images:
                size, marks = _coco(content)
            case [*tasks] if tasks:
                marks = _label_studio(tasks, video.name, size, len(stamps))
            case _:
                raise InvalidValueError("it is neither CVAT's XML, nor COCO, nor JSON of Label Studio")
        seconds = stamps[-1] - stamps[0]
        return Labels(
            video=video.name,
            width=size[0],
            height=size[1],
            rate=round((len(stamps) - 1) / seconds, 3) if seconds > 0.0 else 30.0,
            object=next((mark.name for mark in marks if mark.name not in PHASES), ""),
            images=tuple(_labels(marks, stamps, size)),
        )


@dataclass(frozen=True, kw_only=True)
class _Mark:
    """A box in one image, or that nothing is visible, as another program has it."""

    image: int  #: From 0.
    name: str
    phase: str  #: Empty where the program has none.
    box: Edges | None


def _labels(marks: list[_Mark], stamps: list[float], size: Size) -> Iterator[Label]:
    """Yield one label per image; a box replaces the mark that nothing is visible."""
    by_image: dict[int, _Mark] = {}
    for mark in marks:
        before = by_image.get(mark.image)
        if before and before.box and mark.box:
            raise InvalidValueError(f"image {mark.image} has two boxes; keep that of the thrown object")
        if not (before and before.box):
            by_image[mark.image] = mark
    if not any(mark.box for mark in marks):
        raise InvalidValueError("it has no boxes")
    for image, mark in sorted(by_image.items()):
        if not 0 <= image < len(stamps):
            raise InvalidValueError(f"it labels image {image}, the video has {len(stamps)} images, from 0")
        named: list[Phase] = [each for each in PHASES if each in (mark.phase, mark.name)]
        xmin, ymin, xmax, ymax = mark.box or (0.0,) * 4
        box = max(xmin, 0.0), max(ymin, 0.0), min(xmax, float(size[0])), min(ymax, float(size[1]))
        phase: Phase = named[0] if named else "flight"
        yield Label(image=image, time=stamps[image], phase=phase, box=box if mark.box else None)


def _mark(image: int, name: str, phase: str, box: Iterable[Any], rotation: Any) -> _Mark:
    """The mark of a box; InvalidValueError if it is rotated [degrees]."""
    if float(rotation) % 360.0:
        raise InvalidValueError(f"the box of image {image} is rotated by {rotation}°; draw it upright")
    xmin, ymin, xmax, ymax = map(float, box)
    return _Mark(image=image, name=name, phase=phase, box=(xmin, ymin, xmax, ymax))


def _between(mark: _Mark, following: _Mark, num_images: int, *, is_visible: bool) -> Iterator[_Mark]:
    """Yield the interpolated boxes between two of a track, or that nothing is visible between them."""
    for image in range(mark.image + 1, min(following.image, num_images)):
        pairs = zip(mark.box or (0.0,) * 4, following.box or (0.0,) * 4, strict=True)
        box = tuple(float(np.interp(image, (mark.image, following.image), pair)) for pair in pairs)
        yield replace(mark, image=image, box=box if is_visible and mark.box and following.box else None)


def _cvat(text: str, num_images: int) -> tuple[Size, list[_Mark]]:
    """Read 'CVAT for video 1.1' or 'CVAT for images 1.1'. Source: docs.cvat.ai, XML annotation format.

    A box that is `outside` ends a track until its next box.
    """
    if "<!DOCTYPE" in text:
        raise InvalidValueError("it declares a document type, which no export of CVAT does")
    try:
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise InvalidValueError(f"it is no XML: {error}") from None

    def mark_of(box: ElementTree.Element, name: str, image: int) -> _Mark:
        phases = (each.text or "" for each in box.iter("attribute") if each.get("name") == "phase")
        edges = (box.attrib[edge] for edge in ("xtl", "ytl", "xbr", "ybr"))
        mark = _mark(image, name, next(phases, ""), edges, box.get("rotation", 0.0))
        return replace(mark, box=None) if box.get("outside") == "1" else mark

    marks = []
    for image in root.iter("image"):
        number = _number(image.attrib["name"])
        marks += [mark_of(box, box.attrib["label"], number) for box in image.iter("box")]
    for track in root.iter("track"):
        found = [mark_of(box, track.attrib["label"], int(box.attrib["frame"])) for box in track.iter("box")]
        found.sort(key=lambda mark: mark.image)
        marks += found
        for mark, following in pairwise(found):
            marks += _between(mark, following, num_images, is_visible=mark.box is not None)
    sizes = [{side.tag: side.text or "" for side in each} for each in root.iter("original_size")]
    first = sizes[0] if sizes else next(root.iter("image"), root).attrib
    return (int(first["width"]), int(first["height"])), marks


def _coco(content: dict[str, Any]) -> tuple[Size, list[_Mark]]:
    """Read object detections in COCO's format, one image per frame. Source: cocodataset.org, data format."""
    numbers = {image["id"]: _number(image["file_name"]) for image in content["images"]}
    names = {category["id"]: category["name"] for category in content.get("categories", [])}
    marks = []
    for each in content["annotations"]:
        image, attributes = numbers[each["image_id"]], each.get("attributes", {})
        x, y, width, height = map(float, each["bbox"])
        name, phase = names.get(each["category_id"], ""), str(attributes.get("phase", ""))
        box = (x, y, x + width, y + height)
        marks.append(_mark(image, name, phase, box, attributes.get("rotation", 0.0)))
    first = content["images"][0]
    return (int(first["width"]), int(first["height"])), marks


def _label_studio(tasks: list[Any], video: str, size: Size, num_images: int) -> list[_Mark]:
    """Read key frames of `VideoRectangle`, which counts frames from 1 and edges in percent.

    Source: labelstud.io, VideoRectangle. Boxes between key frames are interpolated; one that is not `enabled`
    is the last before a time in which nothing is visible; the last of all, if enabled, stays to the end.
    """
    own = [task for task in tasks if any(str(each).endswith(video) for each in task["data"].values())]
    chosen = tasks if len(tasks) == 1 else own
    kept = [each for task in chosen for each in task["annotations"] if not each.get("was_cancelled")]
    if len(chosen) != 1 or len(kept) != 1:
        raise InvalidValueError(f"it has {len(kept)} annotations of {video}; export exactly one")
    marks: list[_Mark] = []
    for result in kept[0]["result"]:
        if result["type"] != "videorectangle":
            continue
        name = next(iter(result["value"].get("labels", [])), "")
        frames = sorted(result["value"]["sequence"], key=lambda frame: frame["frame"])
        found = []
        for frame in frames:
            x, width = (0.01 * size[0] * float(frame[edge]) for edge in ("x", "width"))
            y, height = (0.01 * size[1] * float(frame[edge]) for edge in ("y", "height"))
            box, rotation = (x, y, x + width, y + height), frame.get("rotation", 0.0)
            found.append(_mark(int(frame["frame"]) - 1, name, "", box, rotation))
        marks += found
        if frames and frames[-1]["enabled"]:
            found.append(replace(found[-1], image=max(num_images, found[-1].image)))
        for frame, (mark, following) in zip(frames, pairwise(found), strict=False):
            marks += _between(mark, following, num_images, is_visible=frame["enabled"])
    return marks


def _number(file_name: str) -> int:
    """Return the number of an image: the last one in the name of its file."""
    if numbers := re.findall(r"\d+", Path(file_name).stem):
        return int(numbers[-1])
    raise InvalidValueError(f"the image '{file_name}' has no number in its name; name it frame_000000.png")
