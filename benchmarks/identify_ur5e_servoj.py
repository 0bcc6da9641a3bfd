"""Identify the servoJ filter of a real UR5e, whose settings its program says, and print what is found.

python benchmarks/identify_ur5e_servoj.py DATA [--gain 100] [--lookahead 0.03]

DATA has Data_Joint_0.csv, Data_Joint_4.csv and Data_Joint_5.csv of repository Yuxuan-Liang-git/UR5e_Torque,
folder joint_test/Data. Its program (get_traindata.py) has one joint follow a path by servoJ at 500 Hz with a
gain of 300 and a look-ahead of 0.1 s, counts loops of 2 ms as time, and draws every 0.1 s of it; the loop
stops meanwhile: `identify --check` calls such recordings BAD. Here the clock is mended first: where the
program draws, the time that passed is the motion over the measured speed. The first half of each recording is
fitted, from another filter; the second is held out.
"""

import argparse
from pathlib import Path

import numpy as np

from pixel2catch.arrays import read_table
from pixel2catch.identification.checks import check_recording
from pixel2catch.identification.fit import FILTER_PARAMETERS, LATENCY_UNIT, FitCfg, fit_dynamics
from pixel2catch.identification.identify import estimates, stiff
from pixel2catch.identification.recording import Recording
from pixel2catch.identification.simulation import RecordedMotion, is_settled
from pixel2catch.robots.joint_dynamics import JointDynamics

JOINTS = {0: "shoulder_pan_joint", 4: "wrist_2_joint", 5: "wrist_3_joint"}
DRAWING = 0.1  # time of the program between two drawings [s]
SPEED, LEAST_SPEED = 0.1, 0.02  # from which one drawing's length is told, and that of most [rad/s]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("data", type=Path)
    parser.add_argument("--gain", type=float, default=100.0, help="of the filter that the fit starts from")
    parser.add_argument("--lookahead", type=float, default=0.03, help="of the same [s]")
    args = parser.parse_args()
    for number, joint in JOINTS.items():
        recorded, speed = read(args.data / f"Data_Joint_{number}.csv", joint)
        bad = [f"{check.name}: {check.detail}" for check in check_recording(recorded) if check.forbids_fit]
        print(f"{joint}: {'; '.join(bad)}")
        whole = mended(recorded, speed)
        middle = 0.5 * whole.t_meas[-1]
        fitted, held_out = (part(whole, *span) for span in ((0.5, middle), (middle, np.inf)))
        nominal = stiff(JointDynamics.of().select((joint,)))
        start = nominal.with_values(filter_gain=[args.gain], filter_lookahead=[args.lookahead])
        fit = fit_dynamics([fitted], start, FitCfg(free=FILTER_PARAMETERS))
        for name, found in estimates(fit).items():
            value, width = found.value[0], found.half_width[0]
            half = LATENCY_UNIT * width if name == "latency" else value * width
            print(f"  {name} {value:.4g} ± {half:.2g}")
        errors = (
            target_error(held_out),
            tracking_error(held_out, start),
            tracking_error(held_out, fit.dynamics),
        )
        texts = (f"{1e3 * error[0]:.2f}" for error in errors)
        print("  held out, RMSE [mrad] of the command itself, before and after:", ", ".join(texts))


def read(path: Path, joint: str) -> tuple[Recording, np.ndarray]:
    """A recording by the program's own time, and the measured speed in each of its steps [rad/s]."""
    table, _ = read_table(path, ("time", "q_des", "q_act", "dq_act"))
    time, command, q, qd = np.split(table, 4, axis=1)
    times = time[:, 0]
    recording = Recording(name=path.name, joints=(joint,), t_cmd=times, q_cmd=command, t_meas=times, q=q)
    return recording, (qd[1:, 0] + qd[:-1, 0]) / 2


def mended(recording: Recording, speed: np.ndarray) -> Recording:
    """The same recording with the time that drawings took: motion over speed [rad/s] beyond a step's own."""
    time, fast = recording.t_meas.copy(), np.where(np.abs(speed) > LEAST_SPEED, speed, np.inf)
    excess = np.diff(recording.q[:, 0]) / fast - np.diff(time)
    drawn = np.searchsorted(
        time[:-1], np.cumsum([0.0, *np.full(int(time[-1] / DRAWING), DRAWING)])
    )  # as it adds
    is_drawing = np.isin(np.arange(len(excess)), drawn)
    usual = np.median(excess[is_drawing & (np.abs(speed) > LEAST_SPEED)])
    took = np.where(np.abs(speed) > SPEED, excess, usual)
    time[1:] += np.cumsum(np.where(is_drawing, took, 0.0))
    return part(recording, 0.0, np.inf, time)


def part(recording: Recording, begin: float, end: float, time: np.ndarray | None = None) -> Recording:
    """A part between two times [s], perhaps with others for those that were recorded."""
    times = recording.t_meas if time is None else time
    is_in = (times >= begin) & (times < end)
    return Recording(
        name=recording.name,
        joints=recording.joints,
        t_cmd=times[is_in],
        q_cmd=recording.q_cmd[is_in],
        t_meas=times[is_in],
        q=recording.q[is_in],
    )


def target_error(recording: Recording) -> np.ndarray:
    """Error of the prediction that the joints are where their targets are [rad]."""
    error = recording.held(recording.t_meas) - recording.q
    return np.sqrt(np.mean(error[is_settled(recording)] ** 2, axis=0))


def tracking_error(recording: Recording, dynamics: JointDynamics) -> np.ndarray:
    """Root mean square of simulated minus measured positions, joint by joint [rad]."""
    motion = RecordedMotion([recording])
    (simulated,) = motion.simulate([dynamics])
    return np.sqrt(np.mean((simulated - motion.measured) ** 2, axis=0))


if __name__ == "__main__":
    main()
