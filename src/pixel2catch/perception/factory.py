"""How the object is found, as options of commands; OpenCV and SAM 2 are imported where they are used."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from pixel2catch.camera.image import Edges
from pixel2catch.checks import CameraPath, Count, Device, Within, require_used
from pixel2catch.errors import InvalidValueError
from pixel2catch.scene.constants import CONTROL_DT, RGB_CAMERA, CameraSpec

if TYPE_CHECKING:
    from pixel2catch.perception.segmenter import ColorRange, Segmenter
    from pixel2catch.perception.tracker import Prompter

TIMED_IMAGES = 10  #: Images that measure the time of one on CUDA.

LONGEST_IMAGE_TIME = 2 * CONTROL_DT
"""Longest time of an image with which a camera is followed [s]. Source: rehearsals: with 60 ms as many
objects are caught as with 10 ms, with 100 ms a third of them."""


@dataclass(frozen=True, kw_only=True)
class PerceptionArgs:
    """How the object is found, and through which camera."""

    #: background: what moves; color: what has --color; sam2: SAM 2.1, needs --checkpoint.
    segmenter: Literal["background", "color", "sam2"] = "background"
    #: The object when the throw begins: xmin, ymin, xmax, ymax [px].
    box: Annotated[Edges, Within(0.0, 8192.0)] | None = None
    #: Where the object may be found by its colour or flight: xmin, ymin, xmax, ymax [px].
    region: Annotated[Edges, Within(0.0, 8192.0)] | None = None
    #: First and last hue of the object [degrees]: red 340 20, green 90 150, blue 210 270.
    color: Annotated[tuple[float, float], Within(0.0, 360.0)] | None = None
    #: Camera file of `calibrate`, with a policy for it, +anycamera or analytic. Default: the release's.
    camera: CameraPath | None = None
    checkpoint: Path | None = None  #: Folder of a SAM 2.1 checkpoint in the format of transformers.
    #: Side of the square image of SAM 2 [px], a multiple of 32. Default: the checkpoint's.
    image_size: Count | None = None
    device: Device = "cpu"  #: Where SAM 2 runs: cpu, cuda, cuda:1, ...
    #: Compile SAM 2 at the start. This takes a minute or two and needs a C compiler.
    compile: bool = False

    def prepare(self) -> None:
        """Use one thread for images, unless SAM 2 runs."""
        import cv2
        import torch

        if self.checkpoint is None:
            torch.set_num_threads(1)
            cv2.setNumThreads(1)

    def camera_spec(self, notes: list[str]) -> CameraSpec:
        """Return the camera that takes the images; a warning about it is added to the notes."""
        from pixel2catch.camera.camera_file import CameraFile

        if self.camera is None:
            return RGB_CAMERA
        file = CameraFile.load(self.camera)
        if file.distortion:
            notes.append(f"{self.camera} has a lens: give rectified images, such as image_rect.")
        return file.camera

    def make_segmenter(
        self, *, is_live: bool = False, say: Callable[[str], None] | None = None
    ) -> "Segmenter":
        """Return what finds the object's pixels, for a recording or for a live camera.

        The time that SAM 2 needs for an image is measured and reported; one that is too slow is refused.
        """
        from pixel2catch.perception.background import BackgroundSubtraction
        from pixel2catch.perception.segmenter import ColorThreshold

        of_sam2 = ("checkpoint", "image_size", "device", "compile")
        require_used(self, of_sam2, self.segmenter == "sam2", "without --segmenter sam2")
        if self.segmenter == "background":
            return BackgroundSubtraction()
        if self.segmenter == "color":
            if colors := self._colors():
                return ColorThreshold(colors)
            raise InvalidValueError("the segmenter color needs the object's hues: --color 340 20 for red.")
        if self.checkpoint is None:
            raise InvalidValueError("the segmenter sam2 needs --checkpoint, the folder of a SAM 2.1 model.")
        from pixel2catch.perception.sam2 import Sam2Segmenter

        sam2 = Sam2Segmenter(self.checkpoint, self.device, self.image_size, is_compiled=self.compile)
        took = sam2.seconds_an_image(1 if self.device == "cpu" else TIMED_IMAGES) if is_live or say else 0.0
        cost = f"SAM 2 takes {1e3 * took:.1f} ms for an image of {sam2.image_size} px on {self.device}"
        if is_live and took > LONGEST_IMAGE_TIME:
            raise InvalidValueError(
                f"{cost}, and a camera gives one every {1e3 * CONTROL_DT:.0f} ms: take --device cuda, a "
                "smaller --image-size or --segmenter background, or record a video and track that."
            )
        if say is not None:
            say(f"{cost}; a camera gives one every {1e3 * CONTROL_DT:.0f} ms.")
        return sam2

    def make_prompter(self, camera: CameraSpec = RGB_CAMERA) -> "Prompter":
        """Return what points the object out: first --box, and after a loss its colour, then its flight."""
        from pixel2catch.perception.segmenter import BoxPrompt
        from pixel2catch.perception.tracker import Prompter

        for name, place in (("box", self.box), ("region", self.region)):
            xmin, ymin, xmax, ymax = place or (0, 0, 1, 1)
            if not (0.0 <= xmin < xmax <= camera.width and 0.0 <= ymin < ymax <= camera.height):
                raise InvalidValueError(
                    f"the {name} {xmin:g} {ymin:g} {xmax:g} {ymax:g} is not on the image of {camera.width} "
                    f"by {camera.height} px: count pixels from the upper left corner."
                )
        prompt = self.box and BoxPrompt(box=self.box)
        return Prompter(prompt, colors=self._colors(), region=self.region)

    def _colors(self) -> "ColorRange | None":
        from pixel2catch.perception.segmenter import ColorRange

        return self.color and ColorRange(hue=self.color)
