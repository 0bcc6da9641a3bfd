"""Which colours are taken for the object's, after it was seen once among others."""

import numpy as np
import pytest

from pixel2catch.perception.color import Appearance

RED, GREY, DARK = (200, 40, 40), (120, 120, 120), (20, 20, 20)

Color = tuple[int, int, int]


def pixels(color: Color, number: int) -> np.ndarray:
    return np.tile(np.array(color, dtype=np.uint8), (number, 1))


def resembles(appearance: Appearance, color: Color) -> bool:
    mask = appearance.resembles(pixels(color, 25).reshape(5, 5, 3))
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
        assert appearance.is_new(pixels(color, 25).reshape(5, 5, 3)).all() == is_new


def test_older_images_count_less():
    appearance = Appearance()
    appearance.learn(pixels(RED, 300), pixels(GREY, 8000))
    for _ in range(20):
        appearance.learn(pixels(GREY, 300), pixels(RED, 300))
    assert resembles(appearance, GREY)
    assert not resembles(appearance, RED)
