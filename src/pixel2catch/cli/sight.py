"""Options of the commands that look for an object in images."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from pixel2catch.perception.prompt import Prompter
    from pixel2catch.perception.segmenter import Segmenter
    from pixel2catch.robot.constants import CameraSpec

Span = tuple[float, float]


@dataclass(frozen=True, kw_only=True)
class Sight:
    """What looks for the object, and through which camera.

    Attributes:
        segmenter: background: what moves; color: what has --color; sam2: SAM 2.1, needs --checkpoint.
        box: The object when the throw begins: xmin, ymin, xmax, ymax [px].
        point: A point on the object when the throw begins: u, v [px].
        region: Where the object may be found by its colour or flight: xmin, ymin, xmax, ymax [px].
        color: First and last hue of the object [degrees]: red 340 20, green 90 150, blue 210 270.
        saturation: Smallest and largest saturation of --color.
        value: Smallest and largest brightness of --color.
        camera: Camera file as `calibrate` writes it. Default: the camera of the policies.
        checkpoint: Folder of a SAM 2.1 checkpoint in the format of transformers.
        image_size: Side of the square that SAM 2 sees [px], a multiple of 32. Default: the checkpoint's.
        device: Where SAM 2 runs: cpu, cuda, cuda:1, ...
    """

    segmenter: Literal["background", "color", "sam2"] = "background"
    box: tuple[float, float, float, float] | None = None
    point: tuple[float, float] | None = None
    region: tuple[float, float, float, float] | None = None
    color: Span | None = None
    saturation: Span = (0.4, 1.0)
    value: Span = (0.2, 1.0)
    camera: Path | None = None
    checkpoint: Path | None = None
    image_size: int | None = None
    device: str = "cpu"

    def prepare(self) -> None:
        """Leave the cores to others, unless SAM 2 is to run on them."""
        from pixel2catch.cli.device import prepare

        if self.checkpoint is None:
            prepare("cpu")

    def camera_spec(self, notes: list[str]) -> "CameraSpec":
        """The camera that takes the images.

        Args:
            notes: Gets what a user should know of it.
        """
        from pixel2catch.camera.camera_file import CameraFile
        from pixel2catch.robot.constants import RGB_CAMERA

        if self.camera is None:
            return RGB_CAMERA
        file = CameraFile.load(self.camera)
        if file.distortion:
            notes.append(f"{self.camera} has a lens: give rectified images, such as image_rect.")
        return file.camera

    def make_segmenter(self) -> "Segmenter":
        """What finds the object's pixels."""
        from pixel2catch.perception.choice import SegmenterCfg, make_segmenter

        cfg = SegmenterCfg(
            kind=self.segmenter,
            colors=self._colors(),
            checkpoint=self.checkpoint,
            image_size=self.image_size,
            device=self.device,
        )
        return make_segmenter(cfg)

    def make_prompter(self, camera: "CameraSpec") -> "Prompter":
        """What points the object out."""
        from pixel2catch.perception.choice import PromptCfg, make_prompter

        cfg = PromptCfg(box=self.box, point=self.point, colors=self._colors(), region=self.region)
        return make_prompter(cfg, camera)

    def _colors(self):
        """The object's colours, if they are given."""
        from pixel2catch.perception.color import ColorRange

        return self.color and ColorRange(hue=self.color, saturation=self.saturation, value=self.value)
