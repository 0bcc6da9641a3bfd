"""Kinds and strengths of disturbances as data: each level is a pure function from a task to a task."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

from pixel2catch.envs.cfg import CatchEnvCfg

Change = Callable[[CatchEnvCfg], CatchEnvCfg]
"""A task, changed; a change can be sent to another process."""


@dataclass(frozen=True)
class FieldChange:
    """Sets fields of parts of a task, one part after the other: `(part, {field: value})`."""

    steps: tuple[tuple[str, Mapping[str, Any]], ...] = ()

    def __call__(self, cfg: CatchEnvCfg) -> CatchEnvCfg:
        """The task with these fields."""
        for name, values in self.steps:
            cfg = replace(cfg, **{name: replace(getattr(cfg, name), **values)})
        return cfg


def part(name: str, **values: Any) -> FieldChange:
    """Set fields of one part of the task, such as its `sensing`."""
    return FieldChange(((name, values),))


def together(*changes: FieldChange) -> FieldChange:
    """Several changes, one after the other."""
    return FieldChange(tuple(step for change in changes for step in change.steps))


@dataclass(frozen=True, kw_only=True)
class Level:
    """One strength of a disturbance.

    Attributes:
        label: What the tables call it, without the unit.
        change: What it does to the task.
        source: Where the number comes from.
    """

    label: str
    change: Change
    source: str


@dataclass(frozen=True, kw_only=True)
class Axis:
    """One kind of disturbance: its name on the command line, the unit of the labels, its strengths."""

    name: str
    unit: str
    levels: tuple[Level, ...]


@dataclass(frozen=True, kw_only=True)
class Setting:
    """A level of an axis."""

    axis: Axis
    level: Level

    @property
    def name(self) -> str:
        """Name of its files: letters, digits, dots and hyphens."""
        return f"{self.axis.name}-{self.level.label}".replace(" ", "_").replace("±", "").rstrip("-")

    @property
    def title(self) -> str:
        """What people read."""
        space = "" if self.axis.unit == "°" else " "
        return f"{self.axis.name.replace('_', ' ')} {self.level.label}{space}{self.axis.unit}".strip()
