"""Identify a robot that is not our simulation, and print how far off the result is and what intervals hold.

python benchmarks/identify_independent_truth.py [--seeds 20] [--joints NAME ...] [--processes 15] [--out FILE]

The robot: independent_robot.py. Every seed draws each joint anew, moves it alone by two of `excite`'s
trajectories, and fits it alone, from the nominal joint. Friction has a range, from the Coulomb level in
motion to what it takes to leave rest: errors are distances to the range, and intervals hold it if they reach
into it; what is beside the Coulomb level alone is printed, too. Where a parameter is called not identifiable,
neither its error nor its interval counts.
"""

import argparse
import json
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path

import numpy as np
from independent_robot import GEARS, JOINTS, Faults, Robot

from pixel2catch.identification.excitation import ExcitationCfg, draw_excitation
from pixel2catch.identification.fit import LATENCY_UNIT, FitCfg, fit_dynamics
from pixel2catch.identification.identify import estimates
from pixel2catch.identification.recording import Recording
from pixel2catch.identification.report import UNKNOWN_WIDTH
from pixel2catch.robots.joint_dynamics import JointDynamics

LAG, FRICTION = "damping / stiffness", "frictionloss / stiffness"
GOALS = {LAG: 0.02, "frictionloss": 0.3, FRICTION: 0.3, "armature": 0.2, "latency": 1e-3}
Row = dict[str, float]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--seconds", type=float, default=20.0, help="length of each of the two recordings")
    parser.add_argument("--joints", nargs="+", choices=JOINTS, default=list(JOINTS))
    parser.add_argument("--viscous", type=float, default=1.0, help="factor on the joints' viscous friction")
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument("--out", type=Path, help="file of JSON lines for the numbers, written as they come")
    args = parser.parse_args()
    seeds = range(args.first_seed, args.first_seed + args.seeds)
    cases = [(seed, name) for seed in seeds for name in args.joints]
    work = partial(found_in, seconds=args.seconds, faults=Faults(viscous=args.viscous))
    found: dict[str, list[dict[str, Row]]] = {name: [] for name in args.joints}
    with ProcessPoolExecutor(args.processes) as pool:
        for (seed, name), rows in zip(cases, pool.map(work, cases), strict=True):
            found[name].append(rows)
            texts = (f"{key} {row['error']:+.3g}{'' if row['holds'] else '!'}" for key, row in rows.items())
            print(f"seed {seed} {name}: {', '.join(texts)}", flush=True)
            if args.out:
                with open(args.out, "a", encoding="utf-8") as file:
                    print(json.dumps({"seed": seed, "joint": name, **rows}), file=file, flush=True)
    print_summary(found)


def found_in(case: tuple[int, str], seconds: float, faults: Faults) -> dict[str, Row]:
    """Errors of a seed's joint."""
    robot, (recordings,) = recorded(case[0], (case[1],), seconds, faults)
    return judged(robot, 0, recordings)


def recorded(
    seed: int, names: tuple[str, ...], seconds: float, faults: Faults
) -> tuple[Robot, list[list[Recording]]]:
    """A robot, and two recordings of each of its joints."""
    rng = np.random.default_rng((17, seed, *(list(JOINTS).index(name) for name in names)))
    robot = Robot.drawn(rng, names, faults)
    motions = [draw_excitation(ExcitationCfg(seconds=seconds, seed=2 * seed + i), {}) for i in range(2)]
    recordings = [robot.recorded(rng, [motion] * len(names)) for motion in motions]
    return robot, [list(pair) for pair in zip(*recordings, strict=True)]


def judged(robot: Robot, j: int, recordings: list[Recording]) -> dict[str, Row]:
    """Errors of a joint's fit: logarithms, but for latency [s], play [rad] and drift."""
    fit = fit_dynamics(recordings, JointDynamics.nominal().select(robot.names[j : j + 1]), FitCfg())
    truth = {name: getattr(robot, name)[j] for name in ("stiffness", "frictionloss", "armature", "latency")}
    truth["damping"] = robot.felt_damping[j]
    rows: dict[str, Row] = {}
    for name, found in estimates(fit).items():
        value, width = found.value[0], found.half_width[0]
        above, _, below = name.partition(" / ")
        true = truth[above] / truth[below] if below else truth[above]
        if name == "latency":
            rows[name] = row(value - true, LATENCY_UNIT * width)
        else:
            error = float(np.log(value / true))
            rest = np.log(robot.faults.stribeck) if name in ("frictionloss", FRICTION) else 0.0
            rows[name] = row(error, width, rest) | {"is known": float(width < UNKNOWN_WIDTH)}
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
    counted: dict[str, list[bool]] = {}
    for name, seeds in found.items():
        print(
            f"\n{name}, {len(seeds)} seeds: error in the median and in nine of ten; intervals that hold [%]"
        )
        for key in seeds[0] if seeds else ():
            rows = [each[key] for each in seeds if each[key].get("is known", 1.0)]
            if not rows:
                print(f"  {key:<24} not identifiable in any")
                continue
            errors = np.abs([each["error"] for each in rows])
            holds = [bool(each["holds"]) for each in rows]
            counted[key] = counted.get(key, []) + holds
            goal = f", goal {GOALS[key]:g}" if key in GOALS else ""
            left = f", not identifiable in {len(seeds) - len(rows)}" if len(rows) < len(seeds) else ""
            texts = [f"{np.quantile(errors, share):.3g}" for share in (0.5, 0.9)]
            print(f"  {key:<24} {', '.join(texts)}{goal}, hold {100 * np.mean(holds):.0f}{left}")
            if key in ("frictionloss", FRICTION):
                errors = np.abs([each["from 0"] for each in rows])
                held = np.mean([errors[i] <= each["width"] for i, each in enumerate(rows)])
                texts = [f"{np.quantile(errors, share):.3g}" for share in (0.5, 0.9)]
                print(f"    to Coulomb's           {', '.join(texts)}, hold {100 * held:.0f}")
    for key, holds in counted.items():
        print(f"{key:<26} {100 * np.mean(holds):.0f} % of {len(holds)} intervals hold")
    whole = [each for holds in counted.values() for each in holds]
    print(f"\n{100 * np.mean(whole):.1f} % of {len(whole)} intervals hold, 95 are meant to, goal 90")


if __name__ == "__main__":
    main()
