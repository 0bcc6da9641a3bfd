"""What is written and pasted into the pictures of a film."""

from functools import cache

from jaxtyping import UInt8
from numpy import ndarray
from PIL import Image, ImageDraw, ImageFont

from pixel2catch.evaluation.recorded_throws import CAUGHT, OUTCOMES, RecordedThrow
from pixel2catch.rendering.storyboard import SLOW

INSET_SHARE = 0.27  #: Width of the robot's own view, of the picture's.
TEXT_SHARE = 0.048  #: Height of letters, of the picture's.
LEAST_TEXT = 11  #: Least height of letters [px].
INK = (255, 255, 255)
GROUND, GOOD, BAD = (24, 28, 34), (28, 116, 68), (172, 48, 40)  #: Below text: of the throw, and of both ends.
SIZE_WORDS = {"s": "small", "l": "large"}  #: Last parts of an object's name.


def add_inset(image: Image.Image, other: UInt8[ndarray, "height width 3"]) -> None:
    """Paste a picture with a frame into the lower right corner."""
    width = round(INSET_SHARE * image.width)
    inset = Image.fromarray(other).resize(
        (width, width * other.shape[0] // other.shape[1]), Image.Resampling.BOX
    )
    gap = _gap(image)
    x, y = image.width - inset.width - gap, image.height - inset.height - gap
    ImageDraw.Draw(image).rectangle((x - 2, y - 2, x + inset.width + 1, y + inset.height + 1), fill=INK)
    image.paste(inset, (x, y))


def add_caption(image: Image.Image, throw: RecordedThrow, *, is_slow: bool, is_over: bool) -> None:
    """Write the object, the slow motion while it lasts, and the outcome once it is over."""
    gap = _gap(image)
    _write(image, title(throw.object_name), (gap, gap), "la", GROUND)
    if is_slow:
        _write(image, f"{SLOW} times slower", (image.width - gap, gap), "ra", GROUND)
    if is_over:
        ground = GOOD if throw.outcome == CAUGHT else BAD
        _write(image, OUTCOMES[throw.outcome], (gap, image.height - gap), "ld", ground)


def title(object_name: str) -> str:
    """The name of an object in words."""
    *words, last = object_name.split("_")
    return " ".join((SIZE_WORDS[last], *words) if last in SIZE_WORDS and words else (*words, last))


def _write(
    image: Image.Image, text: str, corner: tuple[int, int], anchor: str, ground: tuple[int, int, int]
) -> None:
    """Write text on a ground; the anchor is Pillow's, of the corner of the ground."""
    size = max(round(TEXT_SHARE * image.height), LEAST_TEXT)
    pad, draw = size // 2, ImageDraw.Draw(image)
    way = (1 if anchor[0] == "l" else -1, 1 if anchor[1] == "a" else -1)
    x, y = (place + sign * pad for place, sign in zip(corner, way, strict=True))
    left, top, right, bottom = draw.textbbox((x, y), text, font=_font(size), anchor=anchor)
    box = (left - pad, top - pad // 2, right + pad, bottom + pad // 2)
    draw.rounded_rectangle(box, radius=pad, fill=ground)
    draw.text((x, y), text, fill=INK, font=_font(size), anchor=anchor)


def _gap(image: Image.Image) -> int:
    return max(image.height // 30, 4)


@cache
def _font(size: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    return ImageFont.load_default(size)
