"""Pictures of recorded and simulated motion, as PNG files.

People with any kind of colour vision tell their colours apart. Source: Okabe and Ito 2008; grey: ours.
"""

import io
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from pixel2catch.identification.identify import Motion
from pixel2catch.identification.joints import short, specs_of
from pixel2catch.identification.recording import Trajectory
from pixel2catch.identification.rehearsal import Assessment

COLORS = {"command": "#9A9A9A", "measured": "#000000", "before": "#E69F00", "after": "#0072B2"}  # of a report

COMMAND_COLOR, MOTION_COLOR, LIMIT_COLOR, SPAN_COLOR = "#0072B2", "#D55E00", "#8A8A8A", "#F0F0F0"
"""Of a trajectory."""

ZOOM = 1.5  # length of the close look [s]: about the fastest motion
ROW_HEIGHT = 1.15  # height of a joint's row in the picture of a trajectory [inches]

MARGINS = {"left": 0.07, "right": 0.985, "bottom": 0.16, "top": 0.98, "wspace": 0.14, "hspace": 0.12}
"""Room for the labels, as shares of the picture."""

PLAIN: dict[Any, Any] = {"font.size": 9, "axes.spines.top": False, "axes.spines.right": False}
STYLE: dict[Any, Any] = {
    **PLAIN,
    "font.size": 8,
    "axes.edgecolor": "#5B5B5B",
    "axes.grid": True,
    "grid.color": "#E9E9E9",
    "axes.axisbelow": True,
    "lines.linewidth": 1.0,
}


def joint_picture(motion: Motion, column: int) -> bytes:
    """Position of a column's joint as commanded, measured and simulated, its errors, and a close look."""
    with matplotlib.rc_context(STYLE):
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
        figure = Figure(figsize=(12.0, 0.8 + ROW_HEIGHT * num_joints), layout="constrained")
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
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110)
    return buffer.getvalue()


def _draw_trajectory(axes: Axes, trajectory: Trajectory, assessment: Assessment, column: int) -> None:
    """Command, motion, limits and segments of one joint."""
    spec = specs_of(trajectory.workcell)[trajectory.joints[column]]
    command, recording = trajectory.positions[:, column], assessment.recording
    axes.step(trajectory.times, command, where="post", color=COMMAND_COLOR, lw=0.7, label="command")
    axes.plot(recording.t_meas, recording.q[:, column], color=MOTION_COLOR, lw=0.9, label="simulated motion")
    low, high = command.min() - 0.1, command.max() + 0.1
    for limit, label in ((spec.lower, "limit of the joint"), (spec.upper, "")):
        axes.axhline(limit, color=LIMIT_COLOR, lw=0.8, ls="--", label=label)
    for span in trajectory.header.get("segments", {}).values():
        axes.axvspan(*span, color=SPAN_COLOR)
    axes.set_ylim(low, high)
