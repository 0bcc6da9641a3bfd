"""Rehearse recordings of a robot whose joints are known, identify them, and print how far off the result is.

python benchmarks/identify_known_truth.py OUT

It runs what a user runs: `excite --rehearse`, then `identify` on two of the three recordings. Every parameter
of the truth is up to 40 % off; encoders have 0.2 mrad of noise, commands are 12 ms late, 5 % of the turns of
the loops that send and read take 40 ms. OUT gets the commands' files.
"""

import json
from pathlib import Path
from typing import Any, Literal

import tyro
from tyro.conf import Positional

from pixel2catch.cli.main import main as pixel2catch
from pixel2catch.mdp.dynamics_file import DynamicsFile
from pixel2catch.robots.joint_dynamics import JointDynamics

NOISE = 2e-4
GOALS = {"damping / stiffness [%]": 2.0, "armature [%]": 5.0, "latency [ms]": 1.0, "held out / noise": 1.1}
PERCENT = ("stiffness", "damping", "frictionloss", "armature")


def main(
    out: Positional[Path],
    robot: Literal["ur5e", "allegro", "ur5e_allegro"] = "ur5e_allegro",
    seconds: float = 40.0,
    seed: int = 0,
) -> None:
    rehearsal = out / "rehearsal"
    options = ["--seconds", f"{seconds}", "--seed", f"{seed}", "--speed", "1", "--recordings", "3"]
    run("excite", "--robot", robot, *options, "--rehearse", str(rehearsal))
    recordings = [str(rehearsal / f"recording-{i}.npz") for i in (1, 2, 3)]
    run("identify", *recordings, "--robot", robot, "--out", str(out / "identified"))
    truth = DynamicsFile.load(rehearsal / "truth.json").dynamics
    result = json.loads((out / "identified" / "result.json").read_text())
    errors = errors_of(result, truth)
    for name, goal in GOALS.items():
        worst = max(errors[name], key=lambda joint: errors[name][joint])
        print(f"worst {name}: {errors[name][worst]:.3f} ({worst}), goal {goal:g}")


def run(*command: str) -> None:
    """What a user types."""
    print("pixel2catch", *command, flush=True)
    if pixel2catch(list(command)) != 0:
        raise SystemExit(1)


def errors_of(result: dict[str, Any], truth: JointDynamics) -> dict[str, dict[str, float]]:
    """Absolute errors by quantity and joint, in percent and milliseconds."""
    errors: dict[str, dict[str, float]] = {}
    for j, joint in enumerate(truth.joints):
        found = {name: entry["value"] for name, entry in result["parameters"][joint].items()}
        relative = {name: found[name] / getattr(truth, name)[j] for name in PERCENT}
        lag = relative["damping"] / relative["stiffness"]
        row = {f"{name} [%]": 100 * abs(ratio - 1.0) for name, ratio in relative.items()}
        row["damping / stiffness [%]"] = 100 * abs(lag - 1.0)
        row["latency [ms]"] = 1e3 * abs(found["latency"] - truth.latency[j])
        row["held out / noise"] = result["tracking_error"]["held_out"]["after"][joint] / NOISE
        for name, value in row.items():
            errors.setdefault(name, {})[joint] = float(value)
    return errors


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
