"""Pictures of a report: command, measurement and simulation of a joint."""

import io
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from pixel2catch.identification.identify import Motion

COLORS = {"command": "#9A9A9A", "measured": "#000000", "before": "#E69F00", "after": "#0072B2"}
"""Colours that people with any kind of colour vision tell apart. Source: Okabe and Ito 2008; grey: ours."""

ZOOM = 1.5
"""Length of the close look [s]: about the fastest motion."""

DPI = 120
"""Pixels of an inch."""

MARGINS = {"left": 0.07, "right": 0.985, "bottom": 0.16, "top": 0.98, "wspace": 0.14, "hspace": 0.12}
"""Room for the labels, as shares of the picture."""

STYLE: dict[Any, Any] = {
    "font.size": 8,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": "#5B5B5B",
    "axes.grid": True,
    "grid.color": "#E9E9E9",
    "axes.axisbelow": True,
    "lines.linewidth": 1.0,
}


def joint_picture(motion: Motion, column: int) -> bytes:
    """Position of a joint as commanded, measured and simulated, its errors, and a close look, as a PNG file.

    Args:
        motion: The recording and its simulation.
        column: Number of the joint.
    """
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(10.0, 2.6), dpi=DPI)  # its own layout engine would draw it three times
        grid = figure.add_gridspec(2, 2, height_ratios=(3, 1), width_ratios=(5, 3), **MARGINS)
        whole, close = figure.add_subplot(grid[0, 0]), figure.add_subplot(grid[:, 1])
        errors = figure.add_subplot(grid[1, 0], sharex=whole)
        _draw_positions(whole, motion, column)
        _draw_positions(close, motion, column)
        _draw_errors(errors, motion, column)
        _zoom_in(close, motion, column)
        whole.tick_params(labelbottom=False)
        whole.set_ylabel("position [rad]")
        errors.set(ylabel="error [mrad]", xlabel="time [s]")
        figure.align_ylabels([whole, errors])
        close.set_xlabel("time [s]")
        buffer = io.BytesIO()
        FigureCanvasAgg(figure).print_png(buffer)
    return buffer.getvalue()


def _draw_positions(axes: Axes, motion: Motion, column: int) -> None:
    start = motion.recording.t_meas[0]
    command = motion.recording.q_cmd[:, column]
    axes.step(motion.recording.t_cmd - start, command, where="post", color=COLORS["command"], linewidth=0.8)
    time = motion.time - start
    axes.plot(time, motion.before[:, column], color=COLORS["before"])
    axes.plot(time, motion.measured[:, column], color=COLORS["measured"], linewidth=1.6)
    axes.plot(time, motion.after[:, column], color=COLORS["after"], linestyle=(0, (4, 2)))
    axes.set_xlim(time[0], time[-1])


def _draw_errors(axes: Axes, motion: Motion, column: int) -> None:
    time = motion.time - motion.recording.t_meas[0]
    for name in ("before", "after"):
        error = getattr(motion, name)[:, column] - motion.measured[:, column]
        axes.plot(time, 1e3 * error, color=COLORS[name], linewidth=0.8)


def _zoom_in(axes: Axes, motion: Motion, column: int) -> None:
    """Show the time about the largest change within a fifth of what is shown."""
    time, position = motion.time - motion.recording.t_meas[0], motion.measured[:, column]
    length = min(ZOOM, time[-1] - time[0])
    later = np.interp(time + length / 5, time, position)
    middle = time[np.argmax(np.abs(later - position))] + length / 10
    left = np.clip(middle - length / 2, time[0], time[-1] - length)
    is_shown = (time >= left) & (time <= left + length)
    shown = [
        path[is_shown, column] for path in (motion.measured, motion.before, motion.after, motion.command)
    ]
    low, high = min(map(np.min, shown)), max(map(np.max, shown))
    margin = 0.05 * max(high - low, 1e-3)
    axes.set(xlim=(left, left + length), ylim=(low - margin, high + margin))
