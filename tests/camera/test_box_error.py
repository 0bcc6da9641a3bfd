"""The box of the surface points against that of the rendered object: training needs no renderer."""

import pytest
import torch
from box_error import BoxErrors, compare, sample_frames

from pixel2catch.scene.objects import OBJECTS

NUM_POINTS = 64
FRAMES_PER_OBJECT = 9


@pytest.fixture(scope="module")
def frames() -> dict[str, torch.Tensor]:
    drawn = sample_frames(FRAMES_PER_OBJECT * len(OBJECTS)).chunk(len(OBJECTS))
    return dict(zip(OBJECTS, drawn, strict=True))


@pytest.fixture(scope="module")
def errors(opengl: None, frames: dict[str, torch.Tensor]) -> dict[str, BoxErrors]:
    return {name: compare(name, frames[name], NUM_POINTS) for name in OBJECTS}


def test_unoccluded_boxes_agree_within_a_pixel(errors: dict[str, BoxErrors], frames: dict[str, torch.Tensor]):
    """The tip of a cone or prism can be too thin to cover the middle of a pixel; finer pixels show it."""
    num_free = num_thin = 0
    for name, each in errors.items():
        is_free = ~each.is_hit & ~each.is_cut
        is_thin = is_free & (each.worst_edge > 1.0)
        assert (each.num_pixels[is_free] > 0).all()
        if is_thin.any():
            fine = compare(name, frames[name][is_thin], NUM_POINTS, magnification=4)
            assert fine.worst_edge.max() <= 0.5, name
        num_free, num_thin = num_free + int(is_free.sum()), num_thin + int(is_thin.sum())
    assert num_free >= 120
    assert num_thin <= 0.01 * num_free


def test_errors_have_no_bias(errors: dict[str, BoxErrors]):
    """A shift of the principal point or of the pixel grid by half a pixel would show here."""
    everything = BoxErrors.concatenate(list(errors.values()))
    mean = everything.select(~everything.is_hit & ~everything.is_cut).error.mean(0)
    assert ((mean[:2] + mean[2:]) / 2).abs().max() < 0.05


def test_occluded_boxes_are_close(errors: dict[str, BoxErrors]):
    everything = BoxErrors.concatenate(list(errors.values()))
    is_rendered, is_visible = everything.num_pixels > 0, everything.visible_fraction > 0
    hidden = everything.select(everything.is_hit & is_rendered & is_visible)
    assert len(hidden.error) >= 60
    assert hidden.worst_edge.median() <= 2.5
    assert hidden.worst_edge.quantile(0.9) <= 11.0  # of long objects, too, half of which can be hidden
    assert torch.equal(is_rendered, is_rendered | (everything.visible_fraction > 0.1))
    assert (is_rendered != is_visible).float().mean() < 0.03
