"""Choosing between and copying dataclasses of tensors, without asking the device anything."""

from dataclasses import fields, is_dataclass
from typing import Any, TypeVar

import torch
from jaxtyping import Bool
from torch import Tensor

T = TypeVar("T", bound=Any)


def select(mask: Bool[Tensor, " num_envs"], new: T, old: T) -> T:
    """A tensor, or a dataclass or tuple of them, that is `new` in the masked environments and `old` in the others."""
    if isinstance(new, Tensor):
        return torch.where(mask.view(-1, *(1,) * (new.ndim - 1)), new, old)
    if is_dataclass(new):
        names = [field.name for field in fields(new)]
        return type(new)(**{name: select(mask, getattr(new, name), getattr(old, name)) for name in names})
    return type(new)(*(select(mask, a, b) for a, b in zip(new, old, strict=True)))


def assign(target: T, source: T) -> None:
    """Copy every tensor of `source` into that of `target`, whose memory stays where it is."""
    for old, new in zip(tensors(target), tensors(source), strict=True):
        old.copy_(new)


def clone(value: T) -> T:
    """The same values in memory of their own."""
    if isinstance(value, Tensor):
        return value.clone()
    if is_dataclass(value):
        return type(value)(**{field.name: clone(getattr(value, field.name)) for field in fields(value)})
    if isinstance(value, dict):
        return {name: clone(item) for name, item in value.items()}
    return type(value)(*(clone(item) for item in value))


def tensors(value: object) -> list[Tensor]:
    """Every tensor in a dataclass, tuple or dictionary of them, in a fixed order."""
    if isinstance(value, Tensor):
        return [value]
    if is_dataclass(value):
        value = [getattr(value, field.name) for field in fields(value)]
    elif isinstance(value, dict):
        value = list(value.values())
    return [tensor for item in value for tensor in tensors(item)]
