"""Choosing between and copying dataclasses of tensors, without asking the device anything."""

from collections.abc import Callable
from dataclasses import fields, is_dataclass
from typing import Any, TypeVar

import torch
from jaxtyping import Bool
from torch import Tensor

T = TypeVar("T")


def select(mask: Bool[Tensor, " num_envs"], new: T, old: T) -> T:
    """`new` in the masked environments, `old` in the others.

    Both are tensors, or dataclasses, dictionaries or tuples of them; a part that is `None` stays so.
    """
    return mapped(lambda a, b: torch.where(mask.view(-1, *(1,) * (a.ndim - 1)), a, b), new, old)


def clone(value: T) -> T:
    """The same values in memory of their own."""
    return mapped(torch.clone, value)


def assign(target: T, source: T) -> None:
    """Copy every tensor of `source` into that of `target`, whose memory stays where it is."""
    mapped(lambda old, new: old.copy_(new), target, source)


def write(mask: Bool[Tensor, " num_envs"], new: T, target: T) -> None:
    """Copy `new` into `target`, whose memory stays where it is, in the masked environments.

    On the CPU only those, mostly few, are touched; a device or a compiler is not asked which they are.
    """
    if mask.device.type == "cpu" and not torch.compiler.is_compiling():
        rows = mask.nonzero()[:, 0]
        mapped(lambda old, value: old.index_put_((rows,), value[rows].to(old.dtype)), target, new)
    else:
        assign(target, select(mask, new, target))


def mapped(function: Callable[..., Tensor], *values: Any) -> Any:
    """Apply a function to the corresponding tensors of values of one structure."""
    first = values[0]
    if first is None:
        return None
    if isinstance(first, Tensor):
        return function(*values)
    if is_dataclass(first):
        names = [field.name for field in fields(first)]
        return type(first)(**{name: mapped(function, *(getattr(v, name) for v in values)) for name in names})
    if isinstance(first, dict):
        return {name: mapped(function, *(value[name] for value in values)) for name in first}
    items = [mapped(function, *several) for several in zip(*values, strict=True)]
    return type(first)(*items) if hasattr(first, "_fields") else tuple(items)
