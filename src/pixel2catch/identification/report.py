"""Results of an identification: the dynamics file, an HTML report, tables, and numbers for programs.

The report is one HTML file without references to others. Its colours suit all kinds of colour vision. Source:
Okabe and Ito 2008; grey: ours.
"""

import io
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from rich.table import Table
from rich.text import Text

from pixel2catch.files import json_text, require_free_folder, write_atomically
from pixel2catch.identification.checks import DataCheck
from pixel2catch.identification.fit import LATENCY_UNIT, Fit
from pixel2catch.identification.identify import (
    RATIOS,
    REMEDIES,
    WELL_KNOWN,
    Estimate,
    Identification,
    SimulatedRecording,
    estimates,
    open_questions,
    short,
    tracking_errors,
    worse_than_command,
)
from pixel2catch.identification.intervals import CONFIDENCE
from pixel2catch.reports import Cell, box, element, listing, page, picture, section, table, what_was_run
from pixel2catch.robots.joint_dynamics import PARAMETERS

DYNAMICS, PAGE, NUMBERS = "dynamics.json", "report.html", "result.json"  # names of the files
UNKNOWN_WIDTH = 0.3  # half-width from which a parameter is not identifiable: 30 %, or 3 ms (ours)
NOTABLE_DRIFT = 5e-4  # least difference of the clocks at the end of a recording that is reported [s] (ours)
NOTABLE_PLAY = 2e-4  # least play that is reported [rad] (ours, a UR's noise)

COLORS = {"command": "#9A9A9A", "measured": "#000000", "before": "#E69F00", "after": "#0072B2"}
MARGINS = {"left": 0.07, "right": 0.985, "bottom": 0.16, "top": 0.98, "hspace": 0.12}
"""Room for the labels, as shares of the picture."""

LINES: dict[Any, Any] = {"font.size": 8, "axes.grid": True, "grid.color": "#E9E9E9", "lines.linewidth": 1.0}

STYLES = {"good": "green", "BAD": "bold red", "weak": "yellow", "unknown": "dim"}
"""Colour of each verdict in a terminal."""

NOTHING_HELD_OUT = (
    "Nothing was held out: the errors are those of fitted motion, and do not show how well other motion is "
    "simulated. Record at least two motions."
)
TRACKING = (
    "Predicted minus measured positions. 'command' is the error if the joint were at its command at once. "
    "The first half second of a recording is not compared."
)
COMMAND_IS_BETTER = (
    "Of {}, the command predicts the motion better than the simulation does. Either the model does not fit, "
    "or the recorded command is the controller's own target (such as RTDE's target_q) instead of what was "
    "sent. If that motion was held out, the dynamics file is marked, and commands that read it warn."
)

Content = dict[str, Any]


@dataclass(frozen=True, kw_only=True)
class Grid:
    """A table for the terminal and the report."""

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]
    warnings: tuple[str, ...] = ()  #: warnings for the reader of the table

    def for_terminal(self) -> Table:
        """Return the table without the notes of its cells, with the warnings below it."""
        caption = Text("\n".join(self.warnings), style="bold yellow", justify="left")
        table = Table(title=Text(self.title), caption=caption if self.warnings else None)
        for column in self.columns:
            table.add_column(Text(column), overflow="fold")
        for row in self.rows:
            table.add_row(*(Text(cell.text, style=STYLES.get(cell.verdict, "")) for cell in row))
        return table

    def for_page(self, text: str = "") -> str:
        """Return the table as a section of the report, below a text."""
        return section(self.title, text, table(self.columns, self.rows))


def check_grid(name: str, checks: Sequence[DataCheck]) -> Grid:
    """Return a table of checks; joints with the same verdict of a check share a row unless it failed."""
    num_bad = sum(check.is_good is False for check in checks)
    groups: dict[tuple[str, str, str | None], list[DataCheck]] = {}
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


def errors_grid(result: Identification) -> Grid:
    """Return the tracking error of every joint, on motion that was held out and on fitted motion."""
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
    """Return every parameter with its 95 % interval, and its value before."""
    fit, known = result.fit, estimates(result.fit)
    has_filter = fit.dynamics.has_filter.any()
    names = [name for name in PARAMETERS if has_filter or not name.startswith("filter")]
    rows = tuple(
        (Cell(short(joint)), *(_parameter(result, known.get(name), name, j) for name in names))
        for j, joint in enumerate(fit.dynamics.joints)
    )
    columns = ("joint", *(f"{name} [{REMEDIES[name][0]}]" for name in names))
    warnings = (*drift_warnings(result), *play_warnings(fit))
    return Grid(title="Parameters with 95 % intervals", columns=columns, rows=rows, warnings=warnings)


def _parameter(result: Identification, known: Estimate | None, name: str, j: int) -> Cell:
    value, old = (getattr(each, name)[j] for each in (result.fit.dynamics, result.start.before))
    note = f"before {_number(name, old)}" if np.isfinite(old) else "no filter before"
    if known:
        return _estimate(known, j, note)
    text = _number(name, value) if np.isfinite(value) else "no filter"
    return Cell(text, "unknown", "not fitted" if value == old else f"assumed; {note}")


def _number(name: str, value: float) -> str:
    value *= 1e3 if name == "latency" else 1.0
    return f"{value:.4g}" if abs(value) < 1e4 else f"{value:.0f}"


def _estimate(known: Estimate, j: int, note: str = "") -> Cell:
    """Return a joint's value with half of its interval."""
    name, value, width = known.name, known.value[j], known.half_width[j]
    if width > UNKNOWN_WIDTH:
        return Cell(f"not identifiable ({_number(name, value)})", "BAD", note)
    if name == "latency":
        text = f"{1e3 * value:.2f} ± {1e3 * LATENCY_UNIT * width:.2f}"
    else:
        text = f"{_number(name, value)} ± {100 * width:.1f} %"
    return Cell(text.replace(" ", "\N{NO-BREAK SPACE}"), "good" if width <= WELL_KNOWN else "weak", note)


def ratios_grid(fit: Fit) -> Grid:
    """Return ratios of parameters with their 95 % intervals; there may be no rows."""
    found = [each for name, each in estimates(fit).items() if name in RATIOS]
    rows = tuple(
        (Cell(short(joint)), *(_estimate(ratio, j) for ratio in found))
        for j, joint in enumerate(fit.dynamics.joints if found else ())
    )
    columns = ("joint", *(f"{ratio.name} [{RATIOS[ratio.name]}]" for ratio in found))
    return Grid(title="Ratios with 95 % intervals", columns=columns, rows=rows)


def drift_warnings(result: Identification) -> list[str]:
    """Return warnings about recordings whose clocks drift apart."""
    texts = []
    drifts, deviations = result.fit.encoders.drift, result.fit.encoder_deviations.drift
    for motion, row, deviation in zip(result.of(is_held_out=False), drifts, deviations, strict=True):
        seconds = float(np.ptp(motion.recording.t_meas))
        for drift, known in dict.fromkeys(zip(row.tolist(), deviation.tolist(), strict=True)):
            if abs(drift) > CONFIDENCE * known and abs(drift) * seconds > NOTABLE_DRIFT:
                texts.append(
                    f"{motion.recording.name}: the clock of the measurements is {1e6 * abs(drift):.0f} ± "
                    f"{1e6 * CONFIDENCE * known:.0f} ppm {'fast' if drift > 0 else 'slow'}, "
                    f"{1e3 * abs(drift) * seconds:.1f} ms in {seconds:.0f} s. The fit compensates it, the "
                    "latency is that of the beginning. Take both times from one clock, or synchronise them."
                )
    return texts


def play_warnings(fit: Fit) -> list[str]:
    """Return a warning about joints with play, if there are any."""
    play, known = fit.encoders.play, CONFIDENCE * fit.encoder_deviations.play
    loose = [
        f"{short(joint)} {1e3 * play[j]:.1f} ± {1e3 * known[j]:.1f}"
        for j, joint in enumerate(fit.dynamics.joints)
        if play[j] > max(known[j], NOTABLE_PLAY)
    ]
    if not loose:
        return []
    return [
        f"Play between servo and encoder [mrad]: {', '.join(loose)}. The fit compensates it; training has "
        "none: tighten it, or train with an error of the encoders as large (sensing.joint_bias)."
    ]


def write_report(folder: Path, result: Identification, circumstances: Mapping[str, Any]) -> None:
    """Write all files to a new or empty folder, the dynamics file last; else raise InvalidValueError."""
    content = json_text(numbers(result, circumstances))
    page = report_page(result, circumstances)
    require_free_folder(folder)
    folder.mkdir(parents=True, exist_ok=True)
    write_atomically({folder / PAGE: page.encode(), folder / NUMBERS: content.encode()})
    result.file.save(folder / DYNAMICS)


def report_page(result: Identification, circumstances: Mapping[str, Any]) -> str:
    """Return the HTML report."""
    ratios = ratios_grid(result.fit)
    open_ends = listing(open_questions(result.fit)) or element("p", "Every direction is identified.")
    parts = [
        *_summary(result),
        errors_grid(result).for_page(TRACKING),
        parameters_grid(result).for_page(),
        ratios.for_page() if ratios.rows else "",
        section("What is not identified", "", open_ends),
        _pictures(result),
        *(check_grid(motion.recording.name, motion.checks).for_page() for motion in result.motions),
        what_was_run(
            circumstances,
            f"free: {', '.join(result.fit.free)}; physics at {1 / result.physics_dt:.0f} Hz",
            *(f"{each.recording.name}: {_role(each)}" for each in result.motions),
        ),
    ]
    return page(f"System identification: {result.start.robot}", parts)


def _summary(result: Identification) -> Iterable[str]:
    """Return boxes with the main results, in the colours of verdicts."""
    joints, held_out = result.fit.dynamics.joints, result.of(is_held_out=True)
    errors = tracking_errors(held_out or result.motions)
    before, after = (1e3 * float(np.median(errors[name])) for name in ("before", "after"))
    kind = "motion that was held out" if held_out else "the fitted motion"
    worst = int(np.argmax(errors["after"]))
    texts = {} if held_out else {NOTHING_HELD_OUT: "BAD"}
    texts[
        f"On {kind}, the median joint's tracking error was {before:.2f} mrad before the fit and is "
        f"{after:.2f} mrad after it; the worst is {short(joints[worst])} with "
        f"{1e3 * errors['after'][worst]:.2f} mrad."
    ] = "good" if held_out else "unknown"
    warnings = (*errors_grid(result).warnings, *drift_warnings(result), *play_warnings(result.fit))
    texts |= dict.fromkeys(warnings, "weak")
    return [box(text, verdict) for text, verdict in texts.items()]


def _role(motion: SimulatedRecording) -> str:
    return "held out" if motion.is_held_out else "fitted"


def _pictures(result: Identification) -> str:
    """Return a picture of every joint in the motion that was held out, or in the last one."""
    shown = (result.of(is_held_out=True) or result.motions)[-1]
    key = "".join(f'<span style="background: {color}"></span>{name}' for name, color in COLORS.items())
    errors = tracking_errors([shown])
    figures = []
    for j, joint in enumerate(shown.recording.joints):
        before, after = (1e3 * errors[name][j] for name in ("before", "after"))
        caption = f"{short(joint)}: {before:.2f} mrad before, {after:.2f} mrad after"
        figures.append(picture(joint_picture(shown, j), "png", caption))
    return section(
        f"Motion: {shown.recording.name} ({_role(shown)})", "", f'<p class="key">{key}</p>', *figures
    )


def numbers(result: Identification, circumstances: Mapping[str, Any]) -> Content:
    """Return the results as numbers in SI units, by joint."""
    fit, joints = result.fit, result.fit.dynamics.joints
    errors = {
        group: tracking_errors(motions) if (motions := result.of(is_held_out)) else {}
        for group, is_held_out in (("held_out", True), ("fitted", False))
    }
    return {
        "robot": result.start.robot,
        "free": list(fit.free),
        "tracking_error": {
            group: {name: dict(zip(joints, values.tolist(), strict=True)) for name, values in found.items()}
            for group, found in errors.items()
        },
        "parameters": {joint: _parameters(result, j) for j, joint in enumerate(joints)},
        "not_identified": open_questions(fit),
        "warnings": [*drift_warnings(result), *play_warnings(fit)],
        "worse_than_command": list(result.file.worse_than_command),
        "recordings": [
            {"name": motion.recording.name, "is_held_out": motion.is_held_out} for motion in result.motions
        ],
        "circumstances": dict(circumstances),
    }


def _parameters(result: Identification, j: int) -> Content:
    """Return every parameter of a joint, its value before, and its 95 % interval if it was fitted."""
    found, known = dict[str, Content](), estimates(result.fit)
    for name in PARAMETERS:
        value, before = (float(getattr(each, name)[j]) for each in (result.fit.dynamics, result.start.before))
        content: Content = {"value": value, "before": before}
        if name in known:
            content["interval"] = known[name].interval[j].tolist()
        found[name] = {key: each if np.all(np.isfinite(each)) else None for key, each in content.items()}
    return found


def joint_picture(motion: SimulatedRecording, column: int) -> bytes:
    """Return a PNG of a joint's positions as commanded, measured and simulated, and its errors."""
    with matplotlib.rc_context(LINES):
        figure = Figure(figsize=(10.0, 2.6), dpi=120)  # its own layout engine would draw it three times
        whole, errors = figure.subplots(2, 1, sharex=True, height_ratios=(3, 1))
        figure.subplots_adjust(**MARGINS)
        _draw_positions(whole, motion, column)
        for name in ("before", "after"):
            error = getattr(motion, name)[:, column] - motion.measured[:, column]
            errors.plot(_time(motion), 1e3 * error, color=COLORS[name], linewidth=0.8)
        whole.set_ylabel("position [rad]")
        errors.set(ylabel="error [mrad]", xlabel="time [s]")
        figure.align_ylabels([whole, errors])
        buffer = io.BytesIO()
        FigureCanvasAgg(figure).print_png(buffer)
        return buffer.getvalue()


def _time(motion: SimulatedRecording) -> np.ndarray:
    return motion.time - motion.recording.t_meas[0]


def _draw_positions(axes: Axes, motion: SimulatedRecording, column: int) -> None:
    recording, time = motion.recording, _time(motion)
    sent, command = recording.t_cmd - recording.t_meas[0], recording.q_cmd[:, column]
    axes.step(sent, command, where="post", color=COLORS["command"], linewidth=0.8)
    axes.plot(time, motion.before[:, column], color=COLORS["before"])
    axes.plot(time, motion.measured[:, column], color=COLORS["measured"], linewidth=1.6)
    axes.plot(time, motion.after[:, column], color=COLORS["after"], linestyle=(0, (4, 2)))
    axes.set_xlim(time[0], time[-1])
