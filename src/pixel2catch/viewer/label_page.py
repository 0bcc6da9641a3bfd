"""The page on which a person says where the object is in the images of a video; every change is saved."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, final

from pixel2catch.errors import InvalidValueError
from pixel2catch.perception.labels import PHASES, Label, Labels, suggested
from pixel2catch.viewer.config import PageCfg
from pixel2catch.viewer.server import OwnPage, open_server, page_files
from pixel2catch.viewer.visitors import Visitor, Visitors

PATH = "/label"  #: Where the page is on its server.
LONGEST_NAME = 80  #: Characters of the object's name.
REQUESTS = "show, label, forget, fill, name"  #: What every page may ask for.


@dataclass(frozen=True, kw_only=True)
class Frame:
    """One image of a video."""

    time: float  #: Its stamp [s].
    jpeg: bytes


@final
class LabelPage:
    """The page; all browsers look at the same image."""

    def __init__(self, cfg: PageCfg, images: Mapping[int, Frame], labels: Labels, out: Path) -> None:
        """Serve it.

        Args:
            cfg: Where.
            images: Of the video, by their numbers in it.
            labels: What is labelled so far.
            out: The label file.
        """
        self._images, self._out = images, out
        self.labels = labels  #: What the file has.
        labelled = [each.image for each in labels.images if each.image in images]
        self._shown = labelled[-1] if labelled else min(images)
        self._visitors = Visitors(self._heed, lambda _: None)
        own = OwnPage(path=PATH, files=page_files(PATH), talk=self._visitors.talk)
        self._server = open_server(cfg, f"Pixel2Catch labels of {labels.video}", own)
        self._tell()

    @property
    def address(self) -> str:
        """Where it is served."""
        return self._server.address

    def close(self) -> None:
        """End the page."""
        self._server.close()

    def _tell(self) -> None:
        """Tell all browsers what is shown, and what is labelled."""
        labels, number = self.labels, self._shown
        label = next((each for each in labels.images if each.image == number), None)
        state = {
            "video": labels.video,
            "object": labels.object,
            "size": (labels.width, labels.height),
            "image": number,
            "first": min(self._images),
            "last": max(self._images),
            "time": self._images[number].time,
            "label": label and {"phase": label.phase, "box": label.box},
            "suggested": suggested(labels, number),
            "labelled": [(each.image, each.phase, each.box is not None) for each in labels.images],
            "file": str(self._out),
        }
        self._visitors.tell(state, self._images[number].jpeg)

    def _heed(self, visitor: Visitor, asked: dict[str, Any]) -> None:
        """Do what a browser asks for, or raise InvalidValueError."""
        match asked:
            case {"do": "show", "image": int(number)}:
                self._shown = min(max(number, min(self._images)), max(self._images))
            case {"do": "label", "image": int(number), "phase": str(phase), "box": box}:
                self._save(self.labels.with_label(self._label(number, phase, box)))
            case {"do": "forget", "image": int(number)}:
                self._save(self.labels.without(number))
            case {"do": "fill", "image": int(number)}:
                self._save(self._filled(number))
            case {"do": "name", "object": str(name)}:
                self._save(replace(self.labels, object=name[:LONGEST_NAME]))
            case _:
                raise InvalidValueError(f"{asked} is none of {REQUESTS}")
        self._tell()

    def _save(self, labels: Labels) -> None:
        labels.save(self._out)
        self.labels = labels

    def _label(self, number: int, phase: str, box: Any) -> Label:
        """A label that a browser sent; whether the box is on the image is seen where it is added."""
        if number not in self._images:
            raise InvalidValueError(f"there is no image {number}: the last is {max(self._images)}")
        if phase not in PHASES:
            raise InvalidValueError(f"the phase is '{phase}'; it must be one of {', '.join(PHASES)}")
        edges = None
        if box is not None:
            if not (isinstance(box, list) and len(box) == 4 and all(type(e) in (int, float) for e in box)):
                raise InvalidValueError(f"{box} is no box: drag one from corner to corner")
            xmin, ymin, xmax, ymax = (round(float(edge), 1) for edge in box)
            edges = (xmin, ymin, xmax, ymax)
        return Label(image=number, time=round(self._images[number].time, 6), phase=phase, box=edges)

    def _filled(self, number: int) -> Labels:
        """The labels, with boxes between the last labelled image before this one and the next after it."""
        before = [each for each in self.labels.images if each.image < number and each.box]
        after = [each for each in self.labels.images if each.image >= number and each.box]
        if not before or not after:
            raise InvalidValueError("to fill, label an image with a box before this one, and one after it")
        filled = self.labels
        for between in range(before[-1].image + 1, after[0].image):
            filled = filled.with_label(
                self._label(between, after[0].phase, list(suggested(self.labels, between) or ()) or None)
            )
        return filled
