"""The track of an object in the image, and an object that is followed by a given colour."""

import numpy as np
import painted
import pytest
from painted import Disc

from pixel2catch.perception.regions import Blob, find_blobs
from pixel2catch.perception.segmenter import (
    LARGEST_REACH,
    BoxPrompt,
    ColorRange,
    ColorThreshold,
    ImageTrack,
)


def mask_at(u: int, v: int) -> np.ndarray:
    mask = np.zeros((240, 320), dtype=bool)
    mask[v - 5 : v + 5, u - 5 : u + 5] = True
    return mask


def seen(track: ImageTrack, u: int, v: int) -> ImageTrack:
    """The track after an image with the object at a place [px]."""
    (blob,) = find_blobs(mask_at(u, v))
    return track.advanced([blob], blob)[0]


def test_a_track_keeps_its_velocity_for_a_while():
    track = seen(ImageTrack(center=(10.0, 10.0)), 16, 12)
    assert track.expected == (22.0, 14.0)
    track, _ = track.advanced([], None)
    assert track.expected == (28.0, 16.0)
    assert seen(track, 34, 18).velocity == (9.0, 3.0)
    for _ in range(20):
        track, _ = track.advanced([], None)
    assert (track.expected, track.reach) == ((34.0, 18.0), LARGEST_REACH)


def chosen(track: ImageTrack, *places: tuple[int, int]) -> tuple[float, float] | None:
    """Middle of the likeliest of some regions; None if none can be the object."""
    mask = np.logical_or.reduce([mask_at(u, v) for u, v in places])
    return next((blob.center for blob in track.candidates(find_blobs(mask))), None)


@pytest.mark.parametrize(
    ("place", "is_in_reach"),
    [
        ((160, 100), True),  # at the expected place
        ((100, 100), True),  # stopped by a hand
        ((130, 130), True),  # 30 px beside the line
        ((130, 160), False),  # 60 px beside it
        ((220, 100), False),  # 60 px ahead of the expected place
        ((40, 100), False),  # 60 px back
    ],
)
def test_a_track_continues_near_its_line(place: tuple[int, int], is_in_reach: bool):
    track = ImageTrack(center=(100.0, 100.0), velocity=(60.0, 0.0), num_seen=2)
    assert (chosen(track, place) is not None) == is_in_reach
    first = ImageTrack(center=(100.0, 100.0), num_seen=1)  # in any direction at any speed of a throw
    assert (chosen(first, place) is not None) == (place != (220, 100))


def test_a_flying_object_is_ahead():
    track = ImageTrack(center=(100.0, 100.0), velocity=(30.0, 0.0), num_seen=2)
    blobs: list[Blob] = find_blobs(mask_at(137, 108) | mask_at(100, 100))
    assert sorted(map(track.leads_to, blobs)) == [False, True]
    assert not any(map(ImageTrack(center=(130.0, 100.0)).leads_to, blobs))  # its motion is unknown


def test_the_nearest_region_continues_the_track():
    track = ImageTrack(center=(140.0, 100.0), velocity=(12.0, 0.0))
    found = track.candidates(find_blobs(mask_at(170, 125) | mask_at(150, 100) | mask_at(300, 100)))
    assert [blob.center for blob in found] == [(150.0, 100.0), (170.0, 125.0)]


def test_another_thing_does_not_become_the_object():
    track = ImageTrack(center=(140.0, 100.0), velocity=(10.0, 0.0))
    both = find_blobs(mask_at(150, 100) | mask_at(190, 100))
    track, _ = track.advanced(both, track.candidates(both)[0])
    assert track.others == ((190.0, 100.0),)
    assert chosen(track, (186, 102)) is None
    assert chosen(track, (186, 130)) is not None
    assert chosen(track, (160, 100)) is not None


def test_the_object_may_pass_another_thing():
    over = ImageTrack(center=(140.0, 100.0), velocity=(50.0, 0.0), others=((191.0, 100.0),))
    assert chosen(over, (192, 101)) is not None
    beside = ImageTrack(center=(140.0, 100.0), others=((160.0, 95.0),))  # which stays where it is
    assert chosen(beside, (156, 110), (160, 94)) == (156.0, 110.0)


def test_things_of_another_size_are_no_object():
    speck, wall = np.zeros((240, 320), dtype=bool), np.zeros((240, 320), dtype=bool)
    speck[100, 100:105] = True
    wall[100:110, 50:151] = True
    for mask in (speck, wall):
        assert not ImageTrack(center=(100.0, 105.0)).candidates(find_blobs(mask))


REDS = ColorRange(hue=(340.0, 20.0))
NUM_STEPS = 20
BALL = Disc(path=np.array((20.0, 200.0)) + np.arange(NUM_STEPS)[:, None] * (12.0, -8.0), radius=9.0)


@pytest.mark.parametrize(("color", "hue"), [((255, 255, 0), 60), ((0, 0, 255), 240), ((255, 0, 0), 0)])
def test_hues_are_degrees_of_the_colour_circle(color: tuple[int, int, int], hue: int):
    image = np.full((9, 9, 3), color, dtype=np.uint8)
    for first, last in ((hue - 5, hue + 5), (hue - 20, hue - 10), (hue + 10, hue + 20)):
        colors = ColorRange(hue=(first % 360, last % 360))
        assert colors.mask(image)[4, 4] == (first <= hue <= last), (first, last)


def test_grey_and_dark_have_no_colour():
    for color in ((128, 128, 128), (130, 120, 120), (30, 0, 0)):
        assert not REDS.mask(np.full((9, 9, 3), color, dtype=np.uint8)).any()


def test_a_red_ball_is_followed_past_another_that_lies_still():
    other = Disc(path=np.tile((170.0, 130.0), (NUM_STEPS, 1)), radius=12.0)
    segmenter = ColorThreshold(REDS)
    for step, image in enumerate(painted.images((other, BALL), NUM_STEPS)):
        prompt = BoxPrompt(box=(11.0, 191.0, 29.0, 209.0))
        found = segmenter.start(image, prompt) if step == 0 else segmenter.track(image)
        assert found.mask is not None
        assert found.mask[BALL.mask(step)].mean() > 0.9
        if not (BALL.mask(step) & other.mask(step)).any() and abs(step - 10) > 4:
            assert np.abs(painted.box_of(found.mask) - painted.box_of(BALL.mask(step))).max() <= 1
