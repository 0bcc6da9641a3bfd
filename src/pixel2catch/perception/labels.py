"""The label file: where the object is in images of a video, as a person says it."""

from dataclasses import asdict, dataclass, replace
from math import isfinite
from pathlib import Path
from typing import Literal, get_args

from pixel2catch.camera.camera_file import LARGEST_IMAGE
from pixel2catch.errors import InvalidValueError
from pixel2catch.files import decoded, json_text, read_json_object, reading, write_atomically

FORMAT_VERSION = 1  #: Version of the files. Raised when an older one can no longer be read.

SAME_TIME = 0.002
"""Stamps that differ by less are those of one image [s]. Source: ours, a third of a period at 150 Hz."""

Phase = Literal["held", "flight", "near the hand"]
"""Part of a throw: in the hand of who throws, in the air, at or in the hand that catches."""

PHASES: tuple[Phase, ...] = get_args(Phase)

Box = tuple[float, float, float, float]  #: xmin, ymin, xmax, ymax in continuous image coordinates [px].


@dataclass(frozen=True, kw_only=True)
class Truth:
    """What one image shows."""

    phase: Phase
    box: Box | None  #: Of the visible part of the object; None where nothing of it is visible.


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
    images: tuple[Label, ...] = ()  #: In the order of the video; those that are not here are not labelled.

    def __post_init__(self) -> None:
        """Refuse labels that no video of this size can have."""
        if min(self.width, self.height) < 1 or max(self.width, self.height) > LARGEST_IMAGE:
            raise InvalidValueError(f"width and height must be from 1 to {LARGEST_IMAGE}")
        numbers = [label.image for label in self.images]
        if numbers != sorted(set(numbers)) or min(numbers, default=0) < 0:
            raise InvalidValueError("images must be in order, each once, numbered from 0")
        for label in self.images:
            if label.box is not None and not self._holds(label.box):
                raise InvalidValueError(
                    f"the box of image {label.image} is {label.box}; it must be xmin, ymin, xmax, ymax in an "
                    f"image of {self.width} by {self.height} px, null where nothing is visible"
                )

    def _holds(self, box: Box) -> bool:
        xmin, ymin, xmax, ymax = box
        in_order = 0 <= xmin < xmax <= self.width and 0 <= ymin < ymax <= self.height
        return in_order and all(map(isfinite, box))

    def at(self, time: float) -> Label | None:
        """The label of the image with this stamp [s], if it has one."""
        return next((label for label in self.images if abs(label.time - time) < SAME_TIME), None)

    def require_size(self, width: int, height: int) -> None:
        """Refuse a video whose images have another size [px].

        Raises:
            InvalidValueError: They have.
        """
        if (width, height) != (self.width, self.height):
            raise InvalidValueError(
                f"the labels are for images of {self.width} by {self.height} px ({self.video}), these have "
                f"{width} by {height}: give the labels of this video."
            )

    def with_label(self, label: Label) -> "Labels":
        """These, and one more, or another one of its image."""
        others = (each for each in self.images if each.image != label.image)
        return replace(self, images=tuple(sorted((*others, label), key=lambda each: each.image)))

    def without(self, image: int) -> "Labels":
        """These, but none of an image."""
        return replace(self, images=tuple(each for each in self.images if each.image != image))

    def save(self, path: Path) -> None:
        """Write the file, all of it or nothing, with a line for each image."""
        content = {"format_version": FORMAT_VERSION, **asdict(self)}
        lines = ",\n  ".join(json_text(each, indent=None).strip() for each in content.pop("images"))
        head = json_text(content).rstrip().removesuffix("}").rstrip()
        write_atomically({path: f'{head},\n "images": [\n  {lines}\n ]\n}}\n'.encode()})

    @classmethod
    def load(cls, path: Path) -> "Labels":
        """Read a file.

        Raises:
            InvalidValueError: The file is missing or damaged, of another version, or has a bad value.
        """
        with reading("label file", path, "Label the video again, or correct that entry."):
            content = read_json_object(path)
            version = content.pop("format_version", None)
            if version != FORMAT_VERSION:
                raise InvalidValueError(f"format_version is {version}, this code reads {FORMAT_VERSION}")
            return decoded(cls, content)


def suggested(labels: Labels, image: int) -> Box | None:
    """Where the object should be in an image by its boxes in others; None where they say nothing.

    Between two of them as if it moved evenly, after them as it moved last.
    """
    seen = [(label.image, label.box) for label in labels.images if label.box is not None]
    before = [each for each in seen if each[0] <= image]
    after = [each for each in seen if each[0] > image]
    if not before:
        return None
    (start, box), (end, other) = before[-1], (after or before)[0]
    if not after:
        if len(before) < 2:
            return box
        end, other = before[-2]
    if start == image:
        return box
    share = (image - start) / (end - start)
    moved = [edge + share * (later - edge) for edge, later in zip(box, other, strict=True)]
    xmin, xmax = sorted(min(max(edge, 0.0), float(labels.width)) for edge in moved[0::2])
    ymin, ymax = sorted(min(max(edge, 0.0), float(labels.height)) for edge in moved[1::2])
    return (xmin, ymin, xmax, ymax) if xmin < xmax and ymin < ymax else None
