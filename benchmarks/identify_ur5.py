"""Fit a real UR5's joints to one recording and print how well another one is simulated, per joint.

python benchmarks/identify_ur5.py DATA

DATA has the folders Movement_No1, which is fitted, and Movement_No3_Acc, which is held out; what they are:
ur5_recordings.py. The target is the controller's own trajectory, which moves between its samples and is not a
command that is held: it is interpolated to 1 kHz. So this shows the low-level loop, with hardly any latency,
and a prediction that the joint is where its target is would do well too: it is printed beside the others.
The controller's feed-forward makes that loop look very stiff, and positions do not tell how stiff: the servo
is the one that `identify --filter` takes to be behind a command filter, and its damping and latency are
fitted. Nothing was chosen by the errors of the motion that is held out.
"""

import argparse
import dataclasses
import json
import time
from pathlib import Path

import numpy as np
from ur5_recordings import read_ur5

from pixel2catch.identification.fit import Fit, FitCfg, fit_dynamics
from pixel2catch.identification.identify import estimates, stiff
from pixel2catch.identification.recording import Recording
from pixel2catch.identification.simulation import RecordedMotion, is_settled
from pixel2catch.robots.joint_dynamics import JointDynamics

FREE = ("damping", "latency")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("data", type=Path, help="folder of the two recordings")
    parser.add_argument("--out", type=Path, help="JSON file for the numbers")
    args = parser.parse_args()
    fitted, held_out = (
        continuous(read_ur5(args.data / name)) for name in ("Movement_No1", "Movement_No3_Acc")
    )
    nominal = JointDynamics.nominal(fitted.joints)
    begun = time.process_time()
    fit = fit_dynamics([fitted], stiff(nominal), FitCfg(free=FREE))
    print(f"fitted {', '.join(fit.free)} in {time.process_time() - begun:.0f} s of CPU\n")
    errors = {
        group: {
            "target itself": target_error(recording),
            "nominal": tracking_error(recording, nominal),
            "before the fit": tracking_error(recording, stiff(nominal)),
            "fitted": tracking_error(recording, fit.dynamics),
        }
        for group, recording in (("fitted motion", fitted), ("held-out motion", held_out))
    }
    print("RMSE of the positions [mrad], joint by joint")
    for group, rows in errors.items():
        for name, row in rows.items():
            print(f"{group:<16} {name:<16}" + "".join(f"{1e3 * error:8.2f}" for error in row))
    print("\njoint                damping/stiffness [ms]     latency [ms], with half of their 95 % intervals")
    for joint, row in zip(fit.dynamics.joints, parameters(fit), strict=True):
        print(f"{joint:<20} {row[0]:10.2f} ± {row[1]:.2f} {row[2]:16.2f} ± {row[3]:.2f}")
    if args.out:
        content = {
            group: {name: row.tolist() for name, row in rows.items()} for group, rows in errors.items()
        }
        args.out.write_text(json.dumps({"RMSE [rad]": content, "dynamics": fit.dynamics.to_dict()}, indent=2))


def continuous(recording: Recording) -> Recording:
    """The same recording with its targets interpolated to 1 kHz."""
    t_cmd = np.arange(recording.t_cmd[0], recording.t_cmd[-1], 1e-3)
    columns = [np.interp(t_cmd, recording.t_cmd, column) for column in recording.q_cmd.T]
    return dataclasses.replace(recording, t_cmd=t_cmd, q_cmd=np.stack(columns, axis=-1))


def target_error(recording: Recording) -> np.ndarray:
    """Error of the prediction that the joints are where their targets are [rad]."""
    error = recording.held(recording.t_meas) - recording.q
    return np.sqrt(np.mean(error[is_settled(recording)] ** 2, axis=0))


def tracking_error(recording: Recording, dynamics: JointDynamics) -> np.ndarray:
    """Root mean square of simulated minus measured positions, joint by joint [rad]."""
    motion = RecordedMotion([recording])
    (simulated,) = motion.simulate([dynamics])
    return np.sqrt(np.mean((simulated - motion.measured) ** 2, axis=0))


def parameters(fit: Fit) -> np.ndarray:
    """Lag, its interval, latency, its interval [ms], joint by joint."""
    damping, latency = (estimates(fit)[name] for name in ("damping", "latency"))
    lag = 1e3 * damping.value / fit.dynamics.stiffness
    columns = [lag, lag * damping.half_width, 1e3 * latency.value, 10 * latency.half_width]
    return np.stack(columns, axis=-1)


if __name__ == "__main__":
    main()
