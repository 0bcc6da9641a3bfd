"""What a trajectory makes the simulated robot do, for people: a table and a picture."""

import io
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from rich.table import Table
from rich.text import Text

from pixel2catch.identification.check_report import STYLES, verdict
from pixel2catch.identification.checks import num_reversals
from pixel2catch.identification.excitation_check import Assessment
from pixel2catch.identification.recording import JOINT_SPECS
from pixel2catch.identification.signals import smoothed
from pixel2catch.identification.trajectory import Trajectory

COMMAND_COLOR, MOTION_COLOR, LIMIT_COLOR, SPAN_COLOR = "#0072B2", "#D55E00", "#8A8A8A", "#F0F0F0"
"""Colours that people with any kind of colour vision tell apart. Source: Okabe and Ito 2008; grey: ours."""

PIXELS_PER_INCH = 110

ROW_HEIGHT = 1.15
"""Height of a joint's row in the picture [inches]."""


def motion_table(title: str, assessment: Assessment) -> Table:
    """One line a joint: range, top speed and acceleration, reversals, and torque as a share of its limit.

    Args:
        title: What the table is called.
        assessment: What the simulated robot did.
    """
    columns = (
        "joint",
        "verdict",
        "from [rad]",
        "to [rad]",
        "[rad/s]",
        "[rad/s²]",
        "reversals",
        "torque [%]",
    )
    table = Table(title=title)
    for i, column in enumerate(columns):
        table.add_column(Text(column), justify="left" if i < 2 else "right", no_wrap=i == 0)
    q, motion = assessment.recording.q, smoothed(assessment.recording.t_meas, assessment.recording.q)
    for j, check in enumerate(assessment.checks):
        word = verdict(check)
        table.add_row(
            check.joint,
            Text(word, style=STYLES[word]),
            f"{q[:, j].min():.2f}",
            f"{q[:, j].max():.2f}",
            f"{assessment.speed[j]:.2f}",
            f"{np.abs(motion.acceleration[:, j]).max():.1f}",
            str(num_reversals(motion.speed[:, j])),
            f"{100 * assessment.torque_share[j]:.0f}",
        )
    return table


def motion_picture(trajectory: Trajectory, assessment: Assessment) -> bytes:
    """The figure as a PNG file."""
    buffer = io.BytesIO()
    motion_figure(trajectory, assessment).savefig(buffer, format="png", dpi=PIXELS_PER_INCH)
    return buffer.getvalue()


def motion_figure(trajectory: Trajectory, assessment: Assessment) -> Figure:
    """Commands and simulated motion of every joint over time, with the joints' limits where they are near."""
    style: dict[Any, Any] = {"font.size": 9, "axes.spines.top": False, "axes.spines.right": False}
    with matplotlib.rc_context(style):
        num_joints = len(trajectory.joints)
        figure = Figure(figsize=(12.0, 0.8 + ROW_HEIGHT * num_joints), layout="constrained")
        panels = np.atleast_1d(figure.subplots(num_joints, 1, sharex=True))
        for column, (axes, joint) in enumerate(zip(panels, trajectory.joints, strict=True)):
            _draw(axes, trajectory, assessment, column)
            axes.set_ylabel(joint.removesuffix("_joint").replace("_joint_", " ") + "\n[rad]")
        for name, (start, _) in trajectory.header.get("segments", {}).items():
            panels[0].text(start, 1.02, name.replace("_", " "), transform=panels[0].get_xaxis_transform())
        panels[-1].set_xlabel("time [s]")
        panels[-1].set_xlim(0.0, trajectory.duration)
        figure.legend(
            *panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=3, frameon=False
        )
        return figure


def _draw(axes: Axes, trajectory: Trajectory, assessment: Assessment, column: int) -> None:
    """Command, motion, limits and segments of one joint."""
    spec = JOINT_SPECS[trajectory.joints[column]]
    command, recording = trajectory.positions[:, column], assessment.recording
    axes.step(trajectory.times, command, where="post", color=COMMAND_COLOR, lw=0.7, label="command")
    axes.plot(recording.t_meas, recording.q[:, column], color=MOTION_COLOR, lw=0.9, label="simulated motion")
    low, high = command.min() - 0.1, command.max() + 0.1
    for i, limit in enumerate((spec.lower, spec.upper)):
        label = "" if i else "limit of the joint"
        axes.axhline(limit, color=LIMIT_COLOR, lw=0.8, ls="--", label=label)
    for span in trajectory.header.get("segments", {}).values():
        axes.axvspan(*span, color=SPAN_COLOR)
    axes.set_ylim(low, high)
