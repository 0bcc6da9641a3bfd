"""What differs from a background: noise, light, edges, what stands still, what a robot hides."""

import cv2
import filmed
import numpy as np
import pytest
from filmed import HEIGHT, NUM_EMPTY, WIDTH, Disc

from pixel2catch.camera.image import Mask
from pixel2catch.perception.foreground import (
    LEARNING_IMAGES,
    Foreground,
    Weakness,
    opaque,
    shaded,
    sharpened,
    shift_between,
)
from pixel2catch.perception.regions import find_blobs
from pixel2catch.perception.segmenter import BoxPrompt, ImageMotion

ROBOT_COLOR = (20, 20, 20)


def in_the_middle(present: np.ndarray, radius: float, color: tuple[int, int, int] = filmed.RED) -> Disc:
    """A disc in the middle of the images in which it is present."""
    return Disc(path=np.where(present[:, None], (160.0, 120.0), -100.0), radius=radius, color=color)


@pytest.mark.parametrize(
    ("swing", "jump", "weakness"), [(0.06, 0.15, Weakness.FLICKER), (0.0, 0.15, None), (0.0, 0.0, None)]
)
def test_a_change_of_light_is_no_foreground_and_flicker_is_recognised(
    swing: float, jump: float, weakness: Weakness | None
):
    """Mains of 50 Hz at 30 images a second: every third image is as bright."""
    foreground = Foreground()
    for step, image in enumerate(filmed.images((), 50)):
        gain = 1.0 + swing * np.sin(2.0 * np.pi * step / 3.0) + jump * (step > 45)
        share = foreground.step(np.clip(gain * image, 0, 255).astype(np.uint8), None).moving.mean()
        assert step < 10 or share < 1e-3
        assert (foreground.weakness is Weakness.FEW_IMAGES) == (step + 1 < LEARNING_IMAGES)
    assert foreground.weakness is weakness


def test_a_still_thing_becomes_background_unless_it_is_kept():
    disc = in_the_middle(np.arange(100) >= 10, 9.0)
    forgetful, keeping = Foreground(), Foreground()
    absorbed = kept = np.zeros(0, dtype=bool)
    for step, image in enumerate(filmed.images((disc,), 10 + LEARNING_IMAGES + 5)):
        absorbed = forgetful.step(image, None).moving
        kept = keeping.step(image, None).moving
        keeping.keep(disc.mask(20) if step > 10 else None)
    assert not absorbed[disc.mask(20)].any()
    assert kept[disc.mask(20)].mean() > 0.9


def test_learning_at_once_or_later_gives_the_same():
    """By `settle`, or at the next image, also after `reveal`."""
    disc = Disc(path=filmed.thrown(5, 15), radius=9.0)
    told = []
    for is_settled in (True, False):
        foreground = Foreground()
        for step, image in enumerate(filmed.images((disc,), NUM_EMPTY + 20)):
            motion = foreground.step(image, None)
            told.append(np.stack((motion.moving, motion.unknown, motion.difference)))
            if is_settled:
                foreground.settle()
            if step == NUM_EMPTY + 2:
                foreground.reveal(motion, BoxPrompt(box=(100.0, 100.0, 120.0, 120.0)))
    at_once, later = np.split(np.array(told), 2)
    np.testing.assert_array_equal(at_once, later)
    assert told[-1][0].any()


def test_the_edge_of_a_thing_is_where_its_difference_falls():
    """A bright disc with a halo of a fifth of its contrast, as compression makes: the halo is left out."""
    halo = in_the_middle(np.ones(30, dtype=bool), 16.0, (165, 165, 165))
    disc = in_the_middle(np.ones(30, dtype=bool), 9.0, (255, 255, 255))
    room = np.full((filmed.HEIGHT, filmed.WIDTH, 3), 142, dtype=np.uint8)
    foreground = Foreground()
    for _ in range(5):
        foreground.step(room, None)
    image = room.copy()
    for each in (halo, disc):
        image[each.mask(0)] = each.color
    motion = foreground.step(image, None)
    whole = (slice(0, filmed.HEIGHT), slice(0, filmed.WIDTH))
    assert np.abs(filmed.box_of(motion.moving) - filmed.box_of(halo.mask(0))).max() <= 2
    assert np.abs(filmed.box_of(sharpened(motion, whole)) - filmed.box_of(disc.mask(0))).max() <= 1


def test_a_thing_is_seen_where_something_has_moved_for_long():
    """A textured arm never stands still before a wall, for 200 images; then a bright thing is there."""
    rng, foreground = np.random.default_rng(4), Foreground()
    moving: Mask = np.zeros(0, dtype=bool)
    for step in range(230):
        image = np.full((60, 80, 3), 100, dtype=np.uint8)
        if step >= 30:
            image[10:50, 10:50] = np.kron(rng.choice((30, 170), (10, 10, 1)), np.ones((4, 4, 1)))
        if step == 229:
            image[25:35, 25:35] = 255
        moving = foreground.step(image, None).moving
    assert moving[26:34, 26:34].mean() > 0.9


def test_the_place_that_a_robot_leaves_is_no_object():
    num_steps, first_step = NUM_EMPTY + 10, NUM_EMPTY
    robot = in_the_middle(np.arange(num_steps) < first_step, 30.0, ROBOT_COLOR)
    ignorant, foreground = Foreground(), Foreground()
    for step, image in enumerate(filmed.images((robot,), num_steps)):
        ghost = ignorant.step(image, None).moving
        motion = foreground.step(image, robot.mask(step))
        if step == first_step:
            assert ghost[robot.mask(0)].mean() > 0.9
        if step >= first_step:
            assert not motion.moving[robot.mask(0)].any()
            assert motion.unknown[robot.mask(0)].all()


def test_the_background_behind_a_passing_robot_stays_known():
    num_steps = NUM_EMPTY + 12
    steps = np.arange(num_steps)
    robot = in_the_middle((steps >= NUM_EMPTY) & (steps < NUM_EMPTY + 6), 30.0, ROBOT_COLOR)
    disc = in_the_middle(steps == num_steps - 1, 8.0)
    foreground = Foreground()
    moving: Mask = np.zeros(0, dtype=bool)
    for step, image in enumerate(filmed.images((disc, robot), num_steps)):
        moving = foreground.step(image, robot.mask(step)).moving
        assert not (moving & robot.mask(step)).any()
    assert np.abs(filmed.box_of(moving) - filmed.box_of(disc.mask(num_steps - 1))).max() <= 2


@pytest.mark.parametrize(
    ("color", "is_shadow"),
    [
        ((100, 70, 40), True),  # half of the light
        ((160, 100, 40), True),  # 40 levels less in each channel
        ((150, 110, 40), False),  # green lost 30 levels; its share, and a third of all, are 40
        ((20, 14, 8), False),  # a tenth of the light
        ((110, 140, 160), False),
    ],
)
def test_a_shadow_darkens_all_channels(color: tuple[int, int, int], *, is_shadow: bool):
    image, background = (np.full((4, 5, 3), each, np.uint8) for each in (color, (200, 140, 80)))
    moving = np.zeros((4, 5), dtype=bool)
    moving[2, 3] = True
    motion = ImageMotion(
        image=image, background=background, difference=image[..., 0], moving=moving, unknown=~moving
    )
    assert np.array_equal(shaded(motion, (slice(1, 4), slice(2, 5))), moving[1:4, 2:5] & is_shadow)


@pytest.mark.parametrize(("light", "tint"), [(0.5, 0), (1.0, 30), (0.6, 30)])
def test_a_things_edges_are_without_its_shadow_its_reflection_and_its_blur(light: float, tint: int):
    """A red disc, brighter at the left and blurred, touches a floor that is darker or tinted below it."""
    room = np.full((100, 120, 3), (150, 140, 130), dtype=np.float32)
    rows, columns = np.ogrid[:100, :120]
    floor = room * light + tint * np.array((0.5, -0.2, -0.5))
    below = (rows >= 60) & (rows < 85) & (columns >= 50) & (columns < 70)
    share = cv2.GaussianBlur((np.hypot(rows - 49.5, columns - 59.5) <= 20.0).astype(np.float32), (0, 0), 3.0)
    color = np.array((170, 50, 30)) * (1.3 - 0.01 * (columns - 40.0))[..., None]
    image = share[..., None] * color + (1.0 - share[..., None]) * np.where(below[..., None], floor, room)
    difference = np.abs(image - room).max(axis=2)
    moving = difference > 6.0
    motion = ImageMotion(
        image=image.astype(np.uint8),
        background=room.astype(np.uint8),
        difference=difference.astype(np.uint8),
        moving=moving,
        unknown=np.zeros_like(moving),
    )
    assert filmed.box_of(moving)[3] == 85
    assert np.abs(filmed.box_of(opaque(find_blobs(moving)[0], motion)) - (40, 30, 80, 70)).max() <= 3


EVERYWHERE = np.ones((HEIGHT, WIDTH), dtype=bool)


def moved(image: np.ndarray, dx: float, dy: float) -> np.ndarray:
    matrix = np.array([[1.0, 0.0, dx], [0.0, 1.0, dy]])
    return cv2.warpAffine(image, matrix, (WIDTH, HEIGHT), borderMode=cv2.BORDER_REPLICATE)


def test_a_shift_is_measured_within_a_tenth_of_a_pixel():
    before, *later = (cv2.blur(image, (3, 3)) for image in filmed.images((), 12))
    rng = np.random.default_rng(2)
    for image in later:
        shift = rng.uniform(-2.5, 2.5, 2)
        seen = moved(image, *shift)
        seen[40:140, 60:200] = rng.integers(0, 255, 3)
        assert np.abs(np.array(shift_between(seen, before, EVERYWHERE)) - shift).max() < 0.1


def test_a_camera_at_rest_and_a_wall_without_texture_have_no_shift():
    before, *later = (cv2.blur(image, (3, 3)) for image in filmed.images((), 6))
    assert all(shift_between(image, before, EVERYWHERE) == (0.0, 0.0) for image in later)
    wall, brighter = np.full_like(before, 120), np.full_like(before, 128)
    assert shift_between(brighter, wall, EVERYWHERE) == (0.0, 0.0)
    assert shift_between(moved(later[0], 2, 0), before, ~EVERYWHERE) == (0.0, 0.0)


def test_in_shaking_images_only_the_object_moves():
    disc = Disc(path=filmed.thrown(4, 12), radius=9.0, color=(120, 118, 121))
    foreground, rng = Foreground(), np.random.default_rng(3)
    for step, image in enumerate(filmed.images((disc,), NUM_EMPTY + 16)):
        dx, dy = rng.uniform(-2.0, 2.0, 2)
        motion = foreground.step(moved(image, dx, dy), None)
        if step >= NUM_EMPTY:
            truth = moved(disc.mask(step).astype(np.uint8), dx, dy) > 0
            rim = cv2.dilate(truth.astype(np.uint8), np.ones((7, 7), np.uint8)) > 0
            assert motion.moving[truth].mean() > 0.5
            assert (motion.moving & ~rim).sum() < 20
