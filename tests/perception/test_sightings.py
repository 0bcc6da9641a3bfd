"""Following a stream of images: features, rows of the table, the summary and the pictures."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
import torch
from filmed import CAMERA, DISC, throw

from pixel2catch.camera.image import Box, Image, Verdict
from pixel2catch.envs.catch_env import CatchEnv
from pixel2catch.envs.cfg import CatchEnvCfg
from pixel2catch.mdp.control_step import BoxHistory
from pixel2catch.mdp.observations import ObservationInputs, pixels
from pixel2catch.mdp.tensors import clone
from pixel2catch.methods import find_method
from pixel2catch.perception import sightings as looks
from pixel2catch.perception.regions import PlausibilityCfg, find_blobs
from pixel2catch.perception.segmenter import ColorRange, ColorThreshold
from pixel2catch.perception.sightings import HEADER, Sighting, annotated, follow
from pixel2catch.perception.sources import Tick
from pixel2catch.perception.tracker import ObjectTracker, Prompter
from pixel2catch.scene.constants import CONTROL_DT, RGB_CAMERA

RED = ColorRange(hue=(340, 20))


def test_features_are_those_of_training():
    """The boxes of an episode, painted, seen again, and turned into features by the observation term."""
    env = CatchEnv(CatchEnvCfg(), find_method("proposed"), num_envs=1, seed=3)
    stay = {name: torch.zeros(1, size) for name, size in env.action_sizes.items()}
    measurements = [clone(env.step(stay).measurement) for _ in range(30)]
    env.close()
    boxes = [measurement.box.round() for measurement in measurements]
    assert len({tuple(box[0].tolist()) for box in boxes}) > 20

    def ticks() -> Iterator[Tick]:
        for i, box in enumerate(boxes):
            image = np.zeros((RGB_CAMERA.height, RGB_CAMERA.width, 3), dtype=np.uint8)
            xmin, ymin, xmax, ymax = box[0].int().tolist()
            image[ymin:ymax, xmin:xmax] = (220, 20, 20)
            yield Tick(image=Image(pixels=image, stamp=i * CONTROL_DT), now=i * CONTROL_DT)

    anything = PlausibilityCfg(least_area=1, largest_share=1.0, largest_jump=1e4, largest_sides=4)
    seen = list(follow(ticks(), ObjectTracker(ColorThreshold(RED), Prompter(colors=RED), limits=anything)))
    for now, box in zip(seen, boxes, strict=True):
        assert (now.box.verdict, list(now.box.edges)) == (Verdict.SEEN, box[0].tolist())
    pairs = zip(seen, boxes[:1] + boxes[:-1], boxes, measurements, strict=True)
    for now, before, box, measurement in pairs:
        frames = [
            replace(measurement, boxes=BoxHistory.begun(each, torch.zeros(1), 1)) for each in (before, box)
        ]
        inputs = ObservationInputs(
            before=frames[0], now=frames[1], joints=(), palms=(), pixel_columns=tuple(range(8))
        )
        assert list(now.features) == pixels(inputs)[0].tolist()


def test_skipped_images_are_counted():
    steps = {0: 0, 1: 0, 3: 1, 4: 0, 8: 3}
    image = np.zeros((CAMERA.height, CAMERA.width, 3), dtype=np.uint8)
    stamps = [(step + 0.1 * (step % 2)) * CONTROL_DT for step in steps]  # a camera is never quite on time
    ticks = [Tick(image=Image(pixels=image, stamp=stamp), now=stamp) for stamp in stamps]
    tracker = ObjectTracker(ColorThreshold(RED), Prompter(), camera=CAMERA)
    assert [each.num_skipped for each in follow(ticks, tracker)] == list(steps.values())


IMAGE = list(throw())[50]
MASK = DISC.mask(50)
EDGES = find_blobs(MASK)[0].box


def sighting(step: int, verdict: Verdict, took: float = 0.010, **changes) -> Sighting:
    is_new = verdict is not Verdict.REPEATED
    box = Box(verdict=verdict, is_valid=verdict is not Verdict.NO_PROMPT, edges=EDGES, age=0.0)
    pixels = changes.pop("pixels", np.full((2, 2, 3), step % 7, dtype=np.uint8))
    image = Image(pixels=pixels, stamp=(step - (not is_new)) * CONTROL_DT)
    return Sighting(
        tick=Tick(image=image, now=(step + 0.5) * CONTROL_DT),
        time=step * CONTROL_DT,
        box=replace(box, **changes),
        features=(0.0,) * 8,
        num_skipped=int(step == 4),
        durations={"segment": took, "total": took + 0.001} if is_new else {"total": 1e-5},
    )


def test_summary_by_hand():
    """Three of four new images since the first box show the object."""
    steps = [Verdict.NO_PROMPT, Verdict.SEEN, Verdict.SEEN, Verdict.REPEATED, Verdict.JUMP, Verdict.SEEN]
    summary = looks.summary([sighting(i, verdict).row() for i, verdict in enumerate(steps)])
    assert summary["num_steps"] == 6
    assert summary["verdicts"] == {"seen": 3, "no prompt": 1, "repeated image": 1, "jump": 1}
    assert summary["seen_since_first"] == pytest.approx(3 / 4)
    assert summary["num_skipped"] == 1
    assert summary["seconds"] == pytest.approx(5 * CONTROL_DT, abs=1e-4)
    assert summary["stages_ms"]["total"]["count"] == 5
    assert summary["stages_ms"]["total"]["p99"] == pytest.approx(11.0)
    assert summary["is_fast_enough"]
    assert not looks.summary([])["is_fast_enough"]
    assert looks.summary([])["seen_since_first"] is None


@pytest.mark.parametrize(
    ("stamps", "words"),
    [
        (np.arange(60) + np.tile((0.0, 0.3), 30), []),
        (np.delete(np.arange(60), [20, 40, 41]), ["2 gaps in the stamps, of up to 100 ms"]),
        (2.0 * np.arange(30), ["15 images a second, policies expect 30"]),
        (np.arange(2), []),
    ],
)
def test_lost_images_and_a_low_rate_are_said(stamps: np.ndarray, words: list[str]):
    rows = [{"stamp": f"{stamp * CONTROL_DT:.6f}", "verdict": Verdict.SEEN} for stamp in stamps]
    notes = list(looks.rate_notes(rows))
    assert [note[: len(word)] for note, word in zip(notes, words, strict=True)] == words


@pytest.mark.parametrize(("every", "is_fast_enough"), [(50, False), (200, True)])
def test_one_slow_image_in_a_hundred_is_allowed(every: int, is_fast_enough: bool):
    new = [sighting(i, Verdict.SEEN, 0.010 if i % every else 0.050).row() for i in range(600)]
    assert looks.summary(new)["is_fast_enough"] == is_fast_enough


def picture(verdict: Verdict = Verdict.SEEN, **changes) -> np.ndarray:
    """The part of the picture that shows the image."""
    drawn = annotated(sighting(0, verdict, **{"pixels": IMAGE, "mask": MASK, **changes}), CAMERA)
    return drawn[HEADER : HEADER + CAMERA.height]


def test_box_and_outline_are_drawn_around_the_object_on_a_copy():
    """A held box and an old one have other colours; without a box nothing is drawn."""
    before, drawn = IMAGE.copy(), picture()
    edge, outline = (np.argwhere((drawn == color).all(axis=-1)) for color in (looks.SEEN, looks.OUTLINE))
    np.testing.assert_array_equal((edge.min(axis=0) + 1)[::-1], EDGES[:2])
    np.testing.assert_array_equal(edge.max(axis=0)[::-1], EDGES[2:])
    assert MASK[tuple(outline.T)].all()
    np.testing.assert_array_equal(IMAGE, before)
    for color, age in ((looks.HELD, 0.0), (looks.STALE, 1.0)):
        held = picture(Verdict.NOT_FOUND, mask=None, age=age)
        assert (held == color).all(axis=-1).sum() == len(edge)
    np.testing.assert_array_equal(picture(Verdict.NO_PROMPT, mask=None), IMAGE)
    assert not picture(Verdict.BAD_IMAGE, mask=None, pixels=np.zeros((7, 9), dtype=np.uint16)).any()
