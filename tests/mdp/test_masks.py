"""Laws of choosing between, copying and cloning dataclasses of tensors."""

from dataclasses import dataclass
from typing import NamedTuple

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from snapshots import tensors
from torch import Tensor

from pixel2catch.mdp.tensors import assign, clone, select, write

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


@dataclass(frozen=True, kw_only=True)
class SimpleTree:
    flags: Tensor


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


def test_writing_into_columns_of_another_type():
    whole = torch.zeros(3, 2, dtype=torch.float64)
    write(torch.tensor([True, False, True]), torch.tensor([1.0, 2.0, 3.0]), whole[:, 1])
    assert whole.tolist() == [[0.0, 1.0], [0.0, 0.0], [0.0, 3.0]]


@given(MASKS, SEEDS)
def test_select_takes_rows_by_the_mask(mask, seed):
    new, old = tree(seed), tree(seed + 1)
    for chosen, a, b in zip(*map(tensors, (select(mask, new, old), new, old)), strict=True):
        assert torch.equal(chosen[mask], a[mask])
        assert torch.equal(chosen[~mask], b[~mask])
        assert chosen.dtype == a.dtype


@given(MASKS, SEEDS)
def test_laws_of_selection(mask, seed):
    new, old = tree(seed), tree(seed + 1)
    everywhere, nowhere = torch.ones_like(mask), torch.zeros_like(mask)
    assert are_equal(select(everywhere, new, old), new)
    assert are_equal(select(nowhere, new, old), old)
    assert are_equal(select(mask, new, new), new)
    assert are_equal(select(mask, new, old), select(~mask, old, new))
    assert are_equal(select(mask, select(mask, new, old), old), select(mask, new, old))


def test_select_does_not_write():
    new, old = tree(0), tree(1)
    select(torch.tensor([True, False, True, False]), new, old)
    assert are_equal(new, tree(0))
    assert are_equal(old, tree(1))


def test_nan_in_what_is_not_chosen_does_not_leak():
    nan = torch.full((NUM_ENVS, 2), torch.nan)
    chosen = select(torch.tensor([True, False, True, False]), torch.zeros(NUM_ENVS, 2), nan)
    assert chosen.isnan().any(dim=-1).tolist() == [False, True, False, True]


@given(SEEDS)
def test_assign_copies_values_into_the_same_memory(seed):
    target, source = tree(seed), tree(seed + 1)
    addresses = [tensor.data_ptr() for tensor in tensors(target)]
    assign(target, source)
    assert are_equal(target, source)
    assert [tensor.data_ptr() for tensor in tensors(target)] == addresses
    source.matrix.add_(1.0)
    assert not are_equal(target, source)


def test_assign_refuses_another_layout():
    with pytest.raises(AttributeError, match="matrix"):
        assign(tree(0), SimpleTree(flags=torch.ones(NUM_ENVS)))


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


def test_clone_of_a_dictionary():
    original = {"a": torch.ones(2), "b": Pair(torch.zeros(2), torch.zeros(2))}
    copy = clone(original)
    copy["a"].zero_()
    assert original["a"].all()
    assert list(copy) == ["a", "b"]
