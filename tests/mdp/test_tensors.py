"""Laws of operations on batched values: select, copy, write, delay."""

from dataclasses import dataclass
from typing import NamedTuple

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from pixel2catch.mdp.tensors import DelayLine, clone, select, write
from snapshots import tensors

NUM_ENVS = 4
MASKS = st.lists(st.booleans(), min_size=NUM_ENVS, max_size=NUM_ENVS).map(torch.tensor)
SEEDS = st.integers(0, 2**31)


class Pair(NamedTuple):
    first: Tensor
    second: Tensor


@dataclass(frozen=True, kw_only=True)
class Tree:
    flags: Tensor
    matrix: Tensor
    pair: Pair


def tree(seed: int) -> Tree:
    generator = torch.Generator().manual_seed(seed)
    return Tree(
        flags=torch.rand(NUM_ENVS, generator=generator) < 0.5,
        matrix=torch.randn(NUM_ENVS, 2, 3, generator=generator),
        pair=Pair(
            torch.randn(NUM_ENVS, generator=generator), torch.randint(9, (NUM_ENVS, 5), generator=generator)
        ),
    )


def are_equal(a: Tree, b: Tree) -> bool:
    return all(torch.equal(x, y) for x, y in zip(tensors(a), tensors(b), strict=True))


@given(MASKS, SEEDS, SEEDS)
def test_writing_is_selecting_in_place(mask: Tensor, new_seed: int, old_seed: int):
    new, target = tree(new_seed), tree(old_seed)
    expected, memory = select(mask, new, target), [each.data_ptr() for each in tensors(target)]
    write(mask, new, target)
    assert are_equal(target, expected)
    assert [each.data_ptr() for each in tensors(target)] == memory


@given(MASKS, SEEDS)
def test_laws_of_selection(mask, seed):
    new, old = tree(seed), tree(seed + 1)
    everywhere, nowhere = torch.ones_like(mask), torch.zeros_like(mask)
    assert are_equal(select(everywhere, new, old), new)
    assert are_equal(select(nowhere, new, old), old)
    assert are_equal(select(mask, new, new), new)
    assert are_equal(select(mask, new, old), select(~mask, old, new))
    assert are_equal(select(mask, select(mask, new, old), old), select(mask, new, old))


@given(SEEDS)
def test_clone_is_equal_and_shares_nothing(seed):
    original = tree(seed)
    copy = clone(original)
    assert type(copy) is Tree
    assert type(copy.pair) is Pair
    assert are_equal(copy, original)
    for tensor in tensors(copy):
        tensor.zero_()
    assert are_equal(original, tree(seed))


def test_clone_unfolds_shared_and_expanded_memory():
    """How an episode begins: one value in several places must not be written through another."""
    value = torch.zeros(NUM_ENVS, 1)
    pair = clone(Pair(value.expand(-1, 3), value))
    pair.second.fill_(5.0)
    assert not pair.first.any()
    pair.first[:, 0] = 7.0
    assert pair.first[:, 1:].eq(0.0).all()


@pytest.mark.parametrize(
    ("latency", "expected"), [(0.0, 3.0), (0.9, 3.0), (1.0, 2.0), (1.99, 2.0), (2.5, 1.0)]
)
def test_a_value_does_not_arrive_before_its_time(latency, expected):
    """Of 1, 2, 3 the newest that is old enough: what lies between two control steps waits for the later."""
    line = DelayLine.filled(Pair(torch.zeros(1), torch.zeros(1, 3)), 2)
    for mark in (1.0, 2.0, 3.0):
        line = line.pushed(Pair(torch.full((1,), mark), torch.full((1, 3), -mark)))
    arrived = line.delivered(torch.tensor([latency]))
    assert (arrived.first.item(), *arrived.second[0].tolist()) == (expected, *[-expected] * 3)


def test_interpolation_by_hand():
    """Of 8, 2, 5, 1, the newest last: 1 + 0.25 (5 - 1) = 2, (5 + 2) / 2 = 3.5, 2 + 0.75 (8 - 2) = 6.5."""
    delay = torch.tensor([0.0, 0.25, 1.5, 2.75, 3.0])
    targets = DelayLine.filled(torch.full((5, 19), 8.0), 3)
    for number in (2.0, 5.0, 1.0):
        targets = targets.pushed(torch.full((5, 19), number))
    expected = torch.tensor([1.0, 2.0, 3.5, 6.5, 8.0])[:, None].expand(5, 19)
    torch.testing.assert_close(targets.interpolated(delay), expected)
