"""What an identification leaves: the dynamics file, the report for people, and its numbers for programs.

The report is one HTML file that needs nothing but itself. People with any kind of colour vision tell the
colours of its pictures apart. Source: Okabe and Ito 2008; grey: ours.
"""

import io
from collections.abc import Iterable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from pixel2catch.files import json_text, require_free_folder, write_atomically
from pixel2catch.identification.identify import RATIOS, Identification, Motion, estimates, tracking_errors
from pixel2catch.identification.intervals import CONFIDENCE
from pixel2catch.identification.joints import short, specs_of
from pixel2catch.identification.recording import Trajectory
from pixel2catch.identification.rehearsal import Assessment
from pixel2catch.identification.report_tables import (
    Grid,
    drift_warnings,
    errors_grid,
    joint_checks_grid,
    open_questions,
    parameters_grid,
    play_warnings,
    ranges_grid,
    ratios_grid,
    whole_checks_grid,
)
from pixel2catch.offline_page import box, element, listing, page, picture, section, table, what_was_run
from pixel2catch.robots.joint_dynamics import PARAMETERS

DYNAMICS, PAGE, NUMBERS = "dynamics.json", "report.html", "result.json"  # names of the files

NOTHING_HELD_OUT = (
    "Nothing was held out: the errors are those of motion that was fitted, and do not tell how well other "
    "motion is simulated. Record at least two motions."
)
TRACKING = (
    "Predicted minus measured positions. 'command' predicts that the joint is where it is told to be at "
    "once. The first half second of a recording is not compared."
)
RANDOMISATION = (
    "Intervals where they are narrower than the paper's ranges, else the paper's. The dynamics file "
    "has them; 'pixel2catch train --dynamics' draws from them."
)

COLORS = {"command": "#9A9A9A", "measured": "#000000", "before": "#E69F00", "after": "#0072B2"}  # of a report
ZOOM = 1.5  # length of the close look [s]: about the fastest motion

MARGINS = {"left": 0.07, "right": 0.985, "bottom": 0.16, "top": 0.98, "wspace": 0.14, "hspace": 0.12}
"""Room for the labels, as shares of the picture."""

PLAIN: dict[Any, Any] = {"font.size": 9, "axes.spines.top": False, "axes.spines.right": False}
LINED: dict[Any, Any] = {
    **PLAIN,
    "font.size": 8,
    "axes.edgecolor": "#5B5B5B",
    "axes.grid": True,
    "grid.color": "#E9E9E9",
    "axes.axisbelow": True,
    "lines.linewidth": 1.0,
}

Content = dict[str, Any]


def write_report(folder: Path, result: Identification, circumstances: Mapping[str, Any]) -> Content:
    """Write everything to a new or empty folder, and return the numbers for programs.

    The dynamics file is the last, so that where it is, the others are. The circumstances say when, how and
    with which versions this was done.

    Raises:
        InvalidValueError: If the folder is not free.
        OSError: If it cannot be written.
    """
    content = numbers(result, circumstances)
    files = {
        PAGE: report_page(result, circumstances).encode(),
        NUMBERS: json_text(content).encode(),
    }
    require_free_folder(folder)
    folder.mkdir(parents=True, exist_ok=True)
    write_atomically({folder / name: data for name, data in files.items()})
    result.file.save(folder / DYNAMICS)
    return content


def report_page(result: Identification, circumstances: Mapping[str, Any]) -> str:
    """The report as a page."""
    title, ratio = f"System identification: {result.start.robot}", ratios_grid(result.fit)
    open_ends = listing(open_questions(result.fit)) or element("p", "Every direction is identified.")
    parts = [
        *_summary(result),
        _section(errors_grid(result), TRACKING),
        _section(parameters_grid(result)),
        _section(ratio) if ratio.rows else "",
        section("What is not identified", "", open_ends),
        _section(ranges_grid(result), RANDOMISATION),
        _pictures(result),
        _section(whole_checks_grid(result.motions)),
        *(_section(joint_checks_grid(motion), tag="h3") for motion in result.motions),
        what_was_run(
            circumstances,
            f"free: {', '.join(result.fit.free)}; physics at {1 / result.physics_dt:.0f} Hz",
            *(f"{each.recording.name}: {_kind(each)}" for each in result.motions),
        ),
    ]
    return page(title, parts)


def _summary(result: Identification) -> Iterable[str]:
    """What a reader must know first, in the colours of verdicts."""
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
    if open_questions(result.fit):
        texts["Not everything is identified; below is what to fix, or how to move for it."] = "weak"
    failed = {c.joint for m in result.motions for c in m.checks if c.is_good is False}
    if names := ", ".join(short(joint) for joint in joints if joint in failed):
        texts[f"The motion of {names} is weaker than the data checks ask for."] = "weak"
    return [box(text, verdict) for text, verdict in texts.items()]


def _kind(motion: Motion) -> str:
    return "held out" if motion.is_held_out else "fitted"


def _pictures(result: Identification) -> str:
    """The motion that was held out, or the last if none was, joint by joint."""
    shown = (result.of(is_held_out=True) or result.motions)[-1]
    key = "".join(f'<span style="background: {color}"></span>{name}' for name, color in COLORS.items())
    errors = tracking_errors([shown])
    figures = []
    for j, joint in enumerate(shown.recording.joints):
        before, after = (1e3 * errors[name][j] for name in ("before", "after"))
        caption = f"{short(joint)}: {before:.2f} mrad before, {after:.2f} mrad after"
        figures.append(picture(joint_picture(shown, j), "png", caption))
    title = f"Motion: {shown.recording.name} ({_kind(shown)})"
    return section(title, "", f'<p class="key">{key}</p>', *figures)


def _section(grid: Grid, text: str = "", tag: str = "h2") -> str:
    return section(grid.title, text, table(grid.columns, grid.rows), tag=tag)


def numbers(result: Identification, circumstances: Mapping[str, Any]) -> Content:
    """All numbers of the report, in SI units, by joint."""
    fit, joints = result.fit, result.fit.dynamics.joints
    errors = {
        group: tracking_errors(motions) if (motions := result.of(is_held_out)) else {}
        for group, is_held_out in (("held_out", True), ("fitted", False))
    }

    def by_joint(contents: Iterable[Any]) -> Content:
        return dict(zip(joints, contents, strict=True))

    encoders, deviations = fit.encoders, fit.encoder_deviations
    drifts = zip(result.of(is_held_out=False), encoders.drift, deviations.drift, strict=True)
    return {
        "robot": result.start.robot,
        "free": list(fit.free),
        "physics_dt": result.physics_dt,
        "tracking_error": {
            group: {name: by_joint(values.tolist()) for name, values in found.items()}
            for group, found in errors.items()
        },
        "parameters": by_joint(_parameters(result, j) for j in range(len(joints))),
        "ratios": {
            name: by_joint(map(_told, each.value, each.interval))
            for name, each in estimates(fit).items()
            if name in RATIOS
        },
        "not_identified": open_questions(fit),
        "worse_than_command": list(result.file.worse_than_command),
        "play": by_joint(map(_plus_minus, encoders.play, CONFIDENCE * deviations.play)),
        "drift": {
            motion.recording.name: by_joint(map(_plus_minus, drift, CONFIDENCE * deviation))
            for motion, drift, deviation in drifts
        },
        "recordings": [
            {
                "name": motion.recording.name,
                "is_held_out": motion.is_held_out,
                "checks": [asdict(check) for check in motion.checks],
            }
            for motion in result.motions
        ],
        "circumstances": dict(circumstances),
    }


def _parameters(result: Identification, j: int) -> Content:
    """Value before and after of every parameter of a joint, and its 95 % interval if it was fitted."""
    found, known = dict[str, Content](), estimates(result.fit)
    for name in PARAMETERS:
        value, before = (float(getattr(each, name)[j]) for each in (result.fit.dynamics, result.start.before))
        content: Content = {"value": value, "before": before}
        if name in known:
            content["interval"] = known[name].interval[j].tolist()
        found[name] = {key: each if np.all(np.isfinite(each)) else None for key, each in content.items()}
    return found


def _plus_minus(value: float, half_width: float) -> Content:
    return _told(value, value + half_width * np.array((-1.0, 1.0)))


def _told(value: float, interval: np.ndarray) -> Content:
    return {"value": float(value), "interval": interval.tolist()}


def joint_picture(motion: Motion, column: int) -> bytes:
    """Position of a column's joint as commanded, measured and simulated, its errors, and a close look."""
    with matplotlib.rc_context(LINED):
        figure = Figure(figsize=(10.0, 2.6), dpi=120)  # its own layout engine would draw it three times
        grid = figure.add_gridspec(2, 2, height_ratios=(3, 1), width_ratios=(5, 3), **MARGINS)
        whole, close = figure.add_subplot(grid[0, 0]), figure.add_subplot(grid[:, 1])
        errors = figure.add_subplot(grid[1, 0], sharex=whole)
        _draw_positions(whole, motion, column)
        _draw_positions(close, motion, column)
        for name in ("before", "after"):
            error = getattr(motion, name)[:, column] - motion.measured[:, column]
            errors.plot(_time(motion), 1e3 * error, color=COLORS[name], linewidth=0.8)
        _zoom_in(close, motion, column)
        whole.tick_params(labelbottom=False)
        whole.set_ylabel("position [rad]")
        errors.set(ylabel="error [mrad]", xlabel="time [s]")
        figure.align_ylabels([whole, errors])
        close.set_xlabel("time [s]")
        return _png(figure)


def _png(figure: Figure) -> bytes:
    buffer = io.BytesIO()
    FigureCanvasAgg(figure).print_png(buffer)
    return buffer.getvalue()


def _time(motion: Motion) -> np.ndarray:
    return motion.time - motion.recording.t_meas[0]


def _draw_positions(axes: Axes, motion: Motion, column: int) -> None:
    recording, time = motion.recording, _time(motion)
    sent, command = recording.t_cmd - recording.t_meas[0], recording.q_cmd[:, column]
    axes.step(sent, command, where="post", color=COLORS["command"], linewidth=0.8)
    axes.plot(time, motion.before[:, column], color=COLORS["before"])
    axes.plot(time, motion.measured[:, column], color=COLORS["measured"], linewidth=1.6)
    axes.plot(time, motion.after[:, column], color=COLORS["after"], linestyle=(0, (4, 2)))
    axes.set_xlim(time[0], time[-1])


def _zoom_in(axes: Axes, motion: Motion, column: int) -> None:
    """Show the time about the largest change within a fifth of what is shown."""
    time, position = _time(motion), motion.measured[:, column]
    length = min(ZOOM, time[-1] - time[0])
    later = np.interp(time + length / 5, time, position)
    middle = time[np.argmax(np.abs(later - position))] + length / 10
    left = np.clip(middle - length / 2, time[0], time[-1] - length)
    is_shown = (time >= left) & (time <= left + length)
    paths = (motion.measured, motion.before, motion.after, motion.command)
    shown = np.stack([path[is_shown, column] for path in paths])
    low, high = shown.min(), shown.max()
    margin = 0.05 * max(high - low, 1e-3)
    axes.set(xlim=(left, left + length), ylim=(low - margin, high + margin))


def motion_picture(trajectory: Trajectory, assessment: Assessment) -> bytes:
    """Commands and simulated motion of every joint over time, with the joints' limits where they are near."""
    segments = trajectory.header.get("segments", {})
    with matplotlib.rc_context(PLAIN):
        num_joints = len(trajectory.joints)
        figure = Figure(figsize=(12.0, 0.8 + 1.15 * num_joints), dpi=110, layout="constrained")
        panels = np.atleast_1d(figure.subplots(num_joints, 1, sharex=True))
        for column, (axes, joint) in enumerate(zip(panels, trajectory.joints, strict=True)):
            _draw_trajectory(axes, trajectory, assessment, column)
            axes.set_ylabel(f"{short(joint)}\n[rad]")
        for name, (start, _) in segments.items():
            panels[0].text(start, 1.02, name.replace("_", " "), transform=panels[0].get_xaxis_transform())
        panels[-1].set_xlabel("time [s]")
        panels[-1].set_xlim(0.0, trajectory.duration)
        handles = panels[0].get_legend_handles_labels()
        figure.legend(*handles, loc="outside lower center", ncols=3, frameon=False)
        return _png(figure)


def _draw_trajectory(axes: Axes, trajectory: Trajectory, assessment: Assessment, column: int) -> None:
    """Command, motion, limits and segments of one joint."""
    spec = specs_of(trajectory.workcell)[trajectory.joints[column]]
    command, recording = trajectory.positions[:, column], assessment.recording
    axes.step(trajectory.times, command, where="post", color=COLORS["after"], lw=0.7, label="command")
    axes.plot(recording.t_meas, recording.q[:, column], color="#D55E00", lw=0.9, label="simulated motion")
    low, high = command.min() - 0.1, command.max() + 0.1
    for limit, label in ((spec.lower, "limit of the joint"), (spec.upper, "")):
        axes.axhline(limit, color="#8A8A8A", lw=0.8, ls="--", label=label)
    for span in trajectory.header.get("segments", {}).values():
        axes.axvspan(*span, color="#F0F0F0")
    axes.set_ylim(low, high)
