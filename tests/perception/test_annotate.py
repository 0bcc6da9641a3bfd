"""Pictures: what is drawn, and where."""

from dataclasses import replace

import numpy as np
import torch
from filmed import CAMERA, DISC, throw

from pixel2catch.camera.boxes import box_of_mask
from pixel2catch.perception.annotate import (
    HEADER,
    HELD,
    OUTLINE,
    PLOT_HEIGHT,
    PLOT_ROWS,
    SEEN,
    STALE,
    Annotator,
    Color,
)
from pixel2catch.perception.extractor import CameraFrame, Extraction
from pixel2catch.perception.plausibility import Verdict
from pixel2catch.perception.sources import Tick
from pixel2catch.perception.tracking import Sighting

STEP = 50
IMAGE = list(throw())[STEP]
MASK = DISC.mask(STEP)
BOX = box_of_mask(torch.from_numpy(MASK)[None])[0]


def seen(image: np.ndarray = IMAGE, **changes) -> Sighting:
    """The object in flight, as the extractor would say it."""
    extraction = Extraction(
        box=BOX,
        before=BOX - 5.0,
        verdict=Verdict.SEEN,
        is_valid=True,
        is_fresh=True,
        age=0.017,
        score=0.9,
        num_skipped=0,
        mask=MASK,
        message="",
    )
    tick = Tick(frame=CameraFrame(image=image, stamp=0.0), now=0.017)
    return Sighting(tick=tick, time=0.0, extraction=replace(extraction, **changes), durations={"total": 0.01})


def picture(sighting: Sighting) -> np.ndarray:
    """The part of the picture that shows the image."""
    drawn = Annotator(CAMERA).picture(sighting)
    assert drawn.shape == (HEADER + CAMERA.height + PLOT_ROWS * PLOT_HEIGHT, CAMERA.width, 3)
    return drawn[HEADER : HEADER + CAMERA.height]


def places(image: np.ndarray, color: Color) -> np.ndarray:
    """Columns and rows of the pixels of a colour."""
    return np.argwhere((image == color).all(axis=-1))[:, ::-1]


def test_the_box_is_drawn_around_the_object_and_hides_none_of_it():
    edge = places(picture(seen()), SEEN)
    np.testing.assert_array_equal(edge.min(axis=0), BOX[0, :2] - 1)
    np.testing.assert_array_equal(edge.max(axis=0), BOX[0, 2:])
    assert not MASK[edge[:, 1], edge[:, 0]].any()


def test_the_outline_is_the_border_of_the_mask():
    outline = places(picture(seen()), OUTLINE)
    assert MASK[outline[:, 1], outline[:, 0]].all()
    assert len(outline) < 0.5 * MASK.sum()


def test_a_box_that_is_held_or_old_has_another_colour():
    held = picture(seen(verdict=Verdict.NOT_FOUND, mask=None))
    stale = picture(seen(verdict=Verdict.NOT_FOUND, mask=None, is_fresh=False))
    assert len(places(held, HELD)) == len(places(stale, STALE)) > 20
    assert not len(places(held, OUTLINE))


def test_before_the_first_sight_there_is_no_box():
    nothing = picture(seen(verdict=Verdict.NO_PROMPT, mask=None, is_valid=False, age=float("inf")))
    np.testing.assert_array_equal(nothing, IMAGE)


def test_an_image_that_is_none_is_drawn_black():
    assert not picture(seen(np.zeros((7, 9), dtype=np.uint16), verdict=Verdict.BAD_IMAGE, mask=None)).any()


def test_plots_move_on():
    annotator = Annotator(CAMERA)
    plots = [annotator.picture(seen())[-PLOT_ROWS * PLOT_HEIGHT :] for _ in range(40)]
    assert len(places(plots[0], SEEN)) < len(places(plots[20], SEEN)) < len(places(plots[39], SEEN))


def test_the_image_itself_is_not_drawn_on():
    image = IMAGE.copy()
    Annotator(CAMERA).picture(seen(image))
    np.testing.assert_array_equal(image, IMAGE)
