"""How often the 95 % intervals of a fit have the truth in them: three joints, many seeds.

python benchmarks/identify_coverage.py [--seeds 20] [--truth-hz 480] [--out FILE]

Every seed draws a robot, up to 40 % off in every parameter, an excitation of 20 s, and a recording of it with
noise, latency and stalled loops. Other joints are welded.
"""

import argparse
import json
import time
from pathlib import Path

import numpy as np

from pixel2catch.identification.excitation import ExcitationCfg, draw_excitation
from pixel2catch.identification.fit import LATENCY_UNIT, SERVO_PARAMETERS, Fit, FitCfg, fit_dynamics
from pixel2catch.identification.intervals import CONFIDENCE
from pixel2catch.identification.recording import Trajectory
from pixel2catch.identification.rehearsal import Recorder, simulated_recordings, unlike_nominal
from pixel2catch.robots.joint_dynamics import JointDynamics

FREE = SERVO_PARAMETERS
JOINTS = ("elbow_joint", "wrist_3_joint", "index_joint_1")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument(
        "--truth-hz", type=float, default=480.0, help="physics steps in a second of the truth"
    )
    parser.add_argument("--out", type=Path, help="JSON file for the numbers")
    args = parser.parse_args()
    scores = []
    for seed in range(args.seeds):
        begun = time.process_time()
        scores.append(standard_scores(seed, args.truth_hz))
        worst = np.abs(scores[-1]).max()
        spent = time.process_time() - begun
        print(f"seed {seed}: worst error {worst:.1f} standard errors, {spent:.0f} s of CPU", flush=True)
    sizes = np.abs(scores)
    shares = {
        name: float(share) for name, share in zip(FREE, np.mean(sizes < CONFIDENCE, axis=(0, 1)), strict=True)
    }
    spread = np.sqrt(0.05 * 0.95 / sizes[..., 0].size)
    print(f"intervals that have the truth [%], 95 ± {100 * spread:.0f} expected:")
    print(", ".join(f"{name} {100 * share:.0f}" for name, share in shares.items()))
    print(f"all {100 * np.mean(sizes < CONFIDENCE):.1f} of {sizes.size}")
    print(
        f"errors in standard errors: median {np.median(sizes):.2f} (0.67 expected), largest {sizes.max():.1f}"
    )
    if args.out:
        content = {
            "truth_hz": args.truth_hz,
            "joints": JOINTS,
            "free": FREE,
            "errors over standard errors": scores,
        }
        args.out.write_text(json.dumps(content, default=np.ndarray.tolist))


def standard_scores(seed: int, truth_hz: float) -> np.ndarray:
    """Errors over standard errors, joint by joint."""
    truth = unlike_nominal(np.random.default_rng(seed), JointDynamics.nominal(JOINTS))
    cfg = Recorder(physics_dt=1.0 / truth_hz)
    recordings = simulated_recordings([excitation(seed)], truth, cfg, np.random.default_rng((seed, 1)))
    fit = fit_dynamics(recordings, JointDynamics.nominal(JOINTS), FitCfg(free=FREE))
    return errors(fit, truth) / np.sqrt(np.diagonal(fit.covariance, axis1=1, axis2=2))


def excitation(seed: int) -> Trajectory:
    """Some joints of a whole robot's excitation."""
    whole = draw_excitation(ExcitationCfg(seconds=20.0, seed=seed), {})
    columns = [whole.joints.index(joint) for joint in JOINTS]
    return Trajectory(joints=JOINTS, times=whole.times, positions=whole.positions[:, columns])


def errors(fit: Fit, truth: JointDynamics) -> np.ndarray:
    """In the coordinates of the fit, joint by joint."""
    columns = []
    for name in fit.free:
        found, known = getattr(fit.dynamics, name), getattr(truth, name)
        columns.append((found - known) / LATENCY_UNIT if name == "latency" else np.log(found / known))
    return np.stack(columns, axis=-1)


if __name__ == "__main__":
    main()
