"""Whether the training of a policy covered a setting of the suite, from the ranges of its task alone.

Every episode of the setting must be one that the training could draw, in all fields in which the setting
differs from the nominal task.
"""

from dataclasses import fields, is_dataclass
from typing import Any

from pixel2catch.envs.cfg import CatchEnvCfg
from pixel2catch.evaluation.stress.suite import Change
from pixel2catch.workcells import find_workcell

PARTS = ("scene", "throws", "randomization", "sensing")
"""Parts of a task that are compared; a setting that changes another part is not trained on."""

GRIDS = {"latency_steps": "latency_grid", "command_delay": "command_delay_grid"}
"""Ranges with the field that holds the distance of their values; with 0 any value is drawn."""

BOUNDS = ("spin", "corner_noise", "edge_noise", "initial_joint_noise")
"""Fields that are the upper end of a range from 0."""

SHARES = ("unstamped",)  #: Shares of episodes in which an event happens; any share above 0 covers others.
TOLERANCE = 1e-9  #: Rounding of numbers that were computed from other units.


def is_trained_on(task: CatchEnvCfg, change: Change) -> bool:
    """Return whether a change of the nominal task is within the training's task or one of its variants."""
    nominal = CatchEnvCfg()
    changed = change(nominal)
    others = [field.name for field in fields(nominal) if field.name not in PARTS]
    if any(getattr(nominal, name) is not getattr(changed, name) for name in others):
        return False
    workcell = find_workcell(task.scene.workcell)
    nominal, changed, trained = (each.for_workcell(workcell) for each in (nominal, changed, task))
    return any(
        all(_is_within(getattr(nominal, p), getattr(changed, p), getattr(variant, p)) for p in PARTS)
        for variant in trained.all_variants
    )


def _is_within(nominal: Any, changed: Any, trained: Any) -> bool:
    """Return whether the fields of a part that differ from the nominal ones are within the trained ones."""
    return all(
        _is_field_within(field.name, changed, trained)
        for field in fields(nominal)
        if getattr(nominal, field.name) != getattr(changed, field.name)
        and field.name not in GRIDS.values()  # they count with their ranges
    )


def _is_field_within(name: str, changed: Any, trained: Any) -> bool:
    """Return whether training can draw all values of one field of a part."""
    inner, outer = getattr(changed, name), getattr(trained, name)
    if name in GRIDS:
        return _is_drawn(inner, getattr(changed, GRIDS[name]), outer, getattr(trained, GRIDS[name]))
    if name in BOUNDS:
        return _is_inside((0.0, inner), (0.0, outer))
    if name in SHARES:
        return (outer > 0.0 or inner == 0.0) and (outer < 1.0 or inner == 1.0)
    return _is_inside(inner, outer)


def _is_inside(inner: Any, outer: Any) -> bool:
    """Return whether numbers, ranges or structures of these are within others; other values must be equal."""
    if (drawn := _as_range(inner)) and (known := _as_range(outer)):
        return known[0] - TOLERANCE <= drawn[0] and drawn[1] <= known[1] + TOLERANCE
    if isinstance(inner, tuple) and isinstance(outer, tuple) and len(inner) == len(outer):
        return all(_is_inside(a, b) for a, b in zip(inner, outer, strict=True))
    if is_dataclass(inner) and not isinstance(inner, type) and type(inner) is type(outer):
        return all(_is_inside(getattr(inner, f.name), getattr(outer, f.name)) for f in fields(inner))
    return inner == outer


def _is_drawn(
    inner: tuple[float, float], inner_grid: float, outer: tuple[float, float], outer_grid: float
) -> bool:
    """Return whether all values of one delay are values of another one [control steps]."""
    if not _is_inside(inner, outer):
        return False
    if not outer_grid and outer[0] < outer[1]:
        return True
    if not inner_grid and inner[0] < inner[1]:
        return False
    return all(
        any(abs(value - other) < TOLERANCE for other in _values(outer, outer_grid))
        for value in _values(inner, inner_grid)
    )


def _values(limits: tuple[float, float], grid: float) -> list[float]:
    """Return all values of a delay on a grid, as `mdp.randomization.sample_delay` draws them."""
    first, last = limits
    count = int((last - first) / grid + 1e-6) + 1 if grid else 1
    return [first + number * grid for number in range(count)]


def _as_range(value: Any) -> tuple[float, float] | None:
    """Return a number or a range of numbers as a range; nothing for other values."""
    ends: Any = value if isinstance(value, tuple) and len(value) == 2 else (value, value)
    is_range = all(isinstance(end, int | float) and not isinstance(end, bool) for end in ends)
    return ends if is_range else None
