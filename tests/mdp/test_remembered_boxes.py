"""The boxes that a policy remembers: of many robots step by step, and of one from stamps."""

import torch
from hypothesis import given
from hypothesis import strategies as st

from pixel2catch.mdp.snapshot import BoxHistory
from pixel2catch.scene.constants import CONTROL_DT


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


def test_boxes_of_a_beginning_do_not_share_memory():
    history = BoxHistory.begun(box(5.0), torch.tensor([1.5]), 3)
    history.box[0, 0] = 0.0
    assert history.box[0, 1:, 0].tolist() == [5.0, 5.0]


def test_a_new_box_comes_first_and_the_oldest_is_forgotten():
    history = advanced(BoxHistory.begun(box(5.0), torch.tensor([1.5]), 3), 6.0, 1.25)
    assert marks(history) == [[6.0, 5.0, 5.0]]
    assert history.age.tolist() == [[1.25, 2.5, 3.5]]
    history = advanced(history, 7.0, 1.5)
    assert marks(history) == [[7.0, 6.0, 5.0]]
    assert history.age.tolist() == [[1.5, 2.25, 3.5]]


def test_without_a_new_box_all_grow_older_each_environment_by_itself():
    history = BoxHistory.begun(box(5.0, 6.0), torch.tensor([1.0, 1.0]), 2)
    later = history.advanced(box(7.0, 8.0), torch.tensor([1.0, 2.0]), torch.tensor([True, False]))
    assert marks(later) == [[7.0, 5.0], [6.0, 6.0]]
    assert later.age.tolist() == [[1.0, 2.0], [2.0, 3.0]]
    assert history.age.tolist() == [[1.0, 2.0], [1.0, 2.0]]


def test_one_box_is_the_newest():
    history = BoxHistory.begun(box(5.0), torch.tensor([1.0]), 1)
    assert marks(advanced(history, 6.0, 1.0)) == [[6.0]]
    missed = advanced(history, 6.0, 1.0, is_new=False)
    assert (marks(missed), missed.age.tolist()) == ([[5.0]], [[2.0]])


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
