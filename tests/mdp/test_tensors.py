"""Batched values: copies, and delays."""

from typing import NamedTuple

import pytest
import torch
from torch import Tensor

from pixel2catch.mdp.tensors import DelayLine, clone


class Pair(NamedTuple):
    first: Tensor
    second: Tensor


def test_clone_unfolds_shared_and_expanded_memory():
    """How an episode begins: one value in several places must not be written through another."""
    value = torch.zeros(4, 1)
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
