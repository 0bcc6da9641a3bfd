"""The shift of an image whose camera trembles: its law, what does not move it, a room that stays still."""

import cv2
import numpy as np
import painted
from painted import HEIGHT, NUM_EMPTY, WIDTH, Disc, box_of

from pixel2catch.perception.foreground import Foreground, shift_between, shifted

EVERYWHERE = np.ones((HEIGHT, WIDTH), dtype=bool)


def moved(image: np.ndarray, dx: float, dy: float) -> np.ndarray:
    matrix = np.array([[1.0, 0.0, dx], [0.0, 1.0, dy]])
    return cv2.warpAffine(image, matrix, (WIDTH, HEIGHT), borderMode=cv2.BORDER_REPLICATE)


def test_a_shift_is_found_within_a_tenth_of_a_pixel_beside_a_large_thing_that_moves():
    before, *later = (cv2.blur(image, (3, 3)) for image in painted.images((), 12))
    rng = np.random.default_rng(2)
    for image in later:
        shift = rng.uniform(-2.5, 2.5, 2)
        seen = moved(image, *shift)
        seen[40:140, 60:200] = rng.integers(0, 255, 3)
        assert np.abs(np.array(shift_between(seen, before, EVERYWHERE)) - shift).max() < 0.1


def test_a_camera_at_rest_and_a_wall_without_texture_have_no_shift():
    before, *later = (cv2.blur(image, (3, 3)) for image in painted.images((), 6))
    assert all(shift_between(image, before, EVERYWHERE) == (0.0, 0.0) for image in later)
    wall, brighter = np.full_like(before, 120), np.full_like(before, 128)
    assert shift_between(brighter, wall, EVERYWHERE) == (0.0, 0.0)
    assert shift_between(moved(later[0], 2, 0), before, ~EVERYWHERE) == (0.0, 0.0)


def test_shifted_is_that_of_opencv_and_back_again():
    image = next(painted.images((), 1))
    assert shifted(image, (0.0, 0.0)) is image
    assert np.array_equal(shifted(image, (2, -3)), moved(image, 2, -3))
    for shift in ((0.3, -1.7), (-2.4, 0.0)):
        difference = shifted(image, shift).astype(int) - moved(image, *shift)
        assert np.abs(difference).max() <= 2
    mask = np.zeros((HEIGHT, WIDTH), dtype=bool)
    mask[50:60, 70:90] = True
    there = shifted(mask, (3, -2))
    assert there.dtype == bool
    assert box_of(there).tolist() == [73.0, 48.0, 93.0, 58.0]
    assert np.array_equal(shifted(there, (-3, 2)), mask)


def test_in_images_that_tremble_only_the_object_moves_and_is_where_it_is_seen():
    disc = Disc(path=painted.thrown(4, 12), radius=9.0, color=(120, 118, 121))
    foreground, rng = Foreground(), np.random.default_rng(3)
    for step, image in enumerate(painted.images((disc,), NUM_EMPTY + 16)):
        dx, dy = rng.uniform(-2.0, 2.0, 2)
        motion = foreground.step(moved(image, dx, dy), None)
        if step >= NUM_EMPTY:
            truth = moved(disc.mask(step).astype(np.uint8), dx, dy) > 0
            rim = cv2.dilate(truth.astype(np.uint8), np.ones((7, 7), np.uint8)) > 0
            assert motion.moving[truth].mean() > 0.5
            assert (motion.moving & ~rim).sum() < 20
