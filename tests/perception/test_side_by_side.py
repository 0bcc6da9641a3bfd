"""SAM 2 beside background subtraction: who is believed, whatever the one of them does.

SAM 2 has random weights, which show that nothing it does is taken for the object, not how well it sees; a
threshold of colour stands for one that sees the object by its look.
"""

from concurrent.futures import wait
from functools import cache
from threading import Event
from typing import final

import numpy as np
import painted
import pytest
from painted import HEIGHT, NUM_EMPTY, WIDTH, Disc, Follower

from domains import PATIENCE
from pixel2catch.camera.image import Mask, Pixels
from pixel2catch.perception.background import BackgroundSubtraction
from pixel2catch.perception.segmenter import (
    BoxPrompt,
    ColorRange,
    ColorThreshold,
    ImageMotion,
    Segmentation,
    Segmenter,
)
from pixel2catch.perception.side_by_side import Doubt, LastPlace, SideBySide, Source, choose

NUM_STILL, NUM_FLYING = 4, 14
NUM_STEPS = NUM_EMPTY + NUM_STILL + NUM_FLYING
BALL = Disc(path=painted.thrown(NUM_STILL, NUM_FLYING), radius=9.0)
RED = ColorRange(hue=(340.0, 20.0), saturation=(0.4, 1.0), value=(0.2, 1.0))


def held_box() -> BoxPrompt:
    xmin, ymin, xmax, ymax = painted.box_of(BALL.mask(NUM_EMPTY)).tolist()
    return BoxPrompt(box=(xmin, ymin, xmax, ymax))


@cache
def pictures() -> list[Pixels]:
    return list(painted.images((BALL,), NUM_STEPS))


def follow(segmenter: Segmenter) -> list[Segmentation]:
    """What is seen from the prompted image on."""
    results, follower = [], Follower(segmenter)
    for step, image in enumerate(pictures()):
        found = follower.start(image, held_box()) if step == NUM_EMPTY else follower.track(image)
        if step >= NUM_EMPTY:
            results.append(found)
        else:
            assert found.mask is None
    return results


def errors(results: list[Segmentation]) -> np.ndarray:
    """Largest error of an edge [px]; infinite where nothing was found."""
    boxes = [None if found.mask is None else painted.box_of(found.mask) for found in results]
    truths = [painted.box_of(BALL.mask(NUM_EMPTY + step)) for step in range(len(results))]
    pairs = zip(boxes, truths, strict=True)
    return np.array([np.inf if box is None else np.abs(box - truth).max() for box, truth in pairs])


@final
class Troubled(Segmenter):
    """Another segmenter, which fails in some images, or finds things in all of them that are not there."""

    def __init__(self, segmenter: Segmenter) -> None:
        self.segmenter, self.num_starts, self.num_tracked = segmenter, 0, 0
        self.failures: dict[int, Exception] = {}
        self.masks: dict[int, Mask | None] = {}
        self.go_on = Event()
        self.go_on.set()

    def start(self, image: Pixels, prompt: BoxPrompt, motion: ImageMotion | None = None) -> Segmentation:
        self.num_starts += 1
        return self.segmenter.start(image, prompt, motion)

    def track(self, image: Pixels, motion: ImageMotion | None = None) -> Segmentation:
        assert self.go_on.wait(PATIENCE)
        self.num_tracked += 1
        found = self.segmenter.track(image, motion)
        if failure := self.failures.get(self.num_tracked):
            raise failure
        if self.num_tracked not in self.masks:
            return found
        return Segmentation(mask=self.masks[self.num_tracked], score=1.0)

    def reset(self) -> None:
        self.segmenter.reset()


def pair(longest_wait: float | None = None) -> tuple[SideBySide, Troubled]:
    look = Troubled(ColorThreshold(RED))
    return SideBySide(look, BackgroundSubtraction(), longest_wait), look


def rectangle(left: int, top: int, right: int, bottom: int) -> Mask:
    mask = np.zeros((HEIGHT, WIDTH), dtype=bool)
    mask[top:bottom, left:right] = True
    return mask


# Expected at (100, 100).
LAST = LastPlace(center=(90.0, 100.0), box=(80.0, 90.0, 100.0, 110.0), velocity=(10.0, 0.0))
WHOLE = rectangle(0, 0, WIDTH, HEIGHT)
HERE = rectangle(90, 90, 110, 110)


@pytest.mark.parametrize(
    ("look", "motion", "source", "doubt", "overlap"),
    [
        # 15 × 20 of 400 + 400 - 300 pixels are in both.
        (HERE, rectangle(95, 90, 115, 110), Source.BOTH, None, 0.6),
        # 10 × 10 of 700; the middles are 0 and 14 px from where it should be, and the other way round.
        (HERE, rectangle(100, 100, 120, 120), Source.SAM2, Doubt.DISAGREEMENT, 1 / 7),
        (rectangle(100, 100, 120, 120), HERE, Source.BACKGROUND, Doubt.DISAGREEMENT, 1 / 7),
        (None, HERE, Source.BACKGROUND, Doubt.LOST, 0.0),
        (WHOLE, HERE, Source.BACKGROUND, Doubt.IMPLAUSIBLE, 0.0),
        (rectangle(250, 90, 270, 110), HERE, Source.BACKGROUND, Doubt.IMPLAUSIBLE, 0.0),
        (HERE | rectangle(250, 90, 270, 110), HERE, Source.BOTH, None, 1.0),
        (HERE, None, Source.SAM2, Doubt.ALONE, 0.0),
        (HERE, WHOLE, Source.SAM2, Doubt.ALONE, 0.0),
        (None, None, None, Doubt.LOST, 0.0),
        (WHOLE, None, None, Doubt.IMPLAUSIBLE, 0.0),
    ],
)
def test_who_is_believed(
    look: Mask | None, motion: Mask | None, source: Source | None, doubt: Doubt | None, overlap: float
):
    choice = choose(LAST, Segmentation(mask=look, score=1.0), motion)
    assert (choice.source, choice.doubt) == (source, doubt)
    assert choice.overlap == pytest.approx(overlap)
    assert (choice.blob is None) == (source is None)
    if choice.blob is not None:
        assert choice.blob.area == 400


def test_who_is_not_trusted_is_believed_with_the_other_only():
    seen = Segmentation(mask=HERE, score=1.0)
    near = rectangle(95, 90, 115, 110)
    both = choose(LAST, seen, near, is_trusted=False)
    assert both.source is Source.BOTH
    assert both.blob is not None
    np.testing.assert_array_equal(both.blob.mask(), near)
    apart = choose(LAST, seen, rectangle(100, 100, 120, 120), is_trusted=False)
    assert (apart.source, apart.doubt) == (Source.BACKGROUND, Doubt.DISAGREEMENT)
    alone = choose(LAST, seen, None, is_trusted=False)
    assert (alone.blob, alone.source, alone.doubt) == (None, None, Doubt.ALONE)


@pytest.mark.parametrize("doubt", [Doubt.LATE, Doubt.FAILED])
def test_who_is_late_or_failed_is_not_believed(doubt: Doubt):
    choice = choose(LAST, doubt, HERE)
    assert (choice.source, choice.doubt) == (Source.BACKGROUND, doubt)
    assert choose(LAST, doubt, None).source is None


def test_two_that_see_the_object_agree():
    segmenter, look = pair()
    results = follow(segmenter)
    assert (errors(results) <= 2.0).all()
    assert {found.source for found in results} == {"both"}
    assert min(found.score for found in results) > 0.6
    assert look.num_starts == 1


def test_sam2_goes_on_where_the_background_subtraction_loses_the_object():
    """Or takes something else for it, which SAM 2 is not told to follow."""
    look, motion = Troubled(ColorThreshold(RED)), Troubled(BackgroundSubtraction())
    motion.masks = {NUM_EMPTY + 5: None, NUM_EMPTY + 6: None, NUM_EMPTY + 7: WHOLE}
    motion.masks |= {NUM_EMPTY + step: rectangle(10, 200, 30, 220) for step in (9, 10, 11, 12)}
    results = follow(SideBySide(look, motion))
    assert (errors(results) <= 2.0).all()
    assert [found.source for found in results] == 5 * ["both"] + 3 * ["sam2"] + ["both"] + 4 * [
        "sam2"
    ] + 5 * ["both"]
    assert look.num_starts == 1


def test_who_went_wrong_is_not_believed_alone():
    """Hidden for four images: a right look goes on alone, one that was wrong before must agree first."""
    hidden = dict.fromkeys(range(NUM_EMPTY + 8, NUM_EMPTY + 12))
    expected = {True: ["sam2"] * 4, False: [""] * 4}
    for is_right, sources in expected.items():
        look, motion = Troubled(ColorThreshold(RED)), Troubled(BackgroundSubtraction())
        motion.masks = hidden
        look.masks = {} if is_right else {6: WHOLE, 7: WHOLE}
        results = follow(SideBySide(look, motion))
        assert [found.source for found in results][8:12] == sources
        assert results[12].source == "both"


def test_a_jump_and_a_failure_are_bridged():
    segmenter, look = pair()
    look.masks = {step: rectangle(250, 200, 270, 220) for step in (NUM_STILL, NUM_STILL + 1)}
    look.failures = {NUM_STILL + 4: RuntimeError("CUDA error: an illegal memory access was encountered")}
    results = follow(segmenter)
    assert (errors(results) <= 2.0).all()
    doubts = {step: found.doubt for step, found in enumerate(results) if found.doubt}
    assert doubts == {
        NUM_STILL: "sam2 implausible",
        NUM_STILL + 1: "sam2 implausible",
        NUM_STILL + 4: "sam2 failed",
    }
    assert look.num_starts == 1


def test_who_is_late_is_passed_by_and_comes_back():
    segmenter, look = pair(longest_wait=0.0)
    sources, follower = [], Follower(segmenter)
    for step, image in enumerate(pictures()):
        if step < NUM_EMPTY:
            follower.track(image)
            continue
        if step == NUM_EMPTY:
            segmenter._longest_wait = PATIENCE
            follower.start(image, held_box())
            continue
        is_held = NUM_EMPTY + 5 <= step < NUM_EMPTY + 9
        look.go_on.clear() if is_held else look.go_on.set()
        if not is_held and segmenter._work is not None:
            wait((segmenter._work,), PATIENCE)
        segmenter._longest_wait = 0.0 if is_held else PATIENCE
        found = follower.track(image)
        assert found.mask is not None
        error = np.abs(painted.box_of(found.mask) - painted.box_of(BALL.mask(step))).max()
        assert error <= 2.0
        sources.append(found.doubt or found.source)
    assert sources[4:8] == ["sam2 late"] * 4
    assert set(sources[:4] + sources[8:]) == {"both"}
    # Three images passed it by while it looked at the first of the four.
    assert look.num_tracked == len(sources) - 3
    assert look.num_starts == 1


def test_a_new_throw_forgets_the_one_before():
    segmenter, _ = pair()
    first = follow(segmenter)
    segmenter.reset()
    assert Follower(segmenter).track(pictures()[0]).mask is None
    again = follow(segmenter)
    assert [found.source for found in again] == [found.source for found in first]


def test_a_caller_may_paint_over_an_image_that_is_still_looked_at():
    segmenter, look = pair(longest_wait=0.0)
    picture, follower = pictures()[NUM_EMPTY], Follower(segmenter)
    follower.start(picture, held_box())
    assert segmenter._work is not None
    wait((segmenter._work,), PATIENCE)
    look.go_on.clear()
    given = picture.copy()
    assert follower.track(given).doubt == "sam2 late"
    given[:] = 0
    look.go_on.set()
    found = segmenter._work.result(PATIENCE)
    assert found.mask is not None
