"""Choosing between tensors environment by environment, without asking the device which."""

from dataclasses import fields, is_dataclass
from typing import TypeVar

import torch
from jaxtyping import Bool
from torch import Tensor

T = TypeVar("T")


def select(mask: Bool[Tensor, " num_envs"], new: T, old: T) -> T:
    """A tensor, or a dataclass or tuple of them, that is `new` in the masked environments and `old` in the others."""
    if isinstance(new, Tensor):
        return torch.where(mask.view(-1, *(1,) * (new.ndim - 1)), new, old)
    if is_dataclass(new):
        names = [field.name for field in fields(new)]
        return type(new)(**{name: select(mask, getattr(new, name), getattr(old, name)) for name in names})
    return type(new)(*(select(mask, a, b) for a, b in zip(new, old, strict=True)))
