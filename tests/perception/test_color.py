"""Colours of a given range, and colours that are learned while the object is seen among others."""

import numpy as np
import painted
import pytest
from painted import HEIGHT, WIDTH, Disc

from pixel2catch.errors import PerceptionError
from pixel2catch.perception.color import Appearance, ColorRange, ColorThreshold
from pixel2catch.perception.segmenter import PointPrompt

REDS = ColorRange(hue=(340.0, 20.0))
NUM_STEPS = 20
BALL = Disc(path=np.array((20.0, 200.0)) + np.arange(NUM_STEPS)[:, None] * (12.0, -8.0), radius=9.0)


@pytest.mark.parametrize(
    ("color", "hue"),
    [((255, 0, 0), 0), ((255, 255, 0), 60), ((0, 255, 0), 120), ((0, 0, 255), 240), ((255, 0, 128), 330)],
)
def test_hues_are_degrees_of_the_colour_circle(color: tuple[int, int, int], hue: int):
    image = np.full((9, 9, 3), color, dtype=np.uint8)
    for first, last in ((hue - 5, hue + 5), (hue - 20, hue - 10), (hue + 10, hue + 20)):
        colors = ColorRange(hue=(first % 360, last % 360))
        assert colors.mask(image)[4, 4] == (first <= hue <= last), (first, last)


def test_grey_and_dark_have_no_colour():
    for color in ((128, 128, 128), (130, 120, 120), (30, 0, 0)):
        assert not REDS.mask(np.full((9, 9, 3), color, dtype=np.uint8)).any()


@pytest.mark.parametrize(
    ("bounds", "name"),
    [
        ({"hue": (-5.0, 5.0)}, "hue"),
        ({"hue": (0.0, 9.0), "saturation": (0.9, 0.4)}, "saturation"),
        ({"hue": (0.0, 9.0), "value": (0.0, 255.0)}, "value"),
    ],
)
def test_a_range_without_colours_is_refused(bounds: dict[str, tuple[float, float]], name: str):
    with pytest.raises(PerceptionError, match=name):
        ColorRange(**bounds)


def test_a_red_ball_is_followed_past_another_that_lies_still():
    other = Disc(path=np.tile((170.0, 130.0), (NUM_STEPS, 1)), radius=12.0)
    segmenter = ColorThreshold(REDS)
    for step, image in enumerate(painted.images((other, BALL), NUM_STEPS)):
        prompt = PointPrompt(center=(20.0, 200.0))
        found = segmenter.start(image, prompt) if step == 0 else segmenter.track(image)
        assert found.mask is not None
        assert found.mask[BALL.mask(step)].mean() > 0.9
        if not (BALL.mask(step) & other.mask(step)).any() and abs(step - 10) > 4:
            assert np.abs(painted.box_of(found.mask) - painted.box_of(BALL.mask(step))).max() <= 1


def test_without_the_colour_nothing_is_found():
    segmenter = ColorThreshold(ColorRange(hue=(200.0, 260.0)))
    for image in painted.images((BALL,), 5):
        assert segmenter.start(image, PointPrompt(center=(20.0, 200.0))).mask is None
    assert segmenter.track(np.full((HEIGHT, WIDTH, 3), painted.BLUE, dtype=np.uint8)).mask is None
    segmenter.reset()
    assert segmenter.track(np.zeros((HEIGHT, WIDTH, 3), dtype=np.uint8)).mask is None


RED, GREY, DARK = (200, 40, 40), (120, 120, 120), (20, 20, 20)

Color = tuple[int, int, int]


def pixels(color: Color, number: int) -> np.ndarray:
    return np.tile(np.array(color, dtype=np.uint8), (number, 1))


def resembles(appearance: Appearance, color: Color) -> bool:
    mask, _ = appearance.compare(pixels(color, 25).reshape(5, 5, 3))
    assert mask.all() == mask.any()
    return bool(mask.any())


def test_who_saw_nothing_knows_no_colour():
    assert not any(resembles(Appearance(), color) for color in (RED, GREY, DARK))


@pytest.mark.parametrize(
    ("color", "is_alike"),
    [(RED, True), ((210, 50, 30), True), ((185, 35, 50), True), ((200, 120, 40), False), (GREY, False)],
)
def test_the_objects_colours_are_told_in_a_slightly_different_light(color: Color, is_alike: bool):
    appearance = Appearance()
    appearance.learn(pixels(RED, 300), pixels(GREY, 8000))
    assert resembles(appearance, color) == is_alike


@pytest.mark.parametrize(("num_others", "is_alike"), [(0, True), (299, True), (301, False), (5000, False)])
def test_a_colour_that_others_have_more_of_is_not_the_objects(num_others: int, is_alike: bool):
    appearance = Appearance()
    appearance.learn(pixels(DARK, 300), pixels(DARK, num_others))
    assert resembles(appearance, DARK) == is_alike


def test_new_is_what_nothing_else_had():
    appearance = Appearance()
    appearance.learn(pixels(RED, 300), pixels(GREY, 8000))
    for color, is_new in ((DARK, True), (RED, True), (GREY, False)):
        _, mask = appearance.compare(pixels(color, 25).reshape(5, 5, 3))
        assert mask.all() == mask.any() == is_new


def test_older_images_count_less():
    appearance = Appearance()
    appearance.learn(pixels(RED, 300), pixels(GREY, 8000))
    for _ in range(20):
        appearance.learn(pixels(GREY, 300), pixels(RED, 300))
    assert resembles(appearance, GREY)
    assert not resembles(appearance, RED)
