"""What counts as different from the background, and what the robot does to it."""

import numpy as np
import painted
from painted import NUM_EMPTY, Disc

from pixel2catch.perception.background import Foreground
from pixel2catch.perception.segmenter import Mask

ROBOT_COLOR = (20, 20, 20)


def waiting_and_gone(num_steps: int, first_step: int) -> Disc:
    """A robot's hand that waits in the middle of the image, and is away from a step on."""
    path = np.tile((160.0, 120.0), (num_steps, 1))
    path[first_step:] = (-100.0, -100.0)
    return Disc(path=path, radius=30.0, color=ROBOT_COLOR)


def test_noise_is_no_foreground():
    foreground = Foreground()
    shares = [foreground.step(image, None)[0].mean() for image in painted.images((), 60)]
    assert max(shares[NUM_EMPTY:]) < 1e-3


def test_nothing_is_said_before_the_background_is_learned():
    disc = Disc(path=painted.thrown(0, 20), radius=8.0)
    learning_images = NUM_EMPTY + 5
    foreground = Foreground(learning_images)
    for step, image in enumerate(painted.images((disc,), NUM_EMPTY + 20)):
        moving, unknown = foreground.step(image, None)
        assert unknown.all() == (step + 1 < learning_images)
        assert moving.any() == (step + 1 >= learning_images)


def test_what_a_waiting_robot_uncovers_is_not_taken_for_an_object():
    num_steps, first_step = NUM_EMPTY + 10, NUM_EMPTY
    robot = waiting_and_gone(num_steps, first_step)
    ignorant, foreground = Foreground(), Foreground()
    for step, image in enumerate(painted.images((robot,), num_steps)):
        ghost, _ = ignorant.step(image, None)
        moving, unknown = foreground.step(image, robot.mask(step))
        if step == first_step:
            assert ghost[robot.mask(0)].mean() > 0.9
        if step >= first_step:
            assert not moving[robot.mask(0)].any()
            assert unknown[robot.mask(0)].all()


def test_a_background_that_was_known_before_a_robot_came_is_known_after_it():
    num_steps = NUM_EMPTY + 12
    path = np.full((num_steps, 2), -100.0)
    path[NUM_EMPTY : NUM_EMPTY + 6] = (160.0, 120.0)
    robot = Disc(path=path, radius=30.0, color=ROBOT_COLOR)
    disc_path = np.full((num_steps, 2), -100.0)
    disc_path[-1] = (160.0, 120.0)
    disc = Disc(path=disc_path, radius=8.0)
    foreground = Foreground()
    moving: Mask = np.zeros(0, dtype=bool)
    for step, image in enumerate(painted.images((disc, robot), num_steps)):
        moving, _ = foreground.step(image, robot.mask(step))
        assert not (moving & robot.mask(step)).any()
    assert np.abs(painted.box_of(moving) - painted.box_of(disc.mask(num_steps - 1))).max() <= 2
