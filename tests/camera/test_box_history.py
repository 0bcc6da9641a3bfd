from dataclasses import replace

import pytest
import torch

from pixel2catch.mdp.observations import (
    BOUND,
    BOX_FIT_FEATURES,
    NUM_BOXES,
    STEPS_PER_SECOND,
    TYPICAL_SIZE,
    fit_boxes,
)
from pixel2catch.scene.constants import RGB_CAMERA

PATH = torch.tensor([[0.05, -0.1], [0.2, 0.6], [0.4, 2.0]])  # direction, speed, half of the acceleration
GROWTH = 0.8
MOTION = ("du", "dv", "ddu", "ddv", "growth", "residual")


def uneven_ages(num_envs: int = 4) -> torch.Tensor:
    generator = torch.Generator().manual_seed(0)
    return 1.5 + torch.cumsum(0.7 + 1.6 * torch.rand(num_envs, NUM_BOXES, generator=generator), dim=-1)


def boxes(age: torch.Tensor) -> torch.Tensor:
    """Boxes of a parabola whose size grows exponentially, seen at these ages [control steps]."""
    time = -age[..., None] / STEPS_PER_SECOND
    direction = PATH[0] + PATH[1] * time + PATH[2] * time**2
    focal = torch.tensor([RGB_CAMERA.fx, RGB_CAMERA.fy])
    center = torch.tensor([RGB_CAMERA.cx, RGB_CAMERA.cy]) + focal * direction
    half = TYPICAL_SIZE * torch.exp(GROWTH * time) / 2
    return torch.cat((center - half, center + half), dim=-1)


def named(features: torch.Tensor, *names: str) -> torch.Tensor:
    """The columns of these names, of both fits where a name leaves open which."""
    is_named = [{name, name.rpartition("_")[0]} & set(names) for name in BOX_FIT_FEATURES]
    return features[:, [i for i, found in enumerate(is_named) if found]]


def assert_close(actual: torch.Tensor, expected: torch.Tensor, atol: float = 5e-3) -> None:
    torch.testing.assert_close(actual, expected.expand_as(actual), atol=atol, rtol=2e-3)


@pytest.mark.parametrize("memory", ["short", "long"])
def test_a_parabola_without_noise_is_recovered_at_uneven_ages(memory: str):
    features = fit_boxes(boxes(uneven_ages()), uneven_ages(), RGB_CAMERA)
    names = [f"{name}_{memory}" for name in ("u", "v", "du", "dv", "ddu", "ddv")]
    assert_close(named(features, *names), PATH.flatten())
    assert_close(named(features, f"size_{memory}", f"growth_{memory}"), torch.tensor([0.0, GROWTH]))
    assert_close(named(features, f"residual_{memory}"), torch.zeros(1), atol=0.01)


def test_later_news_of_the_same_path_extrapolates_to_the_same_now():
    age = uneven_ages()
    early, late = (fit_boxes(boxes(a), a, RGB_CAMERA)[:, :-1] for a in (age, age + 2.5))
    assert_close(late, early, atol=0.01)


def test_an_unmoving_object_has_neither_speed_nor_growth():
    still = boxes(uneven_ages())[:, :1].expand(-1, NUM_BOXES, -1)
    features = fit_boxes(still, uneven_ages(), RGB_CAMERA)
    assert_close(named(features, *MOTION), torch.zeros(1), atol=1e-4)


def test_the_last_feature_is_the_age_of_the_newest_box():
    features = fit_boxes(boxes(uneven_ages()), uneven_ages(), RGB_CAMERA)
    assert features.shape == (4, len(BOX_FIT_FEATURES))
    torch.testing.assert_close(features[:, -1], uneven_ages()[:, 0] / 3)


@pytest.mark.parametrize("step", [0.0, 1e-6, 1e-3, 1.0, 100.0])
@pytest.mark.parametrize("first", [0.0, 2.0, 300.0])
def test_features_stay_bounded_whatever_the_ages(step: float, first: float):
    age = (first + step * torch.arange(float(NUM_BOXES))).expand(3, -1)
    generator = torch.Generator().manual_seed(1)
    for box in (boxes(uneven_ages(3)), 640 * torch.rand(3, NUM_BOXES, 4, generator=generator)):
        features = fit_boxes(box, age, RGB_CAMERA)
        assert features.isfinite().all()
        assert (features[:, :-1].abs() <= BOUND).all()
    assert fit_boxes(torch.zeros(3, NUM_BOXES, 4), age, RGB_CAMERA).isfinite().all()


def test_sizes_turn_directions_into_lengths():
    age = uneven_ages()
    features = fit_boxes(boxes(age), age, RGB_CAMERA)
    scaled = named(features, "far", "far_u", "far_v", "far_du", "far_dv", "far_growth")
    size = torch.exp(-named(features, "size_long"))
    expected = torch.cat(
        (torch.ones(4, 1), named(features, "u_long", "v_long", "du_long", "dv_long")), dim=-1
    )
    assert_close(scaled, size * torch.cat((expected, named(features, "growth_long")), dim=-1), atol=1e-5)


def test_equal_ages_give_no_speed():
    features = fit_boxes(boxes(uneven_ages()), torch.full((4, NUM_BOXES), 2.0), RGB_CAMERA)
    assert_close(named(features, "du", "dv", "ddu", "ddv", "growth"), torch.zeros(1), atol=1e-3)


def test_features_are_directions_whatever_the_focal_length():
    age = uneven_ages()
    box = boxes(age)
    axis = torch.tensor([RGB_CAMERA.cx, RGB_CAMERA.cy]).repeat(2)
    zoomed = replace(RGB_CAMERA, fx=2 * RGB_CAMERA.fx, fy=2 * RGB_CAMERA.fy)
    near, far = fit_boxes(axis + 2 * (box - axis), age, zoomed), fit_boxes(box, age, RGB_CAMERA)
    motion = ("u", "v", "du", "dv", "ddu", "ddv")
    assert_close(named(near, *motion), named(far, *motion), atol=1e-4)
