"""Studies whose results are made up, in the files that commands write."""

import json
from pathlib import Path
from typing import Any

from pixel2catch.evaluation.comparison.plan import GROUPS, ComparisonFolder, Plan, Run
from pixel2catch.evaluation.metrics import wilson_interval

OBJECTS = {"seen": ("cube_s", "cone_l"), "unseen": ("cross",)}
SESSION = {
    "started": "2026-01-01T00:00:00+00:00",
    "command": "pixel2catch reproduce --seeds 2",
    "git_revision": "abc",
    "python": "3.11",
    "versions": {"mujoco": "4.0.0"},
    "platform": "Linux",
    "cpu_cores": 2,
    "gpus": [],
}
RATES = ("tracking_rate", "success_rate", "palm_contact_rate", "verified_hold_rate")


def plan(**changes: Any) -> Plan:
    return Plan(
        **{"methods": ("only_wh", "proposed"), "seeds": 2, "configuration": {"training lr": 0.1}} | changes
    )


def rates(successes: int, trials: int) -> dict[str, Any]:
    """All four rates alike."""
    result: dict[str, Any] = {"trials": trials}
    for name in RATES:
        interval = list(wilson_interval(successes, trials))
        result |= {name: successes / trials, f"{name}_interval": interval}
    return result


def write_evaluation(
    folder: ComparisonFolder, run: Run, group: str, successes: int, trials: int = 100
) -> None:
    """All successes are of the group's first object, which is thrown in half of the trials."""
    half = trials // 2
    thrown = dict.fromkeys(OBJECTS[group], rates(0, half)) | {OBJECTS[group][0]: rates(successes, half)}
    result = rates(successes, trials) | {
        "max_joint_speed": 2.0 + run.seed,
        "max_torque_share": 0.5,
        "max_penetration": 0.004,
        "objects": thrown,
    }
    path = folder.evaluation(run, group)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(result))


def write_training(folder: ComparisonFolder, run: Run, seconds: float = 60.0) -> None:
    folder.run(run).mkdir(parents=True)
    summary = {"status": "finished", "transitions": 300, "seconds": seconds}
    (folder.run(run) / "summary.json").write_text(json.dumps(summary))
    rows = ("100,0,nan,nan", "200,10,0.5,0.2", f"300,30,0.{5 + run.seed},0.{2 + run.seed}")
    text = "\n".join(("transitions,episodes,tracking_rate,success_rate", *rows)) + "\n"
    folder.metrics(run).write_text(text)


def write_study(path: Path) -> ComparisonFolder:
    """Two methods with two seeds: 20 and 40 of 100 throws are caught, the same for all."""
    folder = ComparisonFolder(path)
    folder.open(plan(), [SESSION])
    for run in plan().runs():
        write_training(folder, run, seconds=60.0 * (1 + run.seed))
        for group in GROUPS:
            write_evaluation(folder, run, group, successes=20 * (1 + run.seed))
    return folder
