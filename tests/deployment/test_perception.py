"""Images from the network to a box: arrival, checks of the camera, and one image at a time."""

from collections.abc import Iterator
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import replace
from queue import SimpleQueue
from threading import Event, current_thread
from typing import Any

import numpy as np
import pytest
from loop_lab import BOX, HOME, PROFILE, RED, Surroundings, new_pipeline, picture, remembering

from domains import PATIENCE
from pixel2catch.camera.image import Image, Pixels, Verdict
from pixel2catch.deployment.control_loop import StepClock
from pixel2catch.deployment.perception import (
    DISTRUST_TIME,
    LONGEST_WAIT,
    NUM_EQUAL,
    ImageSubscriber,
    PerceptionRunner,
)
from pixel2catch.errors import PerceptionError
from pixel2catch.mdp.sensing import ASSUMED_AGE
from pixel2catch.perception.segmenter import BoxPrompt, ColorThreshold, Segmentation
from pixel2catch.ros2 import messages
from pixel2catch.ros2.transport import Topic
from pixel2catch.scene.constants import CONTROL_DT, RGB_CAMERA


class Camera(ImageSubscriber):
    def __init__(self, around: Surroundings, *, assumes_age: bool = False) -> None:
        self.around, self.clock = around, around.clock
        transport = around.connection.transport
        super().__init__(transport, PROFILE.camera, RGB_CAMERA, around.clock, assumes_age=assumes_age)

    def accepts(self, pixels: np.ndarray | None = None, age: float = 0.0) -> bool:
        """Send an image; return whether it is used. If not, a problem is reported."""
        self.around.show(picture() if pixels is None else pixels, age)
        is_used = self.newest() is not None
        assert bool(self.problem) is not is_used
        return is_used

    def skips(self, pixels: np.ndarray) -> bool:
        """Send an image; return whether it is left out without a problem."""
        self.around.show(pixels)
        return self.newest() is None and not self.problem

    def wait(self, seconds: float) -> None:
        self.clock.sleep_until(self.clock.now() + seconds)

    def age_of(self, stamp: float) -> float:
        """Age of an image with this stamp in its header, in control steps."""
        self.around.camera.publish(messages.image(picture(), stamp))
        image = self.newest()
        assert image is not None
        assert self.stamp == image.stamp
        return (self.clock.now() - image.stamp) / CONTROL_DT


@pytest.fixture
def camera(around: Surroundings, request: pytest.FixtureRequest) -> Camera:
    """Images of a policy that does not get the ages of boxes; of one that does, with `ASSUMING`."""
    return Camera(around, assumes_age=getattr(request, "param", False))


EITHER = pytest.mark.parametrize("camera", [False, True], indirect=True)
ASSUMING = pytest.mark.parametrize("camera", [True], indirect=True)


def test_the_newest_image_counts_with_its_exposure_time_and_the_joints_at_that_time(camera: Camera):
    assert camera.newest() is None
    for edge in (100, 200, 300):
        camera.around.show(picture((edge, 100, edge + 20, 130)), age=0.1)
    now = camera.clock.now()
    for age in (0.15, 0.1, 0.05, 0.0):
        camera.add_joints(now - age, HOME + age)
    image = camera.newest()
    assert image is not None
    assert image.pixels[110, 310].tolist() == [200, 30, 20]
    assert camera.clock.now() - image.stamp == pytest.approx(0.1, abs=0.01)
    assert image.joint_pos == pytest.approx(HOME + 0.1)
    assert camera.newest() is None


def test_a_box_has_the_time_of_its_row_by_the_stated_times_of_the_camera(around: Surroundings):
    """Stamps 10 ms late; 16 ms from the first row to the last: rows 100 to 130 of 480 are 4.2 ms early."""
    camera = replace(PROFILE.camera, stamp_offset=0.01, readout_time=0.016)
    images = ImageSubscriber(around.connection.transport, camera, RGB_CAMERA, around.clock)
    runner = PerceptionRunner(new_pipeline(controller=remembering()), around.clock)
    runner.begin_throw(BoxPrompt(box=(100.0, 100.0, 120.0, 130.0)))
    taken = around.show(picture((100, 100, 120, 130)), age=0.06)
    image = images.newest()
    assert image is not None
    assert image.stamp == pytest.approx(taken - 0.01, abs=2e-3)
    runner.offer(image)
    runner.poll()
    box = runner.poll()
    assert box is not None
    assert box.verdict is Verdict.SEEN
    assert box.stamp == pytest.approx(image.stamp + 0.016 * (115 / 480 - 0.5), abs=2e-4)


@EITHER
def test_images_from_the_future_are_refused(camera: Camera):
    """Up to 50 ms ahead is the error of a clock; more, after usable stamps, is a clock that was set."""
    assert [camera.accepts(age=age) for age in (0.02, -0.03, -1.0)] == [True, True, False]
    assert "synchronise the clocks" in camera.problem
    assert camera.stamp < camera.clock.now() + 0.03


@ASSUMING
@pytest.mark.parametrize(
    ("age", "words"),
    [
        *((age, "") for age in (-0.04, 0.0, 0.3)),
        *((None, "have no stamps"), (-0.2, "stamps of 0.2 s ahead"), (86400.0, "stamps of 8.6e+04 s ago")),
    ],
)
def test_images_without_a_usable_stamp_are_as_old_as_training_assumes(
    age: float | None, words: str, camera: Camera
):
    """This is reported once."""
    expected = age / CONTROL_DT if age is not None and not words else ASSUMED_AGE
    for notice in (words, ""):
        stamp = 0.0 if age is None else camera.clock.stamp() - age
        assert camera.age_of(stamp) == pytest.approx(expected, abs=0.3)
        found = camera.take_notice()
        assert notice in found
        assert bool(found) == bool(notice)


@EITHER
def test_an_image_that_is_late_is_not_taken_for_one_without_a_stamp(camera: Camera):
    """Not after usable stamps: it is as old as its stamp."""
    camera.age_of(camera.clock.stamp() - 0.02)
    camera.wait(3.0)
    assert camera.age_of(camera.clock.stamp() - 2.0) > 59.0
    assert camera.take_notice() == ""


def test_an_image_that_cannot_be_read_or_has_another_size_is_skipped_and_reported(camera: Camera):
    camera.around.camera.publish(messages.image(picture(), 1.0)[:1000])
    assert camera.newest() is None
    assert camera.message
    assert not camera.accepts(np.zeros((240, 320, 3), dtype=np.uint8))
    assert (camera.message, "320 x 240" in camera.problem) == ("", True)
    assert camera.accepts()


def test_another_lens_than_the_calibrated_one_is_refused(camera: Camera):
    info = PROFILE.camera.info
    assert info is not None
    lens = camera.around.lab.publisher(info)
    right, longer, unknown = (
        messages.camera_info(replace(RGB_CAMERA, fx=share * RGB_CAMERA.fx), 0.0)
        for share in (1.0, 1.05, np.nan)
    )
    for sent in (right, longer, unknown, b"garbage", right):
        lens.publish(sent)
        assert camera.accepts() is (sent == right)


def test_a_frozen_image_is_found_though_its_stamps_are_fresh(camera: Camera):
    """Images that repeat once, or with their stamp, are no fault."""
    for frozen in (picture(), picture()):
        assert camera.accepts(frozen)
        assert camera.skips(frozen)
    assert all(camera.skips(frozen) for _ in range(NUM_EQUAL - 3))
    assert not any(camera.accepts(frozen) for _ in range(3))
    assert camera.accepts()
    same = messages.image(picture(), camera.clock.stamp())
    for _ in range(2 * NUM_EQUAL):
        camera.around.camera.publish(same)
        camera.newest()
    assert camera.problem == ""


@pytest.mark.parametrize("topic", [PROFILE.camera.image, PROFILE.camera.info])
def test_a_second_camera_is_refused_while_it_is_there(topic: Topic, camera: Camera):
    own = camera.around.camera if topic == PROFILE.camera.image else camera.around.lab.publisher(topic)
    assert camera.accepts()
    with camera.around.broker.node(camera.clock) as other:
        other.publisher(topic)
        camera.wait(0.21)
        assert not camera.accepts()
        assert topic.name in camera.problem
    camera.wait(0.21)
    assert camera.accepts()
    assert own


def test_images_that_are_older_than_the_one_before_are_refused_for_a_while(camera: Camera):
    """Two cameras by turns, or a recording that starts again."""
    for age in (0.02, 0.06):
        camera.around.show(picture(), age=age)
    assert not camera.accepts(age=0.02)
    assert "older than the one before" in camera.problem
    camera.wait(DISTRUST_TIME)
    assert camera.accepts()


PROMPT = BoxPrompt(box=BOX)
TICK, LATENCY = 0.002, 0.015


def processed(took: float, seconds: float) -> list[tuple[float, float]]:
    """Exposure and end of perception of the images of a camera of 30 Hz [s], by a loop of 500 Hz."""
    clock = StepClock(lambda _: pytest.fail("nobody waits"))
    runner = PerceptionRunner(new_pipeline(controller=remembering()), clock, duration=lambda: took)
    runner.begin_throw(PROMPT)
    found, num_images = list[tuple[float, float]](), 0
    while clock.time < seconds:
        if clock.time >= num_images * CONTROL_DT + LATENCY:
            runner.offer(Image(pixels=picture(), stamp=num_images * CONTROL_DT))
            num_images += 1
        if box := runner.poll():
            assert box.verdict is Verdict.SEEN
            assert runner.times["begun"] >= runner.times["received"] >= box.stamp + LATENCY
            found.append((box.stamp, runner.times["perceived"]))
        clock.time += TICK
    return found


@pytest.mark.parametrize(
    ("took", "every", "most"),
    [(0.03, 1, 0.0), (0.06, 2, 0.0), (0.098, 3, 0.0), (0.04, None, LONGEST_WAIT), (0.056, None, 2.0 * TICK)],
)
def test_slow_perception_skips_images_and_begins_with_a_fresh_one(
    took: float, every: int | None, most: float
):
    """A result after 40 ms comes in time for the image that waits; after 56 ms that image is dropped."""
    stamps, ends = np.transpose(processed(took, 1.0))
    assert (ends - stamps - took - LATENCY).max() <= most + 2.0 * TICK
    if every:
        assert np.diff(stamps) == pytest.approx(every * CONTROL_DT)


class SuspendedSegmenter(ColorThreshold):
    """Waits in every image until it may go on."""

    def __init__(self) -> None:
        super().__init__(RED)
        self.has_begun, self.may_go_on, self.settled_by = Event(), Event(), SimpleQueue[str]()

    def find(
        self, image: Pixels, motion: Any = None, prompt: Any = None, interval: float = 1.0
    ) -> Segmentation:
        self.has_begun.set()
        assert self.may_go_on.wait(PATIENCE)
        self.may_go_on.clear()
        return super().find(image, motion, prompt)

    def settle(self) -> None:
        self.settled_by.put(current_thread().name)


class ThreadBench:
    """Perception in a thread that ends when it is told to."""

    def __init__(self, executor: Executor) -> None:
        self.clock = StepClock(lambda _: None)
        self.segmenter = SuspendedSegmenter()
        self.pipeline = new_pipeline(self.segmenter, remembering())
        self.runner = PerceptionRunner(self.pipeline, self.clock, executor)

    def show(self, stamp: float) -> None:
        self.clock.time = stamp
        self.runner.offer(Image(pixels=picture(), stamp=stamp))
        assert self.runner.poll() is None
        assert self.segmenter.has_begun.wait(PATIENCE)
        self.segmenter.has_begun.clear()

    def end(self) -> bool:
        """End the perception; return whether there is a box of this throw."""
        self.segmenter.may_go_on.set()
        while self.runner.stamp is not None:
            if self.runner.poll():
                return True
            self.runner.wait(PATIENCE)
        return False


@pytest.fixture
def bench() -> Iterator[ThreadBench]:
    with ThreadPoolExecutor(1, thread_name_prefix="perception") as executor:
        yield ThreadBench(executor)


def test_decisions_go_on_during_perception_which_learns_in_its_thread(bench: ThreadBench):
    bench.runner.begin_throw(PROMPT)
    bench.show(1.0)
    assert bench.pipeline.decide(HOME, 1.01) is None
    assert bench.segmenter.settled_by.empty()
    assert bench.end()
    assert bench.segmenter.settled_by.get(timeout=PATIENCE) == "perception_0"
    bench.show(1.1)
    for now, stamp in ((1.11, 1.0), (1.11 + CONTROL_DT, 1.0), (1.2, 1.1)):
        assert stamp == 1.0 or bench.end()
        targets = bench.pipeline.decide(HOME, now)
        assert targets is not None
        assert (targets.target_stamp, targets.image_stamp) == (now, stamp)


def test_a_box_of_the_throw_before_is_dropped(bench: ThreadBench):
    """The prompt counts from the next image on."""
    bench.runner.begin_throw(PROMPT)
    bench.show(1.0)
    bench.runner.begin_throw(None)
    bench.runner.begin_throw(PROMPT)
    assert not bench.end()
    assert bench.pipeline.decide(HOME, 1.1) is None
    bench.show(1.1)
    assert bench.end()
    assert bench.pipeline.decide(HOME, 1.2)


def test_an_error_in_the_thread_is_raised_in_the_loop(bench: ThreadBench):
    bench.runner.begin_throw(PROMPT)
    bench.runner.offer(Image(pixels=picture()[:100], stamp=0.0))
    bench.runner.poll()
    with pytest.raises(PerceptionError, match="480"):
        bench.end()
