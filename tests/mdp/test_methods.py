"""Methods by name, and what a memory adds to one."""

from dataclasses import replace

import pytest

from pixel2catch.errors import UnknownNameError
from pixel2catch.mdp.observations import NUM_BOXES, box_age, box_fit, box_track
from pixel2catch.methods import find_method
from pixel2catch.policy import contract_of, method_of


@pytest.mark.parametrize(
    ("memory", "num_boxes", "terms"),
    [("age", 1, (box_age,)), ("boxes", 8, (box_track,)), ("fit", NUM_BOXES, (box_fit,))],
)
def test_boxes_and_terms_of_each_memory(memory: str, num_boxes: int, terms: tuple[object, ...]):
    method = find_method(f"catch+{memory}")
    assert method.num_boxes == num_boxes
    assert all(agent.memory == terms for agent in method.agents)


@pytest.mark.parametrize("name", ["without_pf", "object_position"])
def test_without_pixel_features_a_memory_is_the_age(name: str):
    method = find_method(f"{name}+fit")
    assert (method.name, method.num_boxes) == (f"{name}+fit", 1)
    assert all(agent.memory == (box_age,) for agent in method.agents)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("propsed", r"'propsed'.*proposed"),
        ("+fit", r"unknown method ''"),
        ("catch+nonsense", r"'nonsense'.*age, boxes, fit"),
        ("catch+age+fit", r"'age\+fit'"),
        ("catch+boxes0", r"'boxes0'.*boxes5"),
    ],
)
def test_an_unknown_name_is_refused_with_the_valid_ones(name: str, message: str):
    with pytest.raises(UnknownNameError, match=message):
        find_method(name)


def test_a_number_behind_a_memory_is_that_of_its_boxes():
    """Of five boxes: the newest's centre and size, four speeds of both, five ages."""
    method = find_method("proposed+boxes5")
    assert (method.name, method.num_boxes) == ("proposed+boxes5", 5)
    assert contract_of(method).agents["arm"].observation[-1] == ("box_track[t]", 4 + 4 * 4 + 5)
    assert method_of(replace(contract_of(method), method="mine+boxes5")).num_boxes == 5
    assert find_method("without_pf+boxes5").num_boxes == 1
