"""Which segmenter and which prompter, as data: what commands offer and their constructors."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from pixel2catch.errors import InvalidValueError, UnknownNameError
from pixel2catch.perception.background import BackgroundSubtraction
from pixel2catch.perception.color import ColorRange, ColorThreshold
from pixel2catch.perception.prompt import (
    ColorPrompter,
    FirstPrompter,
    GivenPrompter,
    MotionPrompter,
    Prompter,
    Region,
)
from pixel2catch.perception.segmenter import BoxPrompt, PointPrompt, Segmenter
from pixel2catch.robot.constants import RGB_CAMERA, CameraSpec


@dataclass(frozen=True, kw_only=True)
class SegmenterCfg:
    """What finds the object's pixels.

    Attributes:
        kind: A name in `SEGMENTERS`.
        colors: The object's colours, for the segmenter `color`.
        checkpoint: Folder of a SAM 2.1 checkpoint, for `sam2`.
        image_size: Side of the square that SAM 2 sees [px]; None for the checkpoint's own.
        device: Where SAM 2 runs.
    """

    kind: str = "background"
    colors: ColorRange | None = None
    checkpoint: Path | None = None
    image_size: int | None = None
    device: str = "cpu"


@dataclass(frozen=True, kw_only=True)
class PromptCfg:
    """What points the object out: what a person gave, then its colour, then its flight.

    Attributes:
        box: xmin, ymin, xmax, ymax around the object [px].
        point: u, v on the object [px].
        colors: Its colours.
        region: Where it may be found by colour or flight; the whole image if absent.
    """

    box: Region | None = None
    point: tuple[float, float] | None = None
    colors: ColorRange | None = None
    region: Region | None = None


def make_segmenter(cfg: SegmenterCfg) -> Segmenter:
    """Build a segmenter.

    Raises:
        UnknownNameError: If there is none of this kind.
        InvalidValueError: If it needs what is not given.
    """
    if cfg.kind not in SEGMENTERS:
        raise UnknownNameError("segmenter", cfg.kind, SEGMENTERS)
    return SEGMENTERS[cfg.kind](cfg)


def make_prompter(cfg: PromptCfg, camera: CameraSpec = RGB_CAMERA) -> Prompter:
    """Build a prompter that after a loss looks for the colour, then for a flight.

    Args:
        cfg: What points the object out.
        camera: The camera, for the size of the image.

    Raises:
        InvalidValueError: If box and point are given, or one of them or the region is not on the image.
    """
    if cfg.box and cfg.point:
        raise InvalidValueError("give the object's box or a point on it, not both.")
    prompters: list[Prompter] = []
    if cfg.box:
        prompters.append(GivenPrompter(BoxPrompt(box=_on_image("box", cfg.box, camera))))
    if cfg.point:
        corners = _on_image("point", (*cfg.point, camera.width, camera.height), camera)
        prompters.append(GivenPrompter(PointPrompt(center=corners[:2])))
    region = cfg.region and _on_image("region", cfg.region, camera)
    if cfg.colors:
        prompters.append(ColorPrompter(cfg.colors, region=region))
    return FirstPrompter(*prompters, MotionPrompter(region=region))


def _on_image(name: str, box: Region, camera: CameraSpec) -> Region:
    """The box, if it is one and on the image."""
    xmin, ymin, xmax, ymax = box
    if 0.0 <= xmin < xmax <= camera.width and 0.0 <= ymin < ymax <= camera.height:
        return box
    raise InvalidValueError(
        f"the {name} {' '.join(f'{edge:g}' for edge in box)} is not on the image of {camera.width} by "
        f"{camera.height} px: count pixels from the upper left corner."
    )


def _background(cfg: SegmenterCfg) -> Segmenter:
    del cfg
    return BackgroundSubtraction()


def _color(cfg: SegmenterCfg) -> Segmenter:
    if cfg.colors is None:
        raise InvalidValueError("the segmenter color needs the object's hues: --color 340 20 for red.")
    return ColorThreshold(cfg.colors)


def _sam2(cfg: SegmenterCfg) -> Segmenter:
    """SAM 2; only here its library is needed."""
    if cfg.checkpoint is None:
        raise InvalidValueError("the segmenter sam2 needs --checkpoint, the folder of a SAM 2.1 model.")
    from pixel2catch.perception.sam2 import Sam2Segmenter

    return Sam2Segmenter(cfg.checkpoint, cfg.device, cfg.image_size)


SEGMENTERS: dict[str, Callable[[SegmenterCfg], Segmenter]] = {
    "background": _background,
    "color": _color,
    "sam2": _sam2,
}
"""The kinds of segmenters."""
