"""The tables of a report as values, for the terminal and the page alike; and what is not identified."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from rich.table import Table
from rich.text import Text

from pixel2catch.identification.checks import Check, num_reversals, smoothed
from pixel2catch.identification.fit import LATENCY_UNIT, SCALE, Fit
from pixel2catch.identification.identify import (
    RATIOS,
    Estimate,
    Identification,
    Motion,
    estimates,
    tracking_errors,
    worse_than_command,
)
from pixel2catch.identification.intervals import CONFIDENCE
from pixel2catch.identification.joints import short
from pixel2catch.identification.rehearsal import Assessment
from pixel2catch.mdp.dynamics_file import GainRanges
from pixel2catch.offline_page import Cell
from pixel2catch.robots.joint_dynamics import PARAMETERS

WELL_KNOWN = 0.1
"""Half-width of an interval up to which a parameter counts as identified: 10 %, or 1 ms. Source: ours."""

NOTABLE = 0.3  # share of a weak direction's largest component from which a parameter is named (ours)
UNKNOWN_WIDTH = 0.3  # half-width from which a parameter is not identifiable: 30 %, or 3 ms (ours)


class Told(NamedTuple):
    """How a parameter is told: its unit, and what motion shows it in positions."""

    unit: str
    excitation: str


TOLD = {
    "stiffness": Told("N·m/rad", "add motion that reaches the torque limit, or a known payload"),
    "damping": Told("N·m·s/rad", "add faster motion"),
    "frictionloss": Told("N·m", "add slow reversals"),
    "armature": Told("kg·m²", "add steps and faster changes of speed"),
    "latency": Told("ms", "add steps"),
    "filter_gain": Told("1/s²", "add steps"),
    "filter_lookahead": Told("s", "add 20 Hz targets of changing speed"),
}

FILTER = ("filter_gain", "filter_lookahead")  # parameters that a joint without a filter does not have

STYLES = {"good": "green", "BAD": "bold red", "weak": "yellow", "unknown": "dim"}
"""Colour of each verdict; the word tells without colour, too."""

NOTABLE_DRIFT = 5e-4  # difference of the clocks at the end of a recording that is told [s] (ours)
NOTABLE_PLAY = 2e-4  # play that is told [rad] (ours, a UR's noise)

COMMAND_IS_BETTER = (
    "Of {}, the command predicts the motion better than the simulation does. Either the model does not fit, "
    "or what was recorded as command is the controller's own target (such as RTDE's target_q), which is not "
    "what was sent. If that motion was held out, the dynamics file says so, and what reads it warns."
)

NO_BREAK = "\N{NO-BREAK SPACE}"


@dataclass(frozen=True, kw_only=True)
class Grid:
    """A table: its title, the heads of its columns, and rows of as many cells each."""

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]
    warnings: tuple[str, ...] = ()  #: what a reader of the table must know

    def for_terminal(self) -> Table:
        """The table without the notes of its cells, and below it the warnings."""
        caption = Text("\n".join(self.warnings), style="bold yellow", justify="left")
        table = Table(title=Text(self.title), caption=caption if self.warnings else None)
        for column in self.columns:
            table.add_column(Text(column), overflow="fold")
        for row in self.rows:
            table.add_row(*(Text(cell.text, style=STYLES.get(cell.verdict, "")) for cell in row))
        return table


def check_grid(name: str, checks: Sequence[Check]) -> Grid:
    """One line a check that failed or is of the whole recording, one for all joints that passed one."""
    num_bad = sum(check.is_good is False for check in checks)
    groups: dict[tuple[str, str, str | None], list[Check]] = {}
    for check in checks:
        alone = check.joint if check.is_good is False else None
        groups.setdefault((check.name, check.verdict, alone), []).append(check)
    rows = []
    for (title, verdict, _), group in groups.items():
        joint = group[0].joint or "" if len(group) == 1 else f"{len(group)} joints"
        detail = group[0].detail if len({check.detail for check in group}) == 1 else ""
        rows.append((Cell(title), Cell(joint), Cell(verdict, verdict), Cell(detail)))
    title = f"{name}: {num_bad} of {len(checks)} checks failed"
    return Grid(title=title, columns=("check", "joint", "", "found"), rows=tuple(rows))


def whole_checks_grid(motions: Sequence[Motion]) -> Grid:
    """The checks that are about whole recordings."""
    rows = tuple(
        (Cell(motion.recording.name), Cell(check.name), _verdict(check), Cell(check.detail))
        for motion in motions
        for check in motion.checks
        if check.joint is None
    )
    return Grid(title="Data checks", columns=("recording", "check", "verdict", "found"), rows=rows)


def joint_checks_grid(motion: Motion) -> Grid:
    """The checks of every joint of a recording."""
    names = list(dict.fromkeys(check.name for check in motion.checks if check.joint))
    by_joint = {(check.joint, check.name): check for check in motion.checks}
    rows = []
    for joint in motion.recording.joints:
        found = (by_joint[joint, name] for name in names)
        rows.append((Cell(short(joint)), *(_verdict(check, check.detail) for check in found)))
    return Grid(title=motion.recording.name, columns=("joint", *names), rows=tuple(rows))


def _verdict(check: Check, note: str = "") -> Cell:
    return Cell(check.verdict, check.verdict, note)


def errors_grid(result: Identification) -> Grid:
    """Tracking error of every joint, on motion that was held out and on the fitted one."""
    groups = {"held out": result.of(is_held_out=True), "fitted": result.of(is_held_out=False)}
    columns, values = [], []
    for group, motions in groups.items():
        for name, errors in tracking_errors(motions).items() if motions else ():
            columns.append(f"{group}: {name}")
            values.append([*errors, np.sqrt(np.mean(errors**2))])
    rows = []
    for name, *row in zip([*map(short, result.fit.dynamics.joints), "all joints"], *values, strict=True):
        cells = [Cell(f"{1e3 * value:.2f}") for value in row]
        for i in range(2, len(row), 3):  # less than before, and than that of the command
            verdict = "BAD" if row[i] >= row[i - 1] else "weak" if row[i] >= row[i - 2] else "good"
            cells[i] = cells[i]._replace(verdict=verdict)
        rows.append((Cell(name), *cells))
    worse = ", ".join(map(short, worse_than_command(result.motions)))
    return Grid(
        title="Tracking error, RMS [mrad]",
        columns=("joint", *columns),
        rows=tuple(rows),
        warnings=(COMMAND_IS_BETTER.format(worse),) if worse else (),
    )


def parameters_grid(result: Identification) -> Grid:
    """Value of every parameter with its 95 % interval, and what it was before."""
    fit, known = result.fit, estimates(result.fit)
    names = [name for name in PARAMETERS if name not in FILTER or fit.dynamics.has_filter.any()]
    rows = tuple(
        (Cell(short(joint)), *(_parameter(result, known.get(name), name, j) for name in names))
        for j, joint in enumerate(fit.dynamics.joints)
    )
    columns = ("joint", *(f"{name} [{TOLD[name].unit}]" for name in names))
    return Grid(
        title="Parameters with 95 % intervals",
        columns=columns,
        rows=rows,
        warnings=(*drift_warnings(result), *play_warnings(result.fit)),
    )


def drift_warnings(result: Identification) -> list[str]:
    """What is to be said of recordings whose clocks drift apart."""
    texts = []
    drifts, deviations = result.fit.encoders.drift, result.fit.encoder_deviations.drift
    for motion, row, deviation in zip(result.of(is_held_out=False), drifts, deviations, strict=True):
        seconds = float(np.ptp(motion.recording.t_meas))
        for drift, known in dict.fromkeys(zip(row.tolist(), deviation.tolist(), strict=True)):
            if abs(drift) > CONFIDENCE * known and abs(drift) * seconds > NOTABLE_DRIFT:
                texts.append(
                    f"{motion.recording.name}: the clock of the measurements is {1e6 * abs(drift):.0f} ± "
                    f"{1e6 * CONFIDENCE * known:.0f} ppm {'fast' if drift > 0 else 'slow'}, "
                    f"{1e3 * abs(drift) * seconds:.1f} ms in {seconds:.0f} s. The fit makes up for it, the "
                    "latency is that of the beginning. Take both times from one clock, or synchronise them."
                )
    return texts


def play_warnings(fit: Fit) -> list[str]:
    """What is to be said of joints with play."""
    play, known = fit.encoders.play, CONFIDENCE * fit.encoder_deviations.play
    loose = [
        f"{short(joint)} {1e3 * play[j]:.1f} ± {1e3 * known[j]:.1f}"
        for j, joint in enumerate(fit.dynamics.joints)
        if play[j] > max(known[j], NOTABLE_PLAY)
    ]
    if not loose:
        return []
    return [
        f"Play between servo and encoder [mrad]: {', '.join(loose)}. The fit makes up for it; training has "
        "none: tighten it, or train with an error of the encoders as large (sensing.joint_bias)."
    ]


def _parameter(result: Identification, known: Estimate | None, name: str, j: int) -> Cell:
    value, old = (getattr(each, name)[j] for each in (result.fit.dynamics, result.start.before))
    note = f"before {_number(name, old)}" if np.isfinite(old) else "no filter before"
    if known:
        return _estimate(known, j, note)
    text = _number(name, value) if np.isfinite(value) else "no filter"
    return Cell(text, "unknown", "not fitted" if value == old else f"assumed; {note}")


def _number(name: str, value: float) -> str:
    """A parameter in the unit in which it is told."""
    value *= 1e3 if name == "latency" else 1.0
    return f"{value:.4g}" if abs(value) < 1e4 else f"{value:.0f}"


def _estimate(known: Estimate, j: int, note: str = "") -> Cell:
    """A joint's value with half of its interval."""
    name, value, width = known.name, known.value[j], known.half_width[j]
    if width > UNKNOWN_WIDTH:
        return Cell(f"not identifiable ({_number(name, value)})", "BAD", note)
    if name == "latency":
        text = f"{1e3 * value:.2f} ± {1e3 * LATENCY_UNIT * width:.2f}"
    else:
        text = f"{_number(name, value)} ± {100 * width:.1f} %"
    return Cell(text.replace(" ", NO_BREAK), "good" if width <= WELL_KNOWN else "weak", note)


def ratios_grid(fit: Fit) -> Grid:
    """Ratios of parameters with their 95 % intervals; no rows if there are none."""
    found = [each for name, each in estimates(fit).items() if name in RATIOS]
    rows = tuple(
        (Cell(short(joint)), *(_estimate(ratio, j) for ratio in found))
        for j, joint in enumerate(fit.dynamics.joints if found else ())
    )
    columns = ("joint", *(f"{ratio.name} [{RATIOS[ratio.name]}]" for ratio in found))
    return Grid(title="Ratios with 95 % intervals", columns=columns, rows=rows)


def ranges_grid(result: Identification) -> Grid:
    """Ranges of the factors on the gains in a training."""
    workcell = result.start.workcell
    paper, ranges = GainRanges().of(workcell), result.file.gains.of(workcell)
    order, rows = [joint.name for joint in workcell.joints], []
    for joint in result.fit.dynamics.joints:
        i = order.index(joint)
        is_relative = ranges.is_damping_relative[i]
        cells = [Cell(short(joint))]
        for name in ("stiffness_scale", "damping_scale"):
            (low, high), of_paper = getattr(ranges, name)[i], getattr(paper, name)[i]
            note = "as in the paper" if (low, high) == of_paper else ""
            cells.append(Cell(f"{low:.3f} to {high:.3f}", note=note))
        cells.append(Cell("drawn about the stiffness" if is_relative else "drawn apart"))
        rows.append(tuple(cells))
    columns = ("joint", "factor on stiffness", "factor on damping", "damping is")
    return Grid(title="Randomisation in training", columns=columns, rows=tuple(rows))


@dataclass(frozen=True, kw_only=True)
class WeakDirection:
    """Parameters of a joint that can change together with hardly a change of its motion."""

    joint: str  #: name of the joint
    parameters: tuple[str, ...]  #: names of the parameters, the one that changes most first
    half_width: float  #: half of the 95 % interval along the direction, in the coordinates of the fit
    is_scale: bool  #: whether all of them grow together, so that their ratios are known

    @property
    def meaning(self) -> str:
        """The direction in a sentence."""
        names = " and ".join(self.parameters)
        if len(self.parameters) == 1:
            is_latency = self.parameters == ("latency",)
            width = self.half_width * LATENCY_UNIT if is_latency else np.exp(min(self.half_width, 9.0))
            known = f"to {1e3 * width:.1f} ms" if is_latency else f"to a factor of {width:.3g}"
            return f"{names} of {self.joint} is known {known} only"
        if self.is_scale:
            return f"{names} of {self.joint} share one scale: only their ratios are known"
        return f"{names} of {self.joint} stand in for each other"

    @property
    def proposal(self) -> str:
        """What to do about it."""
        fixed = "stiffness" if self.is_scale and "stiffness" in self.parameters else self.parameters[0]
        return f"fix {fixed} (leave it out of what is free), or {TOLD[fixed].excitation}"


def weak_directions(fit: Fit, limit: float = WELL_KNOWN) -> tuple[WeakDirection, ...]:
    """The directions in which a joint's parameters are less known than a half-width, widest first.

    Named are the parameters that take part in a direction.
    """
    found = []
    for joint, covariance in zip(fit.dynamics.joints, fit.covariance, strict=True):
        variances, directions = np.linalg.eigh(covariance)
        for half_width, along in zip(CONFIDENCE * np.sqrt(variances), directions.T, strict=True):
            if half_width > limit:
                order = np.argsort(-np.abs(along))
                part = [i for i in order if abs(along[i]) > NOTABLE * abs(along[order[0]])]
                is_scale = all(fit.free[i] in SCALE and along[i] * along[part[0]] > 0 for i in part)
                weak = WeakDirection(
                    joint=joint,
                    parameters=tuple(fit.free[i] for i in part),
                    half_width=float(half_width),
                    is_scale=is_scale and len(part) > 1,
                )
                found.append(weak)
    return tuple(sorted(found, key=lambda weak: -weak.half_width))


def open_questions(fit: Fit) -> list[str]:
    """What is not identified and what to do about it, one sentence for all joints of which it is true."""
    groups: dict[tuple[frozenset[str], bool], list[WeakDirection]] = {}
    for weak in weak_directions(fit):
        groups.setdefault((frozenset(weak.parameters), weak.is_scale), []).append(weak)
    questions = []
    for widest, *others in groups.values():
        weak_joints = {widest.joint, *(weak.joint for weak in others)}
        names = ", ".join(short(joint) for joint in fit.dynamics.joints if joint in weak_joints)
        together = replace(widest, joint=names)
        questions.append(f"{together.meaning}: {together.proposal}.")
    return questions


def motion_grid(title: str, assessment: Assessment) -> Grid:
    """One line a joint: range, top speed and acceleration, reversals, and torque as a share of its limit."""
    q = assessment.recording.q
    speed, acceleration = smoothed(assessment.recording.t_meas, q)
    rows = []
    for j, check in enumerate(assessment.checks):
        numbers = (
            f"{q[:, j].min():.2f}",
            f"{q[:, j].max():.2f}",
            f"{assessment.speed[j]:.2f}",
            f"{np.abs(acceleration[:, j]).max():.1f}",
            f"{num_reversals(speed[:, j])}",
            f"{100 * assessment.torque_share[j]:.0f}",
        )
        rows.append((Cell(check.joint or ""), _verdict(check), *map(Cell, numbers)))
    numbers = ("from [rad]", "to [rad]", "[rad/s]", "[rad/s²]", "reversals", "torque [%]")
    return Grid(title=title, columns=("joint", "verdict", *numbers), rows=tuple(rows))
