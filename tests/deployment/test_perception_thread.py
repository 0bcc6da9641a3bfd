"""Perception beside the decisions: one image at a time, the newest; nobody waits for it."""

from collections.abc import Callable, Iterator
from concurrent.futures import Executor, ThreadPoolExecutor
from queue import SimpleQueue
from threading import Event, current_thread

import numpy as np
import pytest
from loop_lab import BOX, HOME, RED, new_pipeline, picture, remembering

from domains import PATIENCE
from pixel2catch.camera.image import Image, Pixels, Verdict
from pixel2catch.deployment.perception_thread import LONGEST_WAIT, CallerExecutor, ConcurrentPerception
from pixel2catch.deployment.policy_pipeline import PolicyPipeline
from pixel2catch.deployment.stepped import StepClock, perception_times
from pixel2catch.errors import InvalidValueError, PerceptionError
from pixel2catch.perception.segmenter import (
    BoxPrompt,
    ColorThreshold,
    ImageMotion,
    Prompt,
    Segmentation,
    Segmenter,
)
from pixel2catch.scene.constants import CONTROL_DT

PROMPT = BoxPrompt(box=BOX)
TICK = 0.002
LATENCY = 0.015


def looks(took: Callable[[], float], seconds: float) -> list[tuple[float, float]]:
    """Stamps and ends of looks at a camera of 30 Hz [s], by a loop of 500 Hz."""
    clock = StepClock(lambda _: pytest.fail("nobody waits"))
    pipeline = new_pipeline(controller=remembering())
    perception = ConcurrentPerception(pipeline, CallerExecutor(clock, took), clock)
    perception.begin(PROMPT)
    found: list[tuple[float, float]] = []
    num_images = 0
    while clock.time < seconds:
        if clock.time >= num_images * CONTROL_DT + LATENCY:
            perception.offer(Image(pixels=picture(), stamp=num_images * CONTROL_DT))
            num_images += 1
        if look := perception.go_on():
            assert look.box.verdict is Verdict.SEEN
            assert look.begin >= look.received >= look.box.stamp + LATENCY
            found.append((look.box.stamp, look.end))
        clock.time += TICK
    return found


@pytest.mark.parametrize(("took", "every"), [(0.01, 1), (0.03, 1), (0.06, 2), (0.098, 3)])
def test_of_so_many_images_one_is_looked_at_as_soon_as_it_comes(took: float, every: int):
    stamps, ends = np.transpose(looks(perception_times(took), 2.0))
    assert np.diff(stamps) == pytest.approx(every * CONTROL_DT)
    assert (ends - stamps).max() <= LATENCY + took + 2.0 * TICK


def test_an_image_that_waits_for_too_long_is_passed_over():
    """A look of 40 ms ends in time for the image that has come meanwhile, one of 56 ms does not."""
    for took, most in ((0.04, LONGEST_WAIT), (0.056, 2.0 * TICK)):
        stamps, ends = np.transpose(looks(perception_times(took), 2.0))
        waited = ends - stamps - took - LATENCY
        assert waited.max() <= most + 2.0 * TICK


def test_perception_times_are_drawn_from_a_range_by_a_seed():
    drawn = [perception_times(0.06, 0.01, seed=3) for _ in range(2)]
    times = np.array([[time() for _ in range(200)] for time in drawn])
    assert np.array_equal(times[0], times[1])
    assert 0.06 <= times.min() < 0.061 < 0.069 < times.max() <= 0.07
    with pytest.raises(InvalidValueError, match="-10 ms more"):
        perception_times(0.06, -0.01)


class HeldUp(Segmenter):
    """Looks when it is let."""

    def __init__(self) -> None:
        self._segmenter, self.has_begun, self.may_go_on = ColorThreshold(RED), Event(), Event()
        self.settled_by = SimpleQueue[str]()

    def start(self, image: Pixels, prompt: Prompt, motion: ImageMotion | None = None) -> Segmentation:
        self._wait()
        return self._segmenter.start(image, prompt, motion)

    def track(self, image: Pixels, motion: ImageMotion | None = None) -> Segmentation:
        self._wait()
        return self._segmenter.track(image, motion)

    def settle(self) -> None:
        self.settled_by.put(current_thread().name)

    def reset(self) -> None:
        self._segmenter.reset()

    def _wait(self) -> None:
        self.has_begun.set()
        assert self.may_go_on.wait(PATIENCE)
        self.may_go_on.clear()


class Threaded:
    """A look in a thread, which ends when it is told to."""

    def __init__(self, executor: Executor) -> None:
        self.clock = StepClock(lambda _: None)
        self.segmenter = HeldUp()
        self.pipeline: PolicyPipeline = new_pipeline(self.segmenter, remembering())
        self.perception = ConcurrentPerception(self.pipeline, executor, self.clock)

    def show(self, stamp: float) -> None:
        self.clock.time = stamp
        self.perception.offer(Image(pixels=picture(), stamp=stamp))
        assert self.perception.go_on() is None
        assert self.segmenter.has_begun.wait(PATIENCE)
        self.segmenter.has_begun.clear()

    def end(self) -> bool:
        """End the look; return whether it was at an image of this throw."""
        self.segmenter.may_go_on.set()
        while not self.perception.is_free:
            if self.perception.go_on():
                return True
        return False


@pytest.fixture
def lab() -> Iterator[Threaded]:
    with ThreadPoolExecutor(1, thread_name_prefix="perception") as executor:
        yield Threaded(executor)


def test_decisions_go_on_while_a_thread_looks_and_boxes_get_older(lab: Threaded):
    lab.perception.begin(PROMPT)
    lab.show(1.0)
    assert lab.pipeline.decide(HOME, 1.01) is None
    assert lab.end()
    lab.show(1.1)
    for now in (1.11, 1.11 + CONTROL_DT):
        joint_targets = lab.pipeline.decide(HOME, now)
        assert joint_targets is not None
        assert (joint_targets.target_stamp, joint_targets.image_stamp) == (now, 1.0)
    assert lab.end()
    joint_targets = lab.pipeline.decide(HOME, 1.2)
    assert joint_targets is not None
    assert joint_targets.image_stamp == 1.1


def test_what_a_look_leaves_to_learn_is_learned_in_its_thread_when_it_is_done(lab: Threaded):
    lab.perception.begin(PROMPT)
    lab.show(1.0)
    assert lab.segmenter.settled_by.empty()
    assert lab.end()
    assert lab.segmenter.settled_by.get(timeout=PATIENCE) == "perception_0"


def test_a_look_that_ends_after_a_new_throw_began_is_forgotten(lab: Threaded):
    """And where the operator points is known when the next image is looked at."""
    lab.perception.begin(PROMPT)
    lab.show(1.0)
    lab.perception.begin(None)
    lab.perception.begin(PROMPT)
    assert not lab.end()
    assert lab.pipeline.decide(HOME, 1.1) is None
    lab.show(1.1)
    assert lab.end()
    assert lab.pipeline.decide(HOME, 1.2)


def test_what_goes_wrong_in_the_thread_is_told_to_who_asks(lab: Threaded):
    lab.perception.begin(PROMPT)
    lab.perception.offer(Image(pixels=picture()[:100], stamp=0.0))
    lab.perception.go_on()
    with pytest.raises(PerceptionError, match="480"):
        lab.end()
