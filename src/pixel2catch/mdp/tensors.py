"""Operations on batched values: select and copy structures of tensors, delay values.

None of them waits for the device.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, is_dataclass
from typing import Any, Generic, TypeVar

import torch
from torch import Tensor

from pixel2catch.batches import Flags, Scalars
from pixel2catch.errors import InvalidValueError

T = TypeVar("T")


def select(mask: Flags, new: T, old: T) -> T:
    """Return `new` in the masked environments, `old` in the others.

    Both are tensors, or dataclasses, dictionaries or tuples of them; a part that is `None` stays `None`.
    """
    return mapped(lambda a, b: torch.where(mask.view(-1, *(1,) * (a.ndim - 1)), a, b), new, old)


def clone(value: T) -> T:
    """Return a copy that shares no memory."""
    return mapped(torch.clone, value)


def assign(target: T, source: T) -> None:
    """Copy every tensor of `source` into that of `target`, whose memory stays where it is."""
    mapped(lambda old, new: old.copy_(new), target, source)


def write(mask: Flags, new: T, target: T) -> None:
    """Copy `new` into `target`, whose memory stays where it is, in the masked environments.

    On the CPU only those rows are written; on a device that would wait for it.
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


@dataclass(frozen=True)
class DelayLine(Generic[T]):
    """Delayed values, tensors or dataclasses of tensors: the newest and its predecessors."""

    ages: tuple[T, ...]  #: Values by age in control steps, newest first.

    def delivered(self, delay: Scalars) -> T:
        """Return the value that is `delay` control steps old; between two, the newer one."""
        result = self.ages[0]
        for age, value in enumerate(self.ages[1:], start=1):
            result = select(delay >= age, value, result)
        return result

    def interpolated(self: "DelayLine[Tensor]", delay: Scalars) -> Tensor:
        """Return values (num_envs, k) `delay` control steps old, interpolated linearly."""
        ages = torch.stack(self.ages, dim=1)
        distance = delay[:, None] - torch.arange(len(self.ages), device=delay.device)
        return (torch.clamp(1.0 - distance.abs(), min=0.0)[..., None] * ages).sum(dim=1)

    def pushed(self, value: T) -> "DelayLine[T]":
        """Return the line one control step later."""
        return DelayLine((value, *self.ages[:-1]))

    @classmethod
    def filled(cls, value: T, longest: int) -> "DelayLine[T]":
        """Return a line for delays up to `longest` in which all values are equal: the start of an episode."""
        return cls((value,) * (longest + 1))


def require_shapes(
    kind: str, values: Any, shapes: Mapping[str, tuple[int | None, int]], device: str = ""
) -> None:
    """Raise InvalidValueError unless these agents have tensors of these shapes, where None is any size."""
    given = values if isinstance(values, Mapping) else {}
    for agent, (rows, size) in shapes.items():
        found, value = (), given.get(agent)
        if isinstance(value, Tensor) and not value.is_complex() and device in ("", value.device.type):
            found = tuple(value.shape)
        if len(found) != 2 or found != (found[0] if rows is None else rows, size):
            shown = f"of shape {found}" if found else f"{value!r:.200}"
            fix = f"give a tensor of shape ({rows or 'num_envs'}, {size}) of real numbers"
            fix += f" on {device}" if device else ""
            raise InvalidValueError(f"the {kind} of agent '{agent}' is {shown}; {fix}.")
    if unknown := [name for name in given if name not in shapes]:
        raise InvalidValueError(f"there is no agent '{unknown[0]}'; give an {kind} for {', '.join(shapes)}.")
