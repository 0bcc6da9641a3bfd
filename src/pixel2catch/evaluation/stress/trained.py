"""Whether a policy was trained on what a setting of the suite does, or meets that for the first time.

Decided from the ranges of its task alone: every episode of the setting must be one that the training could
have drawn, as far as the setting differs from the nominal task.
"""

from dataclasses import fields, is_dataclass
from typing import Any

from pixel2catch.envs.cfg import CatchEnvCfg
from pixel2catch.evaluation.stress.suite import Change
from pixel2catch.workcells import find_workcell

PARTS = ("scene", "throws", "randomization", "sensing", "shake")
"""Parts of a task that are compared; a setting that changes anything else is not trained on."""

GRIDS = {"latency_steps": "latency_grid", "command_delay": "command_delay_grid"}
"""Ranges of which only some values are drawn, and the field with the distance of these: 0 draws any."""

BOUNDS = ("spin", "corner_noise", "edge_noise", "initial_joint_noise")
"""The largest of what is drawn from 0: a smaller bound draws nothing new."""

SHARES = ("unstamped",)  #: Shares of episodes in which something happens: that it can is what counts.
TOLERANCE = 1e-9  #: Rounding of numbers that were computed from other units.


def is_trained_on(task: CatchEnvCfg, change: Change) -> bool:
    """Whether all that a setting makes of the nominal task lies within the training's, or a variant of it."""
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
    """Whether the fields of a part that differ from the nominal ones lie within the trained ones."""
    return all(
        _is_field_within(field.name, changed, trained)
        for field in fields(nominal)
        if getattr(nominal, field.name) != getattr(changed, field.name)
        and field.name not in GRIDS.values()  # they count with their ranges
    )


def _is_field_within(name: str, changed: Any, trained: Any) -> bool:
    """Whether all that one field of a part draws can be drawn in training."""
    inner, outer = getattr(changed, name), getattr(trained, name)
    if name in GRIDS:
        return _is_drawn(inner, getattr(changed, GRIDS[name]), outer, getattr(trained, GRIDS[name]))
    if name in BOUNDS:
        return _is_inside((0.0, inner), (0.0, outer))
    if name in SHARES:
        return (outer > 0.0 or inner == 0.0) and (outer < 1.0 or inner == 1.0)
    return _is_inside(inner, outer)


def _is_inside(inner: Any, outer: Any) -> bool:
    """Whether numbers, ranges, or structures of these lie within others; anything else must be the same."""
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
    """Whether all values of one delay are values of another one [control steps]."""
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
    """All values that a delay on a grid can have, as `mdp.randomization.sample_delay` draws them."""
    first, last = limits
    count = int((last - first) / grid + 1e-6) + 1 if grid else 1
    return [first + number * grid for number in range(count)]


def _as_range(value: Any) -> tuple[float, float] | None:
    """A number, or a range of numbers, as a range; nothing for anything else."""
    ends: Any = value if isinstance(value, tuple) and len(value) == 2 else (value, value)
    is_range = all(isinstance(end, int | float) and not isinstance(end, bool) for end in ends)
    return ends if is_range else None
