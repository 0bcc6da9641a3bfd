"""Following a stream, and the numbers that are said of it."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
import torch
from filmed import CAMERA, HELD, PATH, throw

from pixel2catch.camera.boxes import PIXEL_FEATURES
from pixel2catch.perception.color import ColorRange, ColorThreshold
from pixel2catch.perception.extractor import CameraFrame, Extraction, PixelFeatureExtractor
from pixel2catch.perception.plausibility import Verdict
from pixel2catch.perception.prompt import Prompter
from pixel2catch.perception.sources import Tick, on_control_clock
from pixel2catch.perception.tracking import COLUMNS, Sighting, Tally, follow
from pixel2catch.scene.constants import CONTROL_DT

RED = ColorRange(hue=(340, 20))


def ticks() -> Iterator[Tick]:
    frames = (CameraFrame(image=image, stamp=step * CONTROL_DT) for step, image in enumerate(throw()))
    return on_control_clock(frames, [])


def sightings(begin: float) -> list[Sighting]:
    prompter = Prompter(colors=RED)
    extractor = PixelFeatureExtractor(ColorThreshold(RED), prompter, camera=CAMERA, waits=True)
    return list(follow(ticks(), extractor, begin))


@pytest.mark.parametrize("step", [HELD, HELD + 3])
def test_nothing_is_pointed_out_before_its_time(step: int):
    """The object is there from image 40 on, and found in the very image that was meant."""
    seen = [sighting.extraction.verdict for sighting in sightings(step * CONTROL_DT)]
    assert seen[:step] == [Verdict.NO_PROMPT] * step
    assert seen[step:] == [Verdict.SEEN] * (len(PATH) - step)


def test_rows_say_what_was_seen():
    sighting = sightings(HELD * CONTROL_DT)[50]
    row = sighting.row()
    assert set(row) <= set(COLUMNS)
    assert float(row["time"]) == pytest.approx(50 * CONTROL_DT, abs=1e-4)
    assert float(row["stamp"]) == pytest.approx(50 * CONTROL_DT, abs=1e-6)
    center = 0.5 * (float(row["xmin"]) + float(row["xmax"])), 0.5 * (float(row["ymin"]) + float(row["ymax"]))
    np.testing.assert_allclose(center, PATH[50], atol=1.0)
    features = [float(row[name]) for name in PIXEL_FEATURES]
    np.testing.assert_allclose(features, sighting.extraction.features[0], rtol=1e-5)
    parts = sum(float(row[f"{stage}_ms"]) for stage in ("segment", "box"))
    assert 0.0 < parts <= float(row["total_ms"])


def sighting(step: int, verdict: Verdict, took: float = 0.010, skipped: int = 0) -> Sighting:
    """A control step whose image is as old as half a step, or one step more if it is repeated."""
    is_new = verdict is not Verdict.REPEATED
    image = np.full((2, 2, 3), step % 7, dtype=np.uint8)
    extraction = Extraction(
        box=torch.zeros(1, 4),
        before=torch.zeros(1, 4),
        verdict=verdict,
        is_valid=verdict is not Verdict.NO_PROMPT,
        is_fresh=True,
        age=0.0,
        score=0.0,
        num_skipped=skipped,
        mask=None,
        message="",
    )
    frame = CameraFrame(image=image, stamp=(step - (not is_new)) * CONTROL_DT)
    return Sighting(
        tick=Tick(frame=frame, now=(step + 0.5) * CONTROL_DT),
        time=step * CONTROL_DT,
        extraction=extraction,
        durations={"segment": took, "total": took + 0.001} if is_new else {"total": 1e-5},
    )


def tally_of(*seen: Sighting) -> Tally:
    tally = Tally()
    for each in seen:
        tally.add(each)
    return tally


def test_summary_by_hand():
    """Of four images since the first box three show the object; a repeated image is none."""
    steps = [Verdict.NO_PROMPT, Verdict.SEEN, Verdict.SEEN, Verdict.REPEATED, Verdict.JUMP, Verdict.SEEN]
    tally = tally_of(*(sighting(i, verdict, skipped=int(i == 4)) for i, verdict in enumerate(steps)))
    summary = tally.summary()
    assert summary["num_steps"] == tally.num_without_joints == 6
    assert summary["verdicts"] == {"seen": 3, "no prompt": 1, "repeated image": 1, "jump": 1}
    assert summary["seen_since_first"] == pytest.approx(3 / 4)
    assert summary["num_skipped"] == 1
    assert summary["num_identical"] == 0
    assert summary["seconds"] == pytest.approx(5 * CONTROL_DT)
    assert summary["longest_pause"] == pytest.approx(1.5 * CONTROL_DT)
    assert summary["stages_ms"]["total"]["count"] == 5
    assert summary["stages_ms"]["total"]["p99"] == pytest.approx(11.0)
    assert summary["is_fast_enough"]


def test_repeated_images_do_not_make_it_look_fast():
    slow = [sighting(2 * i, Verdict.SEEN, took=0.040) for i in range(5)]
    repeats = [sighting(2 * i + 1, Verdict.REPEATED) for i in range(5)]
    tally = tally_of(*slow, *repeats)
    assert tally.percentiles()["total"].p50 == pytest.approx(0.041)
    assert not tally.is_fast_enough


@pytest.mark.parametrize(("every", "is_fast_enough"), [(50, False), (200, True)])
def test_one_slow_image_in_a_hundred_is_allowed(every: int, is_fast_enough: bool):
    tally = tally_of(*(sighting(i, Verdict.SEEN, 0.010 if i % every else 0.050) for i in range(600)))
    assert tally.is_fast_enough == is_fast_enough


def test_a_camera_that_sends_an_image_twice_is_noticed():
    first = sighting(0, Verdict.SEEN)
    copy = replace(first.tick.frame, image=first.tick.frame.image.copy(), stamp=CONTROL_DT)
    again = replace(first, tick=Tick(frame=copy, now=1.5 * CONTROL_DT))
    assert tally_of(first, again, sighting(2, Verdict.SEEN)).summary()["num_identical"] == 1


def test_nothing_is_not_fast():
    tally = Tally()
    assert not tally.is_fast_enough
    assert tally.summary()["seen_since_first"] is None
