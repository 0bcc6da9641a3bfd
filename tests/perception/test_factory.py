"""Options of commands become segmenters and prompters, or errors that say what to give."""

import numpy as np
import pytest

from pixel2catch.errors import InvalidValueError
from pixel2catch.perception.background import BackgroundSubtraction
from pixel2catch.perception.factory import PerceptionArgs
from pixel2catch.perception.segmenter import BoxPrompt, ColorThreshold

RED = (340.0, 20.0)


def test_segmenters_and_their_missing_options():
    assert isinstance(PerceptionArgs().make_segmenter(), BackgroundSubtraction)
    assert isinstance(PerceptionArgs(segmenter="color", color=RED).make_segmenter(), ColorThreshold)
    with pytest.raises(InvalidValueError, match="--color 340 20"):
        PerceptionArgs(segmenter="color").make_segmenter()
    with pytest.raises(InvalidValueError, match="sam2 needs --checkpoint"):
        PerceptionArgs(segmenter="sam2").make_segmenter()


def test_options_reach_the_prompter():
    """A box first, then the colour in the region."""
    image = np.full((480, 640, 3), 90, dtype=np.uint8)
    image[200:220, 300:320] = (200, 40, 30)
    inside = PerceptionArgs(box=(10, 10, 30, 30), color=RED, region=(250, 150, 400, 300)).make_prompter()
    assert inside.look(image) == BoxPrompt(box=(10, 10, 30, 30))
    assert inside.look(image) == BoxPrompt(box=(300, 200, 320, 220))
    assert PerceptionArgs(color=RED, region=(0, 0, 200, 200)).make_prompter().look(image) is None


def test_places_off_the_image_are_refused():
    boxes = [PerceptionArgs(box=box) for box in ((30, 10, 10, 30), (600, 10, 700, 30))]
    for args in (*boxes, PerceptionArgs(region=(0, 0, 641, 480))):
        with pytest.raises(InvalidValueError, match="not on the image of 640 by 480 px"):
            args.make_prompter()
