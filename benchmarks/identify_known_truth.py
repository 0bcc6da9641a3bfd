"""Rehearse recordings of a robot whose joints are known, identify them, and print how far off the result is.

python benchmarks/identify_known_truth.py OUT [--filter]

It runs what a user runs: `excite --rehearse`, then `identify` on two of the three recordings. Every parameter
of the truth is up to 40 % off; encoders have 0.2 mrad of noise, commands are 12 ms late, 5 % of the turns of
the loops that send and read take 40 ms. With --filter, the truth is a UR5e with a stiff servo behind the
filter of servoJ, 4 ms late. OUT gets the commands' files.
"""

import argparse
import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from pixel2catch.cli.main import main as pixel2catch
from pixel2catch.identification.identify import start_of_fit
from pixel2catch.mdp.dynamics_file import DynamicsFile
from pixel2catch.robots.joint_dynamics import JointDynamics

NOISE = 2e-4
GOALS = {"damping / stiffness [%]": 2.0, "armature [%]": 5.0, "latency [ms]": 1.0, "held out / noise": 1.1}
FILTER_GOALS = {
    "filter_gain [%]": 2.0,
    "filter_lookahead [%]": 2.0,
    "latency [ms]": 1.0,
    "held out / noise": 1.1,
}
PERCENT = ("stiffness", "damping", "frictionloss", "armature", "filter_gain", "filter_lookahead")


def main() -> None:
    args = parsed()
    if args.filter:
        args.robot = "ur5e"
    args.out.mkdir(parents=True)
    rehearsed(args)
    recordings = [str(args.out / "rehearsal" / f"recording-{i}.npz") for i in (1, 2, 3)]
    folder = ["--robot", args.robot, "--out", str(args.out / "identified")]
    run("identify", *recordings, *folder, *(["--filter"] if args.filter else []))
    truth = DynamicsFile.load(args.out / "rehearsal" / "truth.json").dynamics
    result = json.loads((args.out / "identified" / "result.json").read_text())
    goals = FILTER_GOALS if args.filter else GOALS
    errors = errors_of(result, truth)
    print_table(result, truth)
    for name, goal in goals.items():
        worst = max(errors[name], key=lambda joint: errors[name][joint])
        print(f"worst {name}: {errors[name][worst]:.3f} ({worst}), goal {goal:g}")


def parsed() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("out", type=Path, help="new folder")
    parser.add_argument("--robot", default="ur5e_allegro", choices=("ur5e", "allegro", "ur5e_allegro"))
    parser.add_argument("--filter", action="store_true", help="a UR5e's stiff servo behind the servoJ filter")
    parser.add_argument("--seconds", type=float, default=40.0, help="length of each recording")
    parser.add_argument("--seed", type=int, default=0)
    return parser.parse_args()


def rehearsed(args: argparse.Namespace) -> None:
    """Excitation, and what the robot records of it."""
    options = ["--robot", args.robot, "--seconds", str(args.seconds), "--seed", str(args.seed)]
    if args.filter:
        truth = args.out / "with_filter.json"
        stiff = start_of_fit("ur5e", None, fits_filter=True).first
        DynamicsFile(dynamics=stiff.with_values(latency=0.004)).save(truth)
        options += ["--dynamics", str(truth)]
    run("excite", *options, "--speed", "1", "--recordings", "3", "--rehearse", str(args.out / "rehearsal"))


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
        relative = {name: found[name] / getattr(truth, name)[j] for name in PERCENT if found[name]}
        lag = relative["damping"] / relative["stiffness"]
        row = {f"{name} [%]": 100 * abs(ratio - 1.0) for name, ratio in relative.items()}
        row["damping / stiffness [%]"] = 100 * abs(lag - 1.0)
        row["latency [ms]"] = 1e3 * abs(found["latency"] - truth.latency[j])
        row["held out / noise"] = result["tracking_error"]["held_out"]["after"][joint] / NOISE
        for name, value in row.items():
            errors.setdefault(name, {})[joint] = float(value)
    return errors


def fitted(
    result: dict[str, Any], truth: JointDynamics
) -> Iterable[tuple[str, str, float, float, list[float]]]:
    """Joint, parameter, truth, result and interval of what was fitted."""
    for joint, entries in result["parameters"].items():
        for name, entry in entries.items():
            if name in result["free"]:
                known = float(getattr(truth, name)[truth.joints.index(joint)])
                yield joint, name, known, entry["value"], entry["interval"]


def print_table(result: dict[str, Any], truth: JointDynamics) -> None:
    print(f"{'joint':<20} {'parameter':<16} {'truth':>10} {'found':>10}   95 % interval")
    for joint, name, known, value, (low, high) in fitted(result, truth):
        sign = "" if low <= known <= high else "  does not have the truth"
        print(f"{joint:<20} {name:<16} {known:10.4g} {value:10.4g}   {low:.4g} to {high:.4g}{sign}")
    holds = [low <= known <= high for _, _, known, _, (low, high) in fitted(result, truth)]
    print(f"{100 * np.mean(holds):.0f} % of the 95 % intervals have the truth")


if __name__ == "__main__":
    main()
