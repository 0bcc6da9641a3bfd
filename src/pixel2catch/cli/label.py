"""`pixel2catch label`: say on a page where the object is in a video."""

import time
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

from tyro.conf import Positional

from pixel2catch.checks import NotNegative, Positive
from pixel2catch.cli.console import say
from pixel2catch.errors import PerceptionError
from pixel2catch.installation import needs_extra
from pixel2catch.interruption import StopRequest
from pixel2catch.viewer.config import PageCfg

if TYPE_CHECKING:
    from pixel2catch.perception.labels import Labels
    from pixel2catch.viewer.label_page import Frame

POLL = 0.2  #: Time between two looks for Ctrl-C [s].
QUALITY = 92  #: Of the JPEG images of the page: edges matter.


@dataclass(frozen=True, kw_only=True)
class Label:
    """Say where the object is in the images of a video, on a page; `track --truth` compares with it.

    Every change is saved at once, and a label file that is there is gone on with.
    """

    video: Positional[Path]  #: A video file.
    out: Path | None = None  #: The label file. Default: the video's name, ending in .json.
    object: str | None = None  #: What is thrown, such as "white ball".
    source: str | None = None  #: Where the video is from, and under which licence.
    at: NotNegative = 0.0  #: First image that the page has [s].
    seconds: Positive = 30.0  #: How much of the video the page has from there [s].
    page: PageCfg = field(default_factory=PageCfg)  #: Where the page is served.

    def run(self) -> None:
        """Serve the page until Ctrl-C."""
        from pixel2catch.perception.labels import Labels

        with needs_extra("viewer"):
            from pixel2catch.viewer.label_page import LabelPage
        out = self.out or self.video.with_suffix(".json")
        known = Labels.load(out) if out.exists() else None
        images, labels = self._read(known)
        say(f"{len(images)} images of {labels.width} x {labels.height} px; {len(labels.images)} are labelled")
        page = LabelPage(self.page, images, labels, out)
        try:
            say(f"open {page.address} in a browser; every change is saved in {out}; Ctrl-C ends it")
            with StopRequest() as stop:
                while not stop.is_set:
                    time.sleep(POLL)
        finally:
            page.close()
        say(f"{len(page.labels.images)} images are labelled in {out}")

    def _read(self, known: "Labels | None") -> "tuple[dict[int, Frame], Labels]":
        """The images that are shown, by their numbers, and what is labelled so far."""
        from pixel2catch.perception.labels import Labels

        with needs_extra("perception"):
            from pixel2catch.perception.sources import video_frames
        from pixel2catch.viewer.images import jpeg
        from pixel2catch.viewer.label_page import Frame

        if not self.video.is_file():
            raise PerceptionError(f"there is no file '{self.video}'; give a video file.")
        images: dict[int, Frame] = {}
        stamps: list[float] = []
        width = height = 0
        for number, frame in enumerate(video_frames(self.video, [])):
            stamps.append(frame.stamp)
            height, width = frame.image.shape[:2]
            if frame.stamp - stamps[0] > self.at + self.seconds:
                break
            if frame.stamp - stamps[0] >= self.at:
                images[number] = Frame(time=frame.stamp, jpeg=jpeg(frame.image, QUALITY))
        if not images:
            raise PerceptionError(f"{self.video} has no image after {self.at:g} s: give a smaller --at.")
        rate = (len(stamps) - 1) / (stamps[-1] - stamps[0]) if len(stamps) > 1 else 30.0
        name = self.video.name
        labels = known or Labels(video=name, width=width, height=height, rate=round(rate, 3))
        labels.require_size(width, height)
        given = {"object": self.object, "source": self.source}
        return images, replace(labels, **{key: text for key, text in given.items() if text is not None})
