"""Identify a robot that is not our simulation, and print how far off the result is and what intervals hold.

python benchmarks/identify_independent_truth.py [--seeds 20] [--seconds 20] [--all-joints] [--out FILE]

The robot: independent_robot.py. Every seed draws each joint anew, moves it alone by two of `excite`'s
trajectories, and fits it alone, from the nominal joint. Friction has a range, from the Coulomb level in
motion to what it takes to leave rest: errors are distances to the range, and intervals hold it if they reach
into it; what is beside the Coulomb level alone is printed, too. Where a parameter is called not identifiable,
neither its error nor its interval counts.
"""

import argparse
import json
import time
from pathlib import Path

import numpy as np
from independent_robot import GEARS, JOINTS, Faults, Robot

from pixel2catch.identification.excitation import ExcitationCfg, draw_excitation
from pixel2catch.identification.fit import LATENCY_UNIT, FitCfg, fit_dynamics
from pixel2catch.identification.identify import half_widths
from pixel2catch.identification.recording import Recording
from pixel2catch.identification.report_tables import UNKNOWN_WIDTH
from pixel2catch.robots.joint_dynamics import JointDynamics

FEW = ("elbow_joint", "wrist_3_joint", "index_joint_1")
GOALS = {"lag": 0.02, "frictionloss": 0.3, "armature": 0.2, "latency": 1e-3}
Row = dict[str, float]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--seconds", type=float, default=20.0, help="length of each of the two recordings")
    parser.add_argument("--all-joints", action="store_true", help="nine joints instead of three")
    parser.add_argument("--out", type=Path, help="JSON file for the numbers")
    args = parser.parse_args()
    names = tuple(JOINTS) if args.all_joints else FEW
    found: dict[str, list[dict[str, Row]]] = {name: [] for name in names}
    begun = time.process_time()
    for seed in range(args.first_seed, args.first_seed + args.seeds):
        robot, recordings = recorded(seed, names, args.seconds)
        for j, name in enumerate(names):
            found[name].append(judged(robot, j, recordings[j]))
            texts = (
                f"{key} {row['error']:+.3g}{'' if row['holds'] else '!'}"
                for key, row in found[name][-1].items()
            )
            print(f"seed {seed} {name}: {', '.join(texts)}", flush=True)
    print_summary(found)
    num_fits = args.seeds * len(names)
    print(f"{(time.process_time() - begun) / num_fits:.1f} s of CPU a fit")
    if args.out:
        args.out.write_text(json.dumps(found))


def recorded(seed: int, names: tuple[str, ...], seconds: float) -> tuple[Robot, list[list[Recording]]]:
    """A robot, and two recordings of each of its joints."""
    rng = np.random.default_rng((17, seed))
    robot = Robot.drawn(rng, names, Faults())
    motions = [draw_excitation(ExcitationCfg(seconds=seconds, seed=2 * seed + i), {}) for i in range(2)]
    recordings = [robot.recorded(rng, [motion] * len(names)) for motion in motions]
    return robot, [list(pair) for pair in zip(*recordings, strict=True)]


def judged(robot: Robot, j: int, recordings: list[Recording]) -> dict[str, Row]:
    """Errors of a joint's fit: logarithms, but for latency [s], play [rad] and drift."""
    fit = fit_dynamics(recordings, JointDynamics.nominal(robot.names[j : j + 1]), FitCfg())
    truth = {name: getattr(robot, name)[j] for name in ("stiffness", "frictionloss", "armature", "latency")}
    truth["damping"] = robot.felt_damping[j]
    rows: dict[str, Row] = {}
    for name, width in zip(fit.free, half_widths(fit)[0], strict=True):
        value = getattr(fit.dynamics, name)[0]
        if name == "latency":
            rows[name] = row(value - truth[name], LATENCY_UNIT * width)
        else:
            error = float(np.log(value / truth[name]))
            rest = np.log(robot.faults.stribeck) if name == "frictionloss" else 0.0
            rows[name] = row(error, width, rest) | {"is known": float(width < UNKNOWN_WIDTH)}
    lag = np.log(fit.dynamics.damping / fit.dynamics.stiffness * truth["stiffness"] / truth["damping"])
    rows["lag"] = row(float(lag[0]), np.inf)
    play = robot.faults.play * GEARS[JOINTS[robot.names[j]][-1]][1]
    rows["play"] = row(fit.encoders.play[0] - play, 1.96 * fit.encoder_deviations.play[0])
    for drift, deviation in zip(fit.encoders.drift[:, 0], fit.encoder_deviations.drift[:, 0], strict=True):
        rows["drift"] = row(drift - robot.faults.drift, 1.96 * deviation)
    return rows


def row(error: float, width: float, rest: float = 0.0) -> Row:
    """An error beyond a range from 0, half of its interval, and whether that reaches into the range."""
    beyond = float(error - np.clip(error, 0.0, rest))
    return {"error": beyond, "width": width, "holds": float(abs(beyond) <= width), "from 0": float(error)}


def print_summary(found: dict[str, list[dict[str, Row]]]) -> None:
    """Medians and 90 % quantiles of the errors, and shares of intervals that hold, joint by joint."""
    counted: list[bool] = []
    for name, seeds in found.items():
        print(f"\n{name}: error in the median and in nine of ten seeds; intervals that hold [%]")
        for key in seeds[0]:
            rows = [each[key] for each in seeds if each[key].get("is known", 1.0)]
            if not rows:
                print(f"  {key:<13} not identifiable in any of {len(seeds)} seeds")
                continue
            errors = np.abs([each["error"] for each in rows])
            holds = [bool(each["holds"]) for each in rows]
            counted += [] if key == "lag" else holds
            shares = "" if key == "lag" else f", intervals hold {100 * np.mean(holds):.0f}"
            goal = f", goal {GOALS[key]:g}" if key in GOALS else ""
            left = f", not identifiable in {len(seeds) - len(rows)}" if len(rows) < len(seeds) else ""
            print(f"  {key:<13} {np.median(errors):.3g}, {np.quantile(errors, 0.9):.3g}{goal}{shares}{left}")
            if key == "frictionloss":
                errors = np.abs([each["from 0"] for each in rows])
                held = np.mean([errors[i] <= each["width"] for i, each in enumerate(rows)])
                texts = [f"{np.quantile(errors, share):.3g}" for share in (0.5, 0.9)]
                print(f"    to Coulomb's {', '.join(texts)}, intervals hold {100 * held:.0f}")
    print(f"\n{100 * np.mean(counted):.1f} % of {len(counted)} intervals hold, 95 are meant to, goal 90")


if __name__ == "__main__":
    main()
