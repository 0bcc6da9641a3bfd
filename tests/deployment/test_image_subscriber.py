"""Images from the network: the newest counts, a bad one does not, and each knows where the robot was."""

from dataclasses import replace
from timeit import repeat

import numpy as np
import pytest
from loop_lab import HOME, PROFILE, Surroundings, picture, surroundings

from pixel2catch.deployment.image_subscriber import DISTRUST_TIME, NUM_EQUAL, ImageSubscriber, are_equal
from pixel2catch.mdp.sensing import ASSUMED_AGE
from pixel2catch.ros2 import messages
from pixel2catch.ros2.transport import Topic
from pixel2catch.scene.constants import CONTROL_DT, RGB_CAMERA


def images_in(around: Surroundings, *, assumes_age: bool = False) -> ImageSubscriber:
    return ImageSubscriber(
        around.connection.transport, PROFILE.camera, RGB_CAMERA, around.clock, assumes_age=assumes_age
    )


def test_the_newest_image_counts():
    with surroundings() as around:
        images = images_in(around)
        assert images.newest() is None
        for edge in (100, 200, 300):
            around.show(picture((edge, 100, edge + 20, 130)))
        frame = images.newest()
        assert frame is not None
        assert frame.pixels[110, 310].tolist() == [200, 30, 20]
        assert images.newest() is None


def test_the_stamp_is_of_the_exposure_on_the_monotonic_clock():
    with surroundings() as around:
        images = images_in(around)
        around.show(picture(), age=0.04)
        frame, now = images.newest(), around.clock.now()
        assert frame is not None
        assert now - frame.stamp == pytest.approx(0.04, abs=0.01)


@pytest.mark.parametrize("assumes_age", [True, False])
def test_images_of_the_future_are_none_and_make_perception_unsound(assumes_age: bool):
    """Up to 50 ms ahead is a clock's error; more, after sound stamps, is a clock that was set."""
    with surroundings() as around:
        images = images_in(around, assumes_age=assumes_age)
        for age, is_good in ((0.02, True), (-0.03, True), (-1.0, False)):
            around.show(picture(), age=age)
            assert (images.newest() is not None) == is_good
            assert ("synchronise the clocks" in images.problem) == (not is_good)
        assert images.stamp < around.clock.now() + 0.03


def age_of_next(images: ImageSubscriber, around: Surroundings, stamp: float) -> float:
    """Age of an image with this stamp in its header, in control steps."""
    around.camera.publish(messages.image(picture(), stamp))
    frame = images.newest()
    assert frame is not None
    assert images.stamp == frame.stamp
    return (around.clock.now() - frame.stamp) / CONTROL_DT


@pytest.mark.parametrize(
    ("age", "words"),
    [(None, "have no stamps"), (-0.2, "stamps of 0.2 s ahead"), (86400.0, "stamps of 8.6e+04 s ago")],
)
def test_images_without_a_sound_stamp_are_as_old_as_training_assumes(age: float | None, words: str):
    with surroundings() as around:
        images = images_in(around, assumes_age=True)
        for notice in (words, ""):
            stamp = 0.0 if age is None else around.clock.stamp() - age
            assert age_of_next(images, around, stamp) == pytest.approx(ASSUMED_AGE, abs=0.3)
            said = images.take_notice()
            assert notice in said
            assert bool(said) == bool(notice)
            assert not notice or "50 ms old" in said
            assert not notice or "header.stamp" in said


@pytest.mark.parametrize("age", [-0.04, 0.0, 0.3])
def test_stamps_that_can_be_meant_are_believed(age: float):
    with surroundings() as around:
        images = images_in(around, assumes_age=True)
        found = age_of_next(images, around, around.clock.stamp() - age)
        assert found == pytest.approx(age / CONTROL_DT, abs=0.3)
        assert images.take_notice() == ""


def test_an_image_that_is_late_is_not_taken_for_one_without_a_stamp():
    """It is as old as it says, and stops the robot; a camera that has stamps does not lose them."""
    with surroundings() as around:
        images = images_in(around, assumes_age=True)
        age_of_next(images, around, around.clock.stamp() - 0.02)
        around.clock.sleep_until(around.clock.now() + 3.0)
        assert age_of_next(images, around, around.clock.stamp() - 2.0) > 59.0
        assert images.take_notice() == ""


def test_a_policy_that_knows_no_ages_gets_the_stamps_as_they_are():
    with surroundings() as around:
        images = images_in(around)
        assert age_of_next(images, around, around.clock.stamp() - 2.0) > 59.0
        assert images.take_notice() == ""


def test_joints_are_those_at_the_time_of_the_image():
    with surroundings() as around:
        images = images_in(around)
        around.show(picture(), age=0.1)
        now = around.clock.now()
        for age in (0.15, 0.1, 0.05, 0.0):
            images.remember(now - age, HOME + age)
        frame = images.newest()
        assert frame is not None
        assert frame.joint_pos == pytest.approx(HOME + 0.1)


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (messages.image(picture(), 1.0)[:1000], "disagree about the type"),
        (b"", "disagree about the type"),
    ],
)
def test_an_image_that_cannot_be_read_is_passed_over_and_says_why(data: bytes, words: str):
    with surroundings() as around:
        images = images_in(around)
        around.camera.publish(data)
        assert images.newest() is None
        assert words in images.message
        around.show(picture())
        assert images.newest() is not None
        assert images.message == ""


def test_another_lens_than_the_calibrated_one_is_refused():
    with surroundings() as around:
        images, info = images_in(around), PROFILE.camera.info
        assert info is not None
        lens = around.lab.publisher(info)
        lens.publish(messages.camera_info(RGB_CAMERA, 0.0))
        images.newest()
        assert images.problem == ""
        for wrong in (1.05 * RGB_CAMERA.fx, np.inf, np.nan):
            lens.publish(messages.camera_info(replace(RGB_CAMERA, fx=wrong), 0.0))
            around.show(picture())
            assert images.newest() is None
            assert "calibrate" in images.problem
        lens.publish(b"garbage")
        around.show(picture())
        assert images.newest() is None
        lens.publish(messages.camera_info(RGB_CAMERA, 0.0))
        around.show(picture())
        assert images.newest() is not None


def test_a_frozen_image_is_found_though_its_stamps_are_fresh_and_a_repeated_one_is_passed_over():
    with surroundings() as around:
        images, frozen, found = images_in(around), picture(), list[tuple[bool, bool]]()
        for _ in range(NUM_EQUAL + 2):
            taken = around.show(frozen)
            found.append((images.newest() is not None, bool(images.problem)))
            assert images.problem or images.stamp == pytest.approx(taken, abs=0.01)
        assert found == [(True, False)] + [(False, False)] * (NUM_EQUAL - 2) + [(False, True)] * 3
        assert "frozen" in images.problem
        around.show(picture())
        assert images.newest() is not None
        assert images.problem == ""


def test_two_equal_images_in_a_row_are_no_fault_however_often():
    with surroundings() as around:
        images = images_in(around)
        for _ in range(5):
            twice = picture()
            for is_new in (True, False):
                around.show(twice)
                assert (images.newest() is not None) is is_new
                assert images.problem == ""


def test_the_same_message_again_says_nothing_of_the_camera():
    with surroundings() as around:
        images, data = images_in(around), messages.image(picture(), around.clock.stamp())
        for _ in range(2 * NUM_EQUAL):
            around.camera.publish(data)
            images.newest()
        assert images.problem == ""


@pytest.mark.parametrize("topic", [PROFILE.camera.image, PROFILE.camera.info])
def test_two_cameras_are_not_trusted(topic: Topic):
    """They may show the same; it is enough that there are two."""
    with surroundings() as around:
        images = images_in(around)
        own = around.camera if topic == PROFILE.camera.image else around.lab.publisher(topic)
        around.show(picture())
        assert images.newest() is not None
        other = around.broker.node(around.clock)
        with other:
            other.publisher(topic)
            around.clock.sleep_until(around.clock.now() + 0.21)
            around.show(picture())
            assert images.newest() is None
            assert f"several publish {topic.name}" in images.problem
        around.clock.sleep_until(around.clock.now() + 0.21)
        around.show(picture())
        assert images.newest() is not None
        assert images.problem == ""
        assert own


def test_images_of_two_cameras_by_turns_are_not_trusted():
    """Nor is a recording that begins anew: an image is older than the one before it."""
    with surroundings() as around:
        images = images_in(around)
        for age in (0.02, 0.06, 0.02):
            around.show(picture(), age=age)
        assert images.newest() is None
        assert "older than the one before" in images.problem
        around.clock.sleep_until(around.clock.now() + DISTRUST_TIME)
        assert images.problem == ""
        around.show(picture())
        assert images.newest() is not None


def test_images_of_another_size_are_not_trusted():
    with surroundings() as around:
        images = images_in(around)
        for pixels, words in (
            (picture(), ""),
            (np.zeros((240, 320, 3), dtype=np.uint8), "sends 320 x 240 rgb8"),
        ):
            around.show(pixels)
            assert (images.newest() is None) is bool(words)
            assert words in images.problem
        around.show(picture())
        assert images.newest() is not None
        assert images.problem == ""


def test_a_look_for_frozen_images_costs_next_to_nothing():
    """Images of a camera differ in the first pixels that are compared; the best of many is the machine's."""
    images = [picture() for _ in range(2)]
    before, now = (messages.read_image(messages.image(each, 1.0)).pixels for each in images)
    assert min(repeat(lambda: are_equal(before, now), number=1, repeat=50)) < 1e-3
