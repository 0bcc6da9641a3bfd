"""Results of an identification: the dynamics file, a report in Markdown, tables, and numbers for programs."""

from collections.abc import Mapping, Sequence
from io import BytesIO
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from pixel2catch.files import json_text, write_atomically
from pixel2catch.identification import identify
from pixel2catch.identification.checks import DataCheck
from pixel2catch.identification.fit import LATENCY_UNIT
from pixel2catch.identification.identify import CheckedRecording, Estimate, Identification, estimates, short
from pixel2catch.identification.intervals import CONFIDENCE
from pixel2catch.reports import Cells, Section, as_markdown
from pixel2catch.robots.joint_dynamics import PARAMETERS

DYNAMICS, REPORT, NUMBERS = "dynamics.json", "report.md", "result.json"  # names of the files
UNKNOWN_WIDTH = 0.3  # half-width from which a parameter is not identifiable: 30 %, or 3 ms (ours)
NOTABLE_DRIFT = 5e-4  # least difference of the clocks at the end of a recording that is reported [s] (ours)
NOTABLE_ZERO = 2e-3  # least error of a zero that is reported [rad] (ours)
NOTABLE_PLAY = 2e-4  # least play that is reported [rad] (ours, a UR's noise)

COLORS = {"command": "#9A9A9A", "before": "#E69F00", "measured": "#000000", "after": "#0072B2"}
"""Colours for readers with any kind of colour vision. Source: Okabe and Ito 2008; grey: ours."""

LINES: dict[Any, Any] = {"font.size": 8, "axes.grid": True, "grid.color": "#E9E9E9", "lines.linewidth": 1.0}

NOTHING_HELD_OUT = (
    "Nothing was held out: the errors are of fitted motion, not of other motion. Record at least two motions."
)
TRACKING = (
    "Root mean square of predicted minus measured positions [mrad]. 'command' is the error if the joint were "
    "at its command at once. The first half second of a recording is not compared."
)
COMMAND_IS_BETTER = (
    "Of {}, the command predicts the motion better than the simulation does. Either the model does not fit, "
    "or the recorded command is the controller's own target (such as RTDE's target_q) instead of what was "
    "sent. If that motion was held out, the dynamics file is marked, and commands that read it warn."
)


def check_table(name: str, checks: Sequence[DataCheck]) -> tuple[str, list[Cells]]:
    """Return title and rows of the checks of a recording; joints with equal verdicts share a row."""
    title = f"{name}: {sum(check.is_good is False for check in checks)} of {len(checks)} checks failed"
    groups: dict[tuple[str, str, str | None], list[DataCheck]] = {}
    for check in checks:
        alone = check.joint if check.is_good is False else None
        groups.setdefault((check.name, check.verdict, alone), []).append(check)
    rows = []
    for (what, verdict, _), group in groups.items():
        joint = group[0].joint or "" if len(group) == 1 else f"{len(group)} joints"
        detail = group[0].detail if len({check.detail for check in group}) == 1 else ""
        rows.append({"check": what, "joint": joint, "verdict": verdict, "found": detail})
    return title, rows


def error_rows(result: Identification) -> list[Cells]:
    """Return the tracking error of every joint [mrad], on motion that was held out and on fitted motion."""
    columns = {}
    for group, motions in _groups(result).items():
        for name, errors in identify.tracking_errors(motions).items() if motions else ():
            columns[f"{group.replace('_', ' ')}: {name}"] = [*errors, np.sqrt(np.mean(errors**2))]
    joints = [*map(short, result.fit.dynamics.joints), "all joints"]
    return [
        {"joint": joint, **{name: f"{1e3 * values[j]:.2f}" for name, values in columns.items()}}
        for j, joint in enumerate(joints)
    ]


def parameter_rows(result: Identification) -> list[Cells]:
    """Return parameters and their ratios with 95 % intervals; below, the parameters before the fit."""
    known, rows = estimates(result.fit), []
    found, before = result.fit.dynamics, result.start.before
    for j, joint in enumerate(found.joints):
        now, old = {"joint": short(joint)}, {"joint": "  before"}
        for name in PARAMETERS:
            if name.startswith("filter") and not found.has_filter.any():
                continue
            column = f"{name} [{identify.REMEDIES[name][0]}]"
            fixed = f"{_number(name, getattr(found, name)[j])} (not fitted)"
            now[column] = _estimate(known[name], j) if name in known else fixed
            old[column] = _number(name, getattr(before, name)[j])
        now |= {f"{n} [{unit}]": _estimate(known[n], j) for n, unit in identify.RATIOS.items() if n in known}
        rows += [now, old]
    return rows


def _groups(result: Identification) -> dict[str, tuple[CheckedRecording, ...]]:
    return {"held_out": result.of(is_held_out=True), "fitted": result.of(is_held_out=False)}


def _number(name: str, value: float) -> str:
    if not np.isfinite(value):
        return "no filter"
    value *= 1e3 if name == "latency" else 1.0
    return f"{value:.4g}" if abs(value) < 1e4 else f"{value:.0f}"


def _estimate(known: Estimate, j: int) -> str:
    name, value, width = known.name, known.value[j], known.half_width[j]
    if width > UNKNOWN_WIDTH:
        return f"not identifiable ({_number(name, value)})"
    if name == "latency":
        return f"{1e3 * value:.2f} ± {1e3 * LATENCY_UNIT * width:.2f}"
    return f"{_number(name, value)} ± {100 * width:.1f} %"


def warnings(result: Identification) -> list[str]:
    """Return warnings: drifting clocks, play, zeros, commands that predict motion, nothing held out."""
    texts, fit, joints = [], result.fit, result.fit.dynamics.joints
    if not result.of(is_held_out=True):
        texts.append(NOTHING_HELD_OUT)
    if worse := identify.worse_than_command(result.motions):
        texts.append(COMMAND_IS_BETTER.format(", ".join(map(short, worse))))
    drifts, deviations = fit.encoders.drift, fit.encoder_deviations.drift
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
    play, known = fit.encoders.play, CONFIDENCE * fit.encoder_deviations.play
    loose = [
        f"{short(joint)} {1e3 * play[j]:.1f} ± {1e3 * known[j]:.1f}"
        for j, joint in enumerate(joints)
        if play[j] > max(known[j], NOTABLE_PLAY)
    ]
    if loose:
        fix = "tighten it, or train with an error of the encoders as large (sensing.joint_bias)"
        play_text = f"Play between servo and encoder [mrad]: {', '.join(loose)}. The fit compensates it; "
        texts.append(f"{play_text}training has none: {fix}.")
    zeros = zip(map(short, joints), fit.encoders.zero.mean(axis=0), strict=True)
    if off := [f"{name} {1e3 * zero:+.1f}" for name, zero in zeros if abs(zero) > NOTABLE_ZERO]:
        texts.append(
            f"Measurements are beside the simulation throughout [mrad]: {', '.join(off)}. The fit "
            "compensates this. Causes: the encoder's zero, friction that differs by direction, or weight."
        )
    return texts


def write_report(folder: Path, result: Identification, circumstances: Mapping[str, Any]) -> None:
    """Write all files to a folder, the dynamics file last."""
    sections = report_sections(result, circumstances)
    report = as_markdown(f"System identification: {result.start.robot}", sections)
    files: dict[str, str | bytes] = {REPORT: report, NUMBERS: json_text(numbers(result, circumstances))}
    files |= {name: picture for each in sections for name, picture in each.pictures.items()}
    write_atomically({folder / name: content for name, content in files.items()})
    result.file.save(folder / DYNAMICS)


def report_sections(result: Identification, circumstances: Mapping[str, Any]) -> list[Section]:
    """Return the parts of the report."""
    roles = {True: "held out", False: "fitted"}
    rate = f"physics at {1 / result.physics_dt:.0f} Hz"
    run = [f"`{circumstances['command']}`", f"free: {', '.join(result.fit.free)}; {rate}"]
    run += [f"{each.recording.name} ({roles[each.is_held_out]})" for each in result.motions]
    shown = (result.of(is_held_out=True) or result.motions)[-1]
    pictures = {f"{joint}.png": joint_picture(shown, j) for j, joint in enumerate(shown.recording.joints)}
    questions = identify.open_questions(result.fit) or ["Every direction is identified."]
    tables = (check_table(each.recording.name, each.checks) for each in result.motions)
    lists = run, warnings(result) or ["none"], questions
    what_was_run, warned, open_ones = ("\n".join(f"- {text}" for text in texts) for texts in lists)
    return [
        Section(title="What was run", text=what_was_run),
        Section(title="Warnings", text=warned),
        Section(title="Tracking error", text=TRACKING, rows=error_rows(result)),
        Section(title="Parameters with 95 % intervals", rows=parameter_rows(result)),
        Section(title="What is not identified", text=open_ones),
        Section(title=f"Motion: {shown.recording.name} ({roles[shown.is_held_out]})", pictures=pictures),
        *(Section(title=title, rows=rows) for title, rows in tables),
    ]


def numbers(result: Identification, circumstances: Mapping[str, Any]) -> dict[str, Any]:
    """Return the results as numbers in SI units, by joint."""
    fit, joints, known = result.fit, result.fit.dynamics.joints, estimates(result.fit)
    errors = {group: identify.tracking_errors(own) if own else {} for group, own in _groups(result).items()}
    parameters: dict[str, dict[str, Any]] = {joint: {} for joint in joints}
    for name in PARAMETERS:
        columns = {"value": getattr(fit.dynamics, name), "before": getattr(result.start.before, name)}
        columns |= {"interval": known[name].interval} if name in known else {}
        for j, joint in enumerate(joints):
            row = {key: values[j] for key, values in columns.items()}
            row = {key: each.tolist() if np.all(np.isfinite(each)) else None for key, each in row.items()}
            parameters[joint][name] = row
    return {
        "robot": result.start.robot,
        "free": list(fit.free),
        "tracking_error": {
            group: {name: dict(zip(joints, values.tolist(), strict=True)) for name, values in found.items()}
            for group, found in errors.items()
        },
        "parameters": parameters,
        "not_identified": identify.open_questions(fit),
        "warnings": warnings(result),
        "worse_than_command": list(result.file.worse_than_command),
        "recordings": [
            {"name": each.recording.name, "is_held_out": each.is_held_out} for each in result.motions
        ],
        "circumstances": dict(circumstances),
    }


def joint_picture(motion: CheckedRecording, column: int) -> bytes:
    """Return a PNG of a joint's positions as commanded, measured and simulated, and its errors."""
    recording, start = motion.recording, motion.recording.t_meas[0]
    paths = {name: getattr(motion, name)[:, column] for name in ("before", "measured", "after")}
    time = motion.time - start
    with matplotlib.rc_context(LINES):
        figure = Figure(figsize=(10.0, 2.6), dpi=120)  # its own layout engine would draw it three times
        whole, errors = figure.subplots(2, 1, sharex=True, height_ratios=(3, 1))
        figure.subplots_adjust(left=0.07, right=0.985, bottom=0.16, top=0.9, hspace=0.12)
        sent, command = recording.t_cmd - start, recording.q_cmd[:, column]
        whole.step(sent, command, where="post", color=COLORS["command"], label="command", linewidth=0.8)
        for name, path in paths.items():
            dashes = (0, (4, 2)) if name == "after" else "-"
            whole.plot(time, path, color=COLORS[name], label=name, linestyle=dashes)
            if name != "measured":
                errors.plot(time, 1e3 * (path - paths["measured"]), color=COLORS[name], linewidth=0.8)
        whole.set(title=short(recording.joints[column]), ylabel="position [rad]", xlim=(time[0], time[-1]))
        whole.legend(ncols=4)
        errors.set(ylabel="error [mrad]", xlabel="time [s]")
        figure.align_ylabels([whole, errors])
        buffer = BytesIO()
        FigureCanvasAgg(figure).print_png(buffer)
        return buffer.getvalue()
