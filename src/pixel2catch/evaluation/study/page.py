"""The page of a report: what was run, its tables and its pictures."""

from collections.abc import Collection, Mapping, Sequence
from typing import Any

from pixel2catch.evaluation.study.plan import Plan

PICTURES = {
    "curves.png": (
        "Learning curves",
        "Rates in training against transitions: the policy is stochastic and all noise is on, so that they "
        "lie below those of the tables. Line: mean over the seeds; shaded: one standard deviation. Each "
        "point is the rate of all episodes that ended in a bin of transitions.",
    ),
    "objects.png": (
        "Success by object",
        "S.R. of the deterministic policies over the throws of all seeds, with 95 % Wilson intervals.",
    ),
    "throws.png": (
        "Throws",
        "Sampled throws from release to aim. Boxes: where they are released, and where they come down "
        "through the catch height; grey: the arm in its start pose; dashed: edges of the camera's view, of "
        "its middle column from the side, of its middle row from above.",
    ),
}
"""Title and caption of every picture."""

RATES_NOTE = (
    "T.R.: the palm within 8 cm of the object once; S.R.: for 20 control steps in a row. Mean ± sample "
    "standard deviation over the seeds (no deviation of one seed); the 95 % Wilson intervals are over the "
    "trials of all seeds, and do not know that seeds differ. Paper: mean ± deviation over 3 seeds. The "
    "paper's unseen objects are not published; ours are stand-ins."
)
QUALITY_NOTE = (
    "Verified hold: after the success the policy stops, two parts of the hand touch the object for 1 s, and "
    "the hold survives half a second of shaking. Speed, torque and penetration are the largest of all throws."
)
TRAININGS_NOTE = "Trainings that run side by side on one device slow each other down."


def page(
    plan: Plan, sessions: Sequence[Mapping[str, Any]], tables: Mapping[str, str], files: Collection[str]
) -> str:
    """Compose the page.

    Args:
        plan: What the study asks.
        sessions: When, how and where it was worked at.
        tables: Tables in Markdown: rates, quality, trainings, by_object.
        files: Names of the files beside the page.
    """
    pictures = [
        f"## {title}\n\n![{title}]({name})\n\n{caption}\n"
        for name, (title, caption) in PICTURES.items()
        if name in files
    ]
    parts = [
        "# Study\n",
        f"Methods: {', '.join(plan.methods)}. Seeds of each: {plan.seeds}. "
        "This page is written by `pixel2catch reproduce`.\n",
        f"## Results\n\n{tables['rates']}\n{RATES_NOTE}\n",
        f"{tables['quality']}\n{QUALITY_NOTE}\n",
        *pictures,
        f"## S.R. by object\n\n{tables['by_object']}",
        f"## Trainings\n\n{tables['trainings']}\n{TRAININGS_NOTE}\n",
        f"## What was run\n\n{_sessions(sessions)}",
        f"## Configuration\n\n{_configuration(plan)}",
    ]
    return "\n".join(parts)


def _sessions(sessions: Sequence[Mapping[str, Any]]) -> str:
    """Command, machine and versions of every session, one paragraph each."""
    texts = []
    for session in sessions:
        gpus = ", ".join(session["gpus"]) or "no GPU"
        versions = ", ".join(
            f"{name} {version or '(version unknown)'}" for name, version in session["versions"].items()
        )
        texts.append(
            f"- {session['started']}: `{session['command']}`\n"
            f"  - revision {session['git_revision'] or 'unknown'}; {session['cpu_cores']} CPU cores, {gpus}; "
            f"{session['platform']}\n"
            f"  - Python {session['python']}, {versions}\n"
        )
    return "".join(texts)


def _configuration(plan: Plan) -> str:
    """Everything that changes results."""
    lines = [f"| {name} | {value} |" for name, value in plan.configuration.items()]
    return "\n".join(["| name | value |", "| --- | --- |", *lines]) + "\n"
