"""Kinds and strengths of disturbances as data: each level is a pure function from a task to a task."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

from pixel2catch.envs.cfg import CatchEnvCfg

Change = Callable[[CatchEnvCfg], CatchEnvCfg]
"""A task, changed; a change can be sent to another process."""


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
    """One kind of disturbance.

    Attributes:
        name: Its name on the command line.
        unit: Unit of the labels.
        levels: Its strengths.
    """

    name: str
    unit: str
    levels: tuple[Level, ...]


@dataclass(frozen=True, kw_only=True)
class Setting:
    """A level of an axis.

    Attributes:
        axis: The axis.
        level: The level.
    """

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


@dataclass(frozen=True)
class Part:
    """Sets fields of one part of a task.

    Attributes:
        name: The part, such as `sensing`.
        values: Its fields and what they become.
    """

    name: str
    values: Mapping[str, Any]

    def __call__(self, cfg: CatchEnvCfg) -> CatchEnvCfg:
        """The task with these fields."""
        return replace(cfg, **{self.name: replace(getattr(cfg, self.name), **self.values)})


@dataclass(frozen=True)
class Together:
    """Several changes, one after the other.

    Attributes:
        changes: The changes.
    """

    changes: tuple[Change, ...]

    def __call__(self, cfg: CatchEnvCfg) -> CatchEnvCfg:
        """The task after all of them."""
        for change in self.changes:
            cfg = change(cfg)
        return cfg


def part(name: str, **values: Any) -> Change:
    """Set fields of one part of the task, such as its `sensing`."""
    return Part(name, values)


def together(*changes: Change) -> Change:
    """Several changes, one after the other."""
    return Together(changes)
