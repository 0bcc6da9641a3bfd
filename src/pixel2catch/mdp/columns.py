"""Columns of a tensor as slices, which select without an index tensor that a device must be given."""

from collections.abc import Sequence

import torch
from jaxtyping import Shaped
from torch import Tensor

Columns = tuple[slice, ...]


def merged(columns: Sequence[slice]) -> Columns:
    """The same columns, with slices that follow each other made one."""
    whole: list[slice] = []
    for each in columns:
        if whole and whole[-1].stop == each.start:
            whole[-1] = slice(whole[-1].start, each.stop)
        elif each.stop > each.start:
            whole.append(each)
    return tuple(whole)


def count(columns: Columns) -> int:
    """How many columns there are."""
    return sum(each.stop - each.start for each in columns)


def take(
    values: Shaped[Tensor, "num_envs k *rest"], columns: Columns
) -> Shaped[Tensor, "num_envs num_columns *rest"]:
    """Columns of a tensor, one after the other."""
    parts = [values[:, each] for each in columns]
    return parts[0] if len(parts) == 1 else torch.cat(parts, dim=1)


def put(parts: Sequence[tuple[Columns, Tensor]]) -> Tensor:
    """A tensor of which each part has some columns: `take` undone. Together they have all, each once."""
    placed = []
    for columns, values in parts:
        sizes = [each.stop - each.start for each in columns]
        pieces = values.split(sizes, dim=1)
        placed += [(each.start, piece) for each, piece in zip(columns, pieces, strict=True)]
    return torch.cat([piece for _, piece in sorted(placed, key=lambda each: each[0])], dim=1)
