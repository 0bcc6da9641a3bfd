"""The tables of a report as values: the terminal and the page show the same."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from pixel2catch.identification.check_report import verdict
from pixel2catch.identification.checks import Check
from pixel2catch.identification.fit import Fit
from pixel2catch.identification.fit_problem import LATENCY_UNIT
from pixel2catch.identification.identifiability import (
    CONFIDENCE,
    UNITS,
    WELL_KNOWN,
    WeakDirection,
    half_widths,
    ratios,
    weak_directions,
)
from pixel2catch.identification.identify import Identification, Motion, tracking_errors
from pixel2catch.mdp.randomization import GainRanges
from pixel2catch.robot.constants import JOINTS
from pixel2catch.robot.joint_dynamics import PARAMETERS

FILTER = ("filter_gain", "filter_lookahead")
"""Parameters that a joint without a filter does not have."""

UNKNOWN_SHARE = 0.9
"""An interval of this share of the prior's tells nothing that was not assumed. Source: ours."""

NO_BREAK = "\N{NO-BREAK SPACE}"

WIDE = 0.3
"""Half-width from which an interval is told as a factor, not in percent. Source: ours."""


class Cell(NamedTuple):
    """One entry: its text, a verdict (`good`, `weak`, `BAD`, `unknown`) that colours it, and a small note."""

    text: str
    verdict: str = ""
    note: str = ""


@dataclass(frozen=True, kw_only=True)
class Grid:
    """A table.

    Attributes:
        title: What it shows.
        columns: Heads of the columns.
        rows: As many cells each.
    """

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]


def short(joint: str) -> str:
    """The name of a joint for people."""
    return joint.removesuffix("_joint").replace("_joint_", " ").replace("_", " ")


def errors_grid(result: Identification) -> Grid:
    """Tracking error of every joint, on motion that was held out and on the fitted one."""
    groups = {"held out": result.of(is_held_out=True), "fitted": result.of(is_held_out=False)}
    columns, values = [], []
    for group, motions in groups.items():
        for name, errors in tracking_errors(motions).items() if motions else ():
            columns.append(f"{group}: {name}")
            values.append([*errors, np.sqrt(np.mean(errors**2))])
    names = [*map(short, result.fit.dynamics.joints), "all joints"]
    rows = [
        (
            Cell(name),
            *(Cell(f"{1e3 * value:.2f}", _improvement(columns, row, i)) for i, value in enumerate(row)),
        )
        for name, *row in zip(names, *values, strict=True)
    ]
    return Grid(title="Tracking error, RMS [mrad]", columns=("joint", *columns), rows=tuple(rows))


def _improvement(columns: Sequence[str], row: Sequence[float], i: int) -> str:
    """Verdict on an error after the fit: less than before and than that of the command, to the left."""
    if not columns[i].endswith("after"):
        return ""
    command, before, after = row[i - 2 : i + 1]
    return "BAD" if after >= before else "weak" if after >= command else "good"


def parameters_grid(result: Identification) -> Grid:
    """Value of every parameter with its 95 % interval, and what it was before."""
    fit, before = result.fit, result.start.before
    widths = dict(zip(fit.free, half_widths(fit).T, strict=True))
    names = [name for name in PARAMETERS if name not in FILTER or fit.dynamics.has_filter.any()]
    rows = []
    for j, joint in enumerate(fit.dynamics.joints):
        cells = []
        for name in names:
            value, old = getattr(fit.dynamics, name)[j], getattr(before, name)[j]
            width = widths[name][j] if name in widths else None
            cells.append(_parameter(name, value, old, width, fit.prior))
        rows.append((Cell(short(joint)), *cells))
    return Grid(
        title="Parameters with 95 % intervals",
        columns=("joint", *(f"{name} [{_unit(name)}]" for name in names)),
        rows=tuple(rows),
    )


def _unit(name: str) -> str:
    return "ms" if name == "latency" else UNITS[name]


def _parameter(name: str, value: float, old: float, width: float | None, prior: float) -> Cell:
    """A cell of the parameters."""
    scale = 1e3 if name == "latency" else 1.0
    note = f"before {_number(scale * old)}" if np.isfinite(old) else "no filter before"
    if width is None:
        text = _number(scale * value) if np.isfinite(value) else "no filter"
        return Cell(text, "unknown", "not fitted" if value == old else f"assumed; {note}")
    if width > UNKNOWN_SHARE * CONFIDENCE * prior:
        return Cell(f"{_number(scale * value)}, unknown", "BAD", note)
    return Cell(_interval(name, value, width), "good" if width <= WELL_KNOWN else "weak", note)


def _number(value: float) -> str:
    return f"{value:.4g}" if abs(value) < 1e4 else f"{value:.0f}"


def _interval(name: str, value: float, width: float) -> str:
    """A value with half of its interval, which is of its logarithm but for the latency."""
    if name == "latency":
        text = f"{1e3 * value:.2f} ± {1e3 * LATENCY_UNIT * width:.2f}"
    elif width < WIDE:
        text = f"{_number(value)} ± {100 * width:.1f} %"
    else:
        text = f"{_number(value)} to a factor of {np.exp(width):.2g}"
    return text.replace(" ", NO_BREAK)


def ratios_grid(fit: Fit) -> Grid:
    """Ratios of parameters with their 95 % intervals."""
    found = ratios(fit)
    rows = [
        (
            Cell(short(joint)),
            *(
                Cell(
                    _interval(ratio.name, ratio.value[j], ratio.half_width[j]),
                    "good" if ratio.half_width[j] <= WELL_KNOWN else "weak",
                )
                for ratio in found
            ),
        )
        for j, joint in enumerate(fit.dynamics.joints)
    ]
    columns = ("joint", *(f"{ratio.name} [{ratio.unit}]" for ratio in found))
    return Grid(title="Ratios with 95 % intervals", columns=columns, rows=tuple(rows) if found else ())


def ranges_grid(result: Identification) -> Grid:
    """Ranges of the factors on the gains in a training."""
    paper, ranges, names = GainRanges(), result.file.gains, [joint.name for joint in JOINTS]
    rows = []
    for joint in result.fit.dynamics.joints:
        i = names.index(joint)
        relative = ranges.is_damping_relative[i]
        rows.append(
            (
                Cell(short(joint)),
                _range(ranges.stiffness_scale[i], paper.stiffness_scale[i]),
                _range(ranges.damping_scale[i], paper.damping_scale[i]),
                Cell("drawn about the stiffness" if relative else "drawn apart"),
            )
        )
    columns = ("joint", "factor on stiffness", "factor on damping", "damping is")
    return Grid(title="Randomisation in training", columns=columns, rows=tuple(rows))


def _range(found: tuple[float, float], paper: tuple[float, float]) -> Cell:
    return Cell(f"{found[0]:.3f} to {found[1]:.3f}", note="as in the paper" if found == paper else "")


def whole_checks_grid(motions: Sequence[Motion]) -> Grid:
    """The checks that are about whole recordings."""
    rows = [
        (
            Cell(motion.recording.name),
            Cell(check.name),
            Cell(verdict(check), verdict(check)),
            Cell(check.detail),
        )
        for motion in motions
        for check in motion.source.checks
        if check.joint is None
    ]
    columns = ("recording", "check", "verdict", "found")
    return Grid(title="Clocks and samples", columns=columns, rows=tuple(rows))


def joint_checks_grid(motion: Motion) -> Grid:
    """The checks of every joint of a recording."""
    names = list(dict.fromkeys(check.name for check in motion.source.checks if check.joint))
    by_joint = {(check.joint, check.name): check for check in motion.source.checks}
    rows = [
        (Cell(short(joint)), *(_checked(by_joint[joint, name]) for name in names))
        for joint in motion.recording.joints
    ]
    return Grid(title=motion.recording.name, columns=("joint", *names), rows=tuple(rows))


def _checked(check: Check) -> Cell:
    return Cell(verdict(check), verdict(check), check.detail)


def open_questions(fit: Fit) -> list[str]:
    """What is not identified and what to do about it, one sentence for all joints of which it is true."""
    groups: dict[tuple[frozenset[str], bool], list[WeakDirection]] = {}
    for weak in weak_directions(fit):
        groups.setdefault((frozenset(weak.parameters), weak.is_scale), []).append(weak)
    return [f"{weak.meaning}: {weak.proposal}." for weak in map(_together, groups.values())]


def _together(group: Iterable[WeakDirection]) -> WeakDirection:
    """The widest of some directions, in the name of all their joints."""
    widest, *_ = ordered = sorted(group, key=lambda weak: -weak.half_width)
    names = [joint for joint in (spec.name for spec in JOINTS) if joint in {weak.joint for weak in ordered}]
    return replace(widest, joint=", ".join(map(short, names)))


def worst(errors: Float[np.ndarray, " num_joints"], joints: Sequence[str]) -> str:
    """The joint with the largest error, and the error [mrad]."""
    j = int(np.argmax(errors))
    return f"{short(joints[j])} with {1e3 * errors[j]:.2f} mrad"
