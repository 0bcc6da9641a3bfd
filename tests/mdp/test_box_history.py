"""Boxes that a policy remembers, and the fit through them."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from pixel2catch.mdp.control_step import BoxHistory
from pixel2catch.mdp.observations import (
    BOUND,
    BOX_FIT_FEATURES,
    NUM_BOXES,
    STEPS_PER_SECOND,
    TYPICAL_SIZE,
    fit_boxes,
)
from pixel2catch.scene.constants import CONTROL_DT, RGB_CAMERA


def box(*marks: float) -> torch.Tensor:
    """A box for each environment, told by its first number."""
    return torch.tensor([[mark, mark + 1.0, mark + 2.0, mark + 3.0] for mark in marks])


def marks(history: BoxHistory) -> list[list[float]]:
    assert torch.equal(history.box[..., 3], history.box[..., 0] + 3.0)
    return history.box[..., 0].tolist()


def advanced(history: BoxHistory, mark: float, age: float, is_new: bool = True) -> BoxHistory:
    return history.advanced(box(mark), torch.tensor([age]), torch.tensor([is_new]))


def of_stamps(marked: list[float], stamps: list[float], now: float, num_boxes: int) -> BoxHistory:
    """Stamps and time in control steps."""
    seconds = [CONTROL_DT * stamp for stamp in stamps]
    return BoxHistory.of_stamps(box(*marked), seconds, CONTROL_DT * now, num_boxes)


def test_a_history_begins_with_an_object_that_has_hovered():
    history = BoxHistory.begun(box(5.0, 9.0), torch.tensor([1.5, 2.0]), 4)
    assert marks(history) == [[5.0] * 4, [9.0] * 4]
    assert history.age.tolist() == [[1.5, 2.5, 3.5, 4.5], [2.0, 3.0, 4.0, 5.0]]


def test_without_a_new_box_all_grow_older_each_environment_by_itself():
    history = BoxHistory.begun(box(5.0, 6.0), torch.tensor([1.0, 1.0]), 2)
    later = history.advanced(box(7.0, 8.0), torch.tensor([1.0, 2.0]), torch.tensor([True, False]))
    assert marks(later) == [[7.0, 5.0], [6.0, 6.0]]
    assert later.age.tolist() == [[1.0, 2.0], [2.0, 3.0]]
    assert history.age.tolist() == [[1.0, 2.0], [1.0, 2.0]]


def test_stamps_by_hand():
    """At 10 control steps images of 3, 5.5 and 9 are 7, 4.5 and 1 old; before 3 there was one a step."""
    history = of_stamps([1.0, 2.0, 3.0], [3.0, 5.5, 9.0], 10.0, 5)
    assert marks(history) == [[3.0, 2.0, 1.0, 1.0, 1.0]]
    torch.testing.assert_close(history.age, torch.tensor([[1.0, 4.5, 7.0, 8.0, 9.0]]))
    assert marks(of_stamps([1.0, 2.0, 3.0], [3.0, 5.5, 9.0], 10.0, 2)) == [[3.0, 2.0]]
    assert marks(of_stamps([1.0], [3.0], 10.0, 3)) == [[1.0] * 3]


@given(st.lists(st.booleans(), min_size=0, max_size=12), st.floats(0.0, 4.0, width=32), st.integers(1, 5))
def test_stamps_of_even_steps_give_the_history_of_a_simulation(is_found, latency, num_boxes):
    """In each step an image arrives, `latency` old, in which the object may not be found."""
    history = BoxHistory.begun(box(0.0), torch.tensor([latency]), num_boxes)
    boxes, stamps = [0.0], [0.0]
    for step, is_new in enumerate(is_found, start=1):
        history = advanced(history, float(step), latency, is_new)
        if is_new:
            boxes, stamps = [*boxes, float(step)], [*stamps, float(step)]
    measured = of_stamps(boxes, stamps, len(is_found) + latency, num_boxes)
    assert torch.equal(measured.box, history.box)
    torch.testing.assert_close(measured.age, history.age, atol=1e-4, rtol=0)


PATH = torch.tensor([[0.05, -0.1], [0.2, 0.6], [0.4, 2.0]])  # direction, speed, half of the acceleration
GROWTH = 0.8


def uneven_ages(num_envs: int = 4) -> torch.Tensor:
    generator = torch.Generator().manual_seed(0)
    return 1.5 + torch.cumsum(0.7 + 1.6 * torch.rand(num_envs, NUM_BOXES, generator=generator), dim=-1)


def parabola(age: torch.Tensor) -> torch.Tensor:
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
    features = fit_boxes(parabola(uneven_ages()), uneven_ages(), RGB_CAMERA)
    names = [f"{name}_{memory}" for name in ("u", "v", "du", "dv", "ddu", "ddv")]
    assert_close(named(features, *names), PATH.flatten())
    assert_close(named(features, f"size_{memory}", f"growth_{memory}"), torch.tensor([0.0, GROWTH]))
    assert_close(named(features, f"residual_{memory}"), torch.zeros(1), atol=0.01)


@pytest.mark.parametrize("step", [0.0, 1e-6, 100.0])
@pytest.mark.parametrize("first", [0.0, 300.0])
def test_features_stay_bounded_whatever_the_ages(step: float, first: float):
    age = (first + step * torch.arange(float(NUM_BOXES))).expand(3, -1)
    generator = torch.Generator().manual_seed(1)
    for box in (parabola(uneven_ages(3)), 640 * torch.rand(3, NUM_BOXES, 4, generator=generator)):
        features = fit_boxes(box, age, RGB_CAMERA)
        assert features.isfinite().all()
        assert (features[:, :-1].abs() <= BOUND).all()
    assert fit_boxes(torch.zeros(3, NUM_BOXES, 4), age, RGB_CAMERA).isfinite().all()
