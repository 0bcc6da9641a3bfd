"""Options of commands become segmenters and prompters, or errors that say what to give."""

import numpy as np
import pytest

from pixel2catch.errors import InvalidValueError, UnknownNameError
from pixel2catch.perception.background import BackgroundSubtraction
from pixel2catch.perception.choice import PromptCfg, SegmenterCfg, make_prompter, make_segmenter
from pixel2catch.perception.color import ColorRange, ColorThreshold
from pixel2catch.perception.segmenter import BoxPrompt, PointPrompt

RED = ColorRange(hue=(340, 20))


def image_with_red(box: tuple[int, int, int, int]) -> np.ndarray:
    image = np.full((480, 640, 3), 90, dtype=np.uint8)
    xmin, ymin, xmax, ymax = box
    image[ymin:ymax, xmin:xmax] = (200, 40, 30)
    return image


def test_segmenters():
    assert isinstance(make_segmenter(SegmenterCfg()), BackgroundSubtraction)
    assert isinstance(make_segmenter(SegmenterCfg(kind="color", colors=RED)), ColorThreshold)


@pytest.mark.parametrize(
    ("cfg", "words"),
    [
        (SegmenterCfg(kind="color"), "--color 340 20"),
        (SegmenterCfg(kind="sam2"), "--checkpoint"),
        (SegmenterCfg(kind="sam3"), "Did you mean 'sam2'"),
    ],
)
def test_what_a_segmenter_lacks_is_named(cfg: SegmenterCfg, words: str):
    with pytest.raises((InvalidValueError, UnknownNameError), match=words):
        make_segmenter(cfg)


def test_what_a_person_gave_comes_before_the_colour():
    image = image_with_red((300, 200, 320, 220))
    given = make_prompter(PromptCfg(box=(10, 10, 30, 30), colors=RED))
    assert given.look(image) == BoxPrompt(box=(10, 10, 30, 30))
    assert given.look(image) == BoxPrompt(box=(300, 200, 320, 220))
    assert make_prompter(PromptCfg(point=(5, 6))).look(image) == PointPrompt(center=(5, 6))


def test_colour_is_looked_for_in_the_region():
    image = image_with_red((300, 200, 320, 220))
    inside = make_prompter(PromptCfg(colors=RED, region=(250, 150, 400, 300)))
    outside = make_prompter(PromptCfg(colors=RED, region=(0, 0, 200, 200)))
    assert inside.look(image) == BoxPrompt(box=(300, 200, 320, 220))
    assert outside.look(image) is None


@pytest.mark.parametrize(
    "cfg",
    [
        PromptCfg(box=(30, 10, 10, 30)),
        PromptCfg(box=(600, 10, 700, 30)),
        PromptCfg(point=(640, 10)),
        PromptCfg(point=(-1, 10)),
        PromptCfg(region=(0, 0, 641, 480)),
    ],
)
def test_places_off_the_image_are_refused(cfg: PromptCfg):
    with pytest.raises(InvalidValueError, match="not on the image of 640 by 480 px"):
        make_prompter(cfg)


def test_box_and_point_exclude_each_other():
    with pytest.raises(InvalidValueError, match="not both"):
        make_prompter(PromptCfg(box=(10, 10, 30, 30), point=(20, 20)))
