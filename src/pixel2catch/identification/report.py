"""What an identification leaves: the dynamics file, the report for people, and its numbers for programs."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from pixel2catch.files import require_free_folder, write_atomically
from pixel2catch.identification.identify import Identification, Motion, tracking_errors
from pixel2catch.identification.report_figures import joint_picture
from pixel2catch.identification.report_numbers import Content, numbers
from pixel2catch.identification.report_page import (
    box,
    code,
    color_key,
    heading,
    listing,
    page,
    paragraph,
    pictures,
    table,
)
from pixel2catch.identification.report_tables import (
    errors_grid,
    joint_checks_grid,
    open_questions,
    parameters_grid,
    ranges_grid,
    ratios_grid,
    short,
    whole_checks_grid,
    worst,
)

DYNAMICS, PAGE, NUMBERS = "dynamics.json", "report.html", "result.json"
"""Names of the files."""

NOTHING_HELD_OUT = (
    "Nothing was held out: the errors are those of motion that was fitted, and do not tell how well other "
    "motion is simulated. Record at least two motions."
)
"""What a reader must know who trusts the errors."""

COMMAND_IS_BETTER = (
    "Of some joints, the command predicts the motion better than the simulation does. Either the model does "
    "not fit, or what was recorded as command is the controller's own target (such as RTDE's target_q), "
    "which is not what was sent."
)
"""What the error of the command says."""


def write_report(folder: Path, result: Identification, circumstances: Mapping[str, Any]) -> Content:
    """Write everything; the dynamics file is the last, so that where it is, the others are.

    Args:
        folder: A new or empty folder.
        result: What was found.
        circumstances: When, how and with which versions this was done.

    Returns:
        The numbers for programs.

    Raises:
        InvalidValueError: If the folder is not free.
        OSError: If it cannot be written.
    """
    content = numbers(result, circumstances)
    files = {
        PAGE: report_page(result, circumstances).encode(),
        NUMBERS: (json.dumps(content, indent=2, allow_nan=False) + "\n").encode(),
    }
    require_free_folder(folder)
    folder.mkdir(parents=True, exist_ok=True)
    write_atomically({folder / name: data for name, data in files.items()})
    result.file.save(folder / DYNAMICS)
    return content


def report_page(result: Identification, circumstances: Mapping[str, Any]) -> str:
    """The report as a page.

    Args:
        result: What was found.
        circumstances: When, how and with which versions this was done.
    """
    title = f"System identification: {result.start.robot}"
    sections = (_summary, _tracking, _parameter_part, _pictures, _checks)
    parts = [part for section in sections for part in section(result)]
    return page(title, [heading(title, 1), *parts, *_circumstances(result, circumstances)])


def _summary(result: Identification) -> list[str]:
    """What a reader must know first."""
    joints, held_out = result.fit.dynamics.joints, result.of(is_held_out=True)
    errors = tracking_errors(held_out or result.motions)
    before, after = (1e3 * float(np.median(errors[name])) for name in ("before", "after"))
    kind = "motion that was held out" if held_out else "the fitted motion"
    texts = {
        f"On {kind}, the median joint's tracking error was {before:.2f} mrad before the fit and is "
        f"{after:.2f} mrad after it; the worst is {worst(errors['after'], joints)}.": "good"
        if held_out
        else "unknown"
    }
    if not held_out:
        texts = {NOTHING_HELD_OUT: "BAD"} | texts
    if (errors["after"] > errors["command"]).any():
        texts[COMMAND_IS_BETTER] = "weak"
    if open_questions(result.fit):
        texts["Not everything is identified; below is what to fix, or how to move for it."] = "weak"
    failed = {c.joint for m in result.motions for c in m.source.checks if c.is_good is False}
    if names := ", ".join(short(joint) for joint in joints if joint in failed):
        texts[f"The motion of {names} is weaker than the data checks ask for."] = "weak"
    return [box(verdict, text) for text, verdict in texts.items()]


def _tracking(result: Identification) -> list[str]:
    """The errors."""
    grid = errors_grid(result)
    text = (
        "Predicted minus measured positions. 'command' predicts that the joint is where it is told to be at "
        "once. The first half second of a recording is not compared."
    )
    return [heading(grid.title), paragraph(text), table(grid)]


def _pictures(result: Identification) -> list[str]:
    """The motion that was held out, or the last if none was, joint by joint."""
    shown = (result.of(is_held_out=True) or result.motions)[-1]
    kind = "held out" if shown.source.is_held_out else "fitted"
    images = {_caption(shown, j): joint_picture(shown, j) for j in range(len(shown.recording.joints))}
    return [heading(f"Motion: {shown.recording.name} ({kind})"), color_key(), pictures(images)]


def _caption(motion: Motion, j: int) -> str:
    errors = tracking_errors([motion])
    before, after = (1e3 * errors[name][j] for name in ("before", "after"))
    return f"{short(motion.recording.joints[j])}: {before:.2f} mrad before, {after:.2f} mrad after"


def _parameter_part(result: Identification) -> list[str]:
    """Parameters, ratios, what is not known, and what a training makes of it."""
    parameters, ratio, ranges = parameters_grid(result), ratios_grid(result.fit), ranges_grid(result)
    questions = open_questions(result.fit)
    return [
        heading(parameters.title),
        table(parameters),
        *([heading(ratio.title), table(ratio)] if ratio.rows else []),
        heading("What is not identified"),
        listing(questions) or paragraph("Every direction is identified."),
        heading(ranges.title),
        paragraph(
            "Intervals where they are narrower than the paper's ranges, else the paper's. The dynamics file "
            "has them; 'pixel2catch train --dynamics' draws from them."
        ),
        table(ranges),
    ]


def _checks(result: Identification) -> list[str]:
    """The checks of all recordings."""
    whole = whole_checks_grid(result.motions)
    grids = [joint_checks_grid(motion) for motion in result.motions]
    parts = [part for grid in grids for part in (heading(grid.title, 3), table(grid))]
    return [heading("Data checks"), table(whole), *parts]


def _circumstances(result: Identification, circumstances: Mapping[str, Any]) -> list[str]:
    """How this was done."""
    versions = ", ".join(f"{name} {version or '?'}" for name, version in circumstances["versions"].items())
    where = f"{circumstances['platform']}, {circumstances['cpu_cores']} CPU cores"
    roles = [
        f"{motion.recording.name}: {'held out' if motion.source.is_held_out else 'fitted'}"
        for motion in result.motions
    ]
    return [
        heading("What was run"),
        code(circumstances["command"]),
        listing(
            [
                f"{circumstances['started']}; revision {circumstances['git_revision'] or 'unknown'}; {where}",
                f"Python {circumstances['python']}, {versions}",
                f"free: {', '.join(result.fit.free)}; physics at {1 / result.physics_dt:.0f} Hz",
                *roles,
            ]
        ),
    ]
