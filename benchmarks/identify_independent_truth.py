"""Identify robots that are not our simulation, and print how far off the results are and what intervals hold.

python benchmarks/identify_independent_truth.py [--seeds 20] [--joints 9] [--processes 15] [--out FILE]

The robots: independent_robot.py. Every seed draws a robot with its faults; each of its joints moves alone by
two of `excite`'s trajectories, is checked as by `identify --check`, and fitted alone, from the nominal joint.
Friction has a range, from the least level in motion to what it takes to leave rest: errors are distances to
the range, and intervals hold it if they reach into it. Where a parameter is called not identifiable, neither
its error nor its interval counts.
"""

import json
import os
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from independent_robot import GEARS, JOINTS, Faults, Robot

from pixel2catch.identification.checks import check_recording
from pixel2catch.identification.excitation import ExcitationCfg, draw_excitation
from pixel2catch.identification.fit import LATENCY_UNIT, FitCfg, fit_dynamics
from pixel2catch.identification.identify import estimates
from pixel2catch.identification.report import UNKNOWN_WIDTH
from pixel2catch.robots.joint_dynamics import JointDynamics

FRICTION = ("frictionloss", "frictionloss / stiffness")
Row = dict[str, float]


def main(
    seeds: int = 20,
    first_seed: int = 0,
    seconds: float = 20.0,
    joints: int = len(JOINTS),
    processes: int = 1,
    out: Path | None = None,
) -> None:
    every_seed = range(first_seed, first_seed + seeds)
    numbers = [(seed, seed * joints + i) for seed in every_seed for i in range(joints)]
    cases = [(seed, list(JOINTS)[number % len(JOINTS)]) for seed, number in numbers]
    found = []
    with ProcessPoolExecutor(processes, initializer=use_one_core) as pool:
        for case in pool.map(partial(found_in, seconds=seconds), cases):
            rows = case["parameters"]
            texts = [f"{key} {row['error']:+.3g}{'' if row['holds'] else '!'}" for key, row in rows.items()]
            print(f"seed {case['seed']} {case['joint']}: {', '.join([*texts, *case['bad']])}", flush=True)
            found.append(case)
            if out:
                with open(out, "a", encoding="utf-8") as file:
                    print(json.dumps(case), file=file, flush=True)
    print_summary(found)


def use_one_core() -> None:
    """A fit takes as many threads as there are cores; side by side they would wait for each other."""
    cores = sorted(os.sched_getaffinity(0))
    os.sched_setaffinity(0, {cores[os.getpid() % len(cores)]})


def found_in(case: tuple[int, str], seconds: float, faults: Faults | None = None) -> dict[str, Any]:
    """Faults, failed checks and errors of the fit of a seed's joint."""
    seed, name = case
    faults = faults or Faults.drawn(np.random.default_rng((18, seed)))
    rng = np.random.default_rng((17, seed, list(JOINTS).index(name)))
    robot = Robot.drawn(rng, (name,), faults)
    motions = [draw_excitation(ExcitationCfg(seconds=seconds, seed=2 * seed + i), {}) for i in range(2)]
    pairs = [robot.recorded(rng, [motion]) for motion in motions]
    recordings = [recording for (recording,), _ in pairs]
    checks = [check for recording in recordings for check in check_recording(recording)]
    bad = sorted({f"{check.name} {check.verdict}" for check in checks if check.is_good is False})
    fit = fit_dynamics(recordings, JointDynamics.of().select((name,)), FitCfg())
    low, high = np.mean([friction[0] for _, friction in pairs], axis=0)
    truth = {key: getattr(robot, key)[0] for key in ("stiffness", "armature", "latency")}
    truth |= {"damping": robot.felt_damping[0], "frictionloss": low}
    rows: dict[str, Row] = {}
    for key, found in estimates(fit).items():
        value, width = found.value[0], found.half_width[0]
        above, _, below = key.partition(" / ")
        true = truth[above] / truth[below] if below else truth[above]
        if key == "latency":
            rows[key] = row(value - true, LATENCY_UNIT * width)
        else:
            rest = np.log(faults.stribeck * high / low) if key in FRICTION else 0.0
            rows[key] = row(float(np.log(value / true)), width, rest)
            rows[key]["is known"] = float(width < UNKNOWN_WIDTH)
    play = faults.play * GEARS[JOINTS[name][-1]][1]
    rows["play"] = row(fit.encoders.play[0] - play, 1.96 * fit.encoder_deviations.play[0])
    drifts = zip(fit.encoders.drift[:, 0], fit.encoder_deviations.drift[:, 0], strict=True)
    for i, (drift, deviation) in enumerate(drifts, start=1):
        rows[f"drift {i}"] = row(drift - faults.drift, 1.96 * deviation)
    return {"seed": seed, "joint": name, "faults": vars(faults), "bad": bad, "parameters": rows}


def row(error: float, width: float, rest: float = 0.0) -> Row:
    """An error beyond a range from 0, half of its interval, and whether that reaches into the range."""
    beyond = float(error - np.clip(error, 0.0, rest))
    return {"error": beyond, "width": float(width), "holds": float(abs(beyond) <= width)}


def print_summary(found: list[dict[str, Any]]) -> None:
    """Medians and 90 % quantiles of errors and widths, and shares of intervals that hold."""
    whole: list[float] = []
    print("\nparameter: known in, error in the median and in nine of ten, half-width, intervals that hold")
    for key in found[0]["parameters"]:
        rows = [case["parameters"][key] for case in found]
        known = [each for each in rows if each.get("is known", 1.0)]
        if not known:
            print(f"{key}: never")
            continue
        errors, holds = np.abs([each["error"] for each in known]), [each["holds"] for each in known]
        whole += holds
        middle, most = np.quantile(errors, (0.5, 0.9))
        width = np.median([each["width"] for each in known])
        share = f"{100 * np.mean(holds):.0f} %"
        print(f"{key}: {len(known)} of {len(rows)}, {middle:.3g}, {most:.3g}, {width:.3g}, {share}")
    bad = [text for case in found for text in case["bad"]]
    print("failed checks:", {text: bad.count(text) for text in sorted({*bad})} or "none")
    print(f"{100 * np.mean(whole):.1f} % of {len(whole)} intervals hold, 95 are meant to, goal 90")


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
