"""Connected regions, the track of an object in the image, and an object that is followed by its colour."""

from dataclasses import replace

import filmed
import numpy as np
import pytest
import torch
from filmed import Disc

from pixel2catch.camera.image import Edges
from pixel2catch.camera.pinhole import nominal_projection
from pixel2catch.envs.tasks import HUMAN_THROWS, SIDEWAYS
from pixel2catch.mdp.throws import ThrowCfg, sample_throws
from pixel2catch.perception.regions import Blob, PlausibilityCfg, find_blobs
from pixel2catch.perception.segmenter import (
    LARGEST_CHANGE,
    LONGEST_COAST,
    BoxPrompt,
    ColorRange,
    ColorThreshold,
    ImageTrack,
)
from pixel2catch.scene.constants import CONTROL_DT, GRAVITY, RGB_CAMERA


def mask_at(u: int, v: int) -> np.ndarray:
    mask = np.zeros((240, 320), dtype=bool)
    mask[v - 5 : v + 5, u - 5 : u + 5] = True
    return mask


def seen(track: ImageTrack, u: int, v: int) -> ImageTrack:
    """The track after an image with the object at a place [px]."""
    (blob,) = find_blobs(mask_at(u, v))
    return track.advanced([blob], blob)[0]


def test_a_track_keeps_its_velocity_for_a_while():
    """In time: at the next image, half a control step after it, and three seconds later."""
    track = seen(seen(ImageTrack(center=(10.0, 10.0)), 10, 10).after(1.0), 16, 12)
    assert (track.velocity, track.after(1.0).expected) == ((6.0, 2.0), (22.0, 14.0))
    assert track.after(0.5).expected == (19.0, 13.0)
    track, _ = track.after(1.0).advanced([], None)
    assert track.after(1.0).expected == (28.0, 16.0)
    assert seen(track.after(1.0), 34, 18).velocity == (9.0, 3.0)
    track = track.after(90.0)
    assert (track.expected, track.reach) == ((34.0, 18.0), LONGEST_COAST * CFG.largest_jump)


def test_images_that_come_fast_are_averaged():
    """At 120 Hz the middle of a box is a pixel off, which is four pixels per control step."""
    track = replace(ImageTrack(center=(40.0, 40.0)), num_seen=2, velocity=(8.0, 0.0))
    assert seen(track.after(0.25), 43, 40).velocity == (9.0, 0.0)


def chosen(track: ImageTrack, *places: tuple[int, int]) -> tuple[float, float] | None:
    """Middle of the likeliest of some regions in the next image; None if none can be the object."""
    mask = np.logical_or.reduce([mask_at(u, v) for u, v in places])
    return next((blob.center for blob in track.after(1.0).candidates(find_blobs(mask))), None)


@pytest.mark.parametrize(
    ("place", "is_passed", "is_in_reach"),
    [
        ((160, 100), True, True),  # at the expected place
        ((100, 100), True, True),  # stopped by a hand
        ((130, 130), True, True),  # 30 px beside the line
        ((130, 160), False, True),  # it bounced
        ((215, 100), False, True),
        ((40, 100), False, True),
        ((225, 100), False, False),  # 125 px from its last place: faster than a throw
    ],
)
def test_a_track_continues_or_bounces(place: tuple[int, int], is_passed: bool, is_in_reach: bool):
    track = ImageTrack(center=(100.0, 100.0), velocity=(60.0, 0.0), num_seen=2)
    (blob,) = find_blobs(mask_at(*place))
    assert track.after(1.0).passes(blob) == is_passed
    assert (chosen(track, place) is not None) == is_in_reach
    first = ImageTrack(center=(100.0, 100.0), num_seen=1)  # in any direction at any speed of a throw
    assert (chosen(first, place) is not None) == is_in_reach


def test_a_flying_object_is_ahead():
    """Gravity takes four times as much of its way in twice the time."""
    track = ImageTrack(center=(100.0, 100.0), velocity=(30.0, 0.0), num_seen=2)
    blobs: list[Blob] = find_blobs(mask_at(137, 108) | mask_at(100, 100))
    assert sorted(map(track.after(1.0).leads_to, blobs)) == [False, True]
    still = ImageTrack(center=(130.0, 100.0)).after(1.0)
    assert not any(map(still.leads_to, blobs))  # its motion is unknown
    (fallen,) = find_blobs(mask_at(160, 100 + round(3.5 * LARGEST_CHANGE)))
    assert replace(track, span=2.0).after(2.0).leads_to(fallen)
    assert not track.after(2.0).leads_to(fallen)  # the velocity is newer


def test_the_nearest_region_continues_the_track_and_another_thing_does_not():
    track = ImageTrack(center=(140.0, 100.0), velocity=(10.0, 0.0))
    both = find_blobs(mask_at(150, 100) | mask_at(190, 100))
    found = track.after(1.0).candidates(both)
    assert [blob.center for blob in found] == [(150.0, 100.0), (190.0, 100.0)]
    track, _ = track.after(1.0).advanced(both, found[0])
    assert chosen(track, (186, 102)) is None
    assert chosen(track, (186, 130)) is not None
    assert chosen(track, (160, 100)) is not None


def test_the_object_may_pass_another_thing():
    over = ImageTrack(center=(140.0, 100.0), velocity=(50.0, 0.0), others=((191.0, 100.0),))
    assert chosen(over, (192, 101)) is not None
    beside = ImageTrack(center=(140.0, 100.0), others=((160.0, 95.0),))  # which stays where it is
    assert chosen(beside, (156, 110), (160, 94)) == (156.0, 110.0)


def test_things_of_another_size_are_no_object():
    for speck_or_wall in ((slice(100, 101), slice(100, 105)), (slice(100, 110), slice(50, 151))):
        mask = np.zeros((240, 320), dtype=bool)
        mask[speck_or_wall] = True
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
    for grey_or_dark in ((128, 128, 128), (130, 120, 120), (30, 0, 0)):
        assert not REDS.mask(np.full((9, 9, 3), grey_or_dark, dtype=np.uint8)).any()


def test_a_red_ball_is_followed_past_another_that_lies_still():
    other = Disc(path=np.tile((170.0, 130.0), (NUM_STEPS, 1)), radius=12.0)
    segmenter = ColorThreshold(REDS)
    for step, image in enumerate(filmed.images((other, BALL), NUM_STEPS)):
        prompt = BoxPrompt(box=(11.0, 191.0, 29.0, 209.0))
        found = segmenter.find(image, prompt=None if step else prompt)
        assert found.mask is not None
        assert found.mask[BALL.mask(step)].mean() > 0.9
        if not (BALL.mask(step) & other.mask(step)).any() and abs(step - 10) > 4:
            assert np.abs(filmed.box_of(found.mask) - filmed.box_of(BALL.mask(step))).max() <= 1


def two_blobs() -> np.ndarray:
    mask = np.zeros((48, 64), dtype=bool)
    mask[5:10, 8:14] = True  # 30 pixels
    mask[20:30, 40:44] = True  # 40 pixels
    return mask


def test_regions_have_the_boxes_of_training_and_are_together_the_mask():
    assert len(find_blobs(np.kron(np.ones((256, 257)), [[1, 0], [0, 0]]) > 0)) == 256 * 257  # more than 2**16
    large, small = find_blobs(two_blobs())
    assert (large.area, large.width, large.height, large.center) == (40, 4, 10, (42.0, 25.0))
    assert (small.area, small.width, small.height, small.center) == (30, 6, 5, (11.0, 7.5))
    for blob in (large, small):
        assert filmed.box_of(blob.mask()).tolist() == list(blob.box)
    assert not (large.mask() & small.mask()).any()
    assert np.array_equal(large.mask() | small.mask(), two_blobs())


CFG = PlausibilityCfg()
OBJECT: Edges = (300.0, 200.0, 330.0, 230.0)


@pytest.mark.parametrize(
    ("jump", "growth", "steps", "expected"),
    [
        (61.0, 0.0, 1.0, False),
        (95.0, 0.0, 1.0, False),  # seen in a throw of a person
        (121.0, 0.0, 1.0, True),
        (121.0, 0.0, 2.0, False),  # an image was skipped
        (121.0, 0.0, 0.5, True),  # a camera of 60 Hz sees no faster objects
        (0.0, 49.0, 1.0, False),
        (0.0, 51.0, 1.0, True),
        (0.0, -29.0, 1.0, False),
    ],
)
def test_a_box_moves_and_grows_no_faster_than_objects_do(
    jump: float, growth: float, steps: float, expected: bool
):
    now = (OBJECT[0], OBJECT[1] + jump, OBJECT[2], OBJECT[3] + jump + growth)
    assert CFG.is_jump(now, OBJECT, steps) is expected


def test_a_prompt_sets_how_large_the_object_can_be():
    """Of what is 45 px wide at its release, 135 px are the object at its catch."""
    assert CFG.including((300.0, 200.0, 330.0, 220.0)) == CFG
    large = CFG.including((300.0, 200.0, 345.0, 220.0))
    assert large.largest_side == pytest.approx(135.0)
    assert large.largest_share == pytest.approx(1.35**2 * CFG.largest_share)


FLIGHTS = [(ThrowCfg(), 0.075, 1.0), (HUMAN_THROWS, 0.075, 0.999), (SIDEWAYS, 0.14, 1.0)]


@pytest.mark.parametrize(("throws", "radius", "quantile"), FLIGHTS)
def test_no_flight_of_the_task_is_a_jump(throws: ThrowCfg, radius: float, quantile: float):
    """Spheres of 15 and 28 cm, from the release until they come down to the height of the catch."""
    cfg = PlausibilityCfg.up_to(radius)
    thrown = sample_throws(throws, 2000, torch.Generator().manual_seed(0))
    time = CONTROL_DT * torch.arange(60)[:, None]
    pos = thrown.pos + thrown.lin_vel * time[..., None]
    pos[..., 2] -= 0.5 * GRAVITY * time**2
    pixels, depth = zip(*(nominal_projection(RGB_CAMERA, at).pixels(at[:, None]) for at in pos), strict=True)
    center, half = torch.stack(pixels)[:, :, 0], radius * RGB_CAMERA.fx / torch.stack(depth)[:, :, 0, None]
    boxes = torch.cat((center - half, center + half), dim=-1)
    in_view = (center > 0.0).all(dim=-1) & (center < torch.tensor([640.0, 480.0])).all(dim=-1)
    flies = in_view & (time < thrown.flight_time())
    change = (boxes[1:] - boxes[:-1])[flies[1:] & flies[:-1]]
    first, last = change.split(2, dim=-1)
    speed, growth = (0.5 * (first + last)).norm(dim=-1), (last - first).amax(dim=-1)
    assert len(change) > 20_000
    assert 60.0 < speed.quantile(quantile) < cfg.largest_jump
    assert growth.quantile(quantile) < 0.2 * cfg.largest_growth
    side = float(2.0 * half[flies[..., None]].quantile(quantile))
    area = RGB_CAMERA.width * RGB_CAMERA.height
    assert side < cfg.largest_side
    assert side**2 < cfg.largest_share * area
    assert side**2 > CFG.largest_share * area or radius < 0.1
