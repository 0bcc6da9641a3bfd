"""Fit a real UR5's joints to one recording and print how well another one is simulated, per joint.

python benchmarks/identify_ur5.py DATA

DATA has the folders Movement_No1, which is fitted, and Movement_No3_Acc, which is held out; what they are:
ur5_recordings.py. The target is the controller's own trajectory, which moves between its samples and is not a
command that is held: it is interpolated to 1 kHz. So this shows the low-level loop, with hardly any latency.
The controller's feed-forward makes that loop look very stiff, and positions do not tell how stiff: the
stiffness is set to ten times the nominal one, damping and latency are fitted.
"""

import argparse
import dataclasses
import time
from pathlib import Path

import numpy as np
from ur5_recordings import read_ur5

from pixel2catch.identification.fit import fit_dynamics, tracking_error
from pixel2catch.identification.fit_problem import FitCfg
from pixel2catch.identification.identifiability import describe
from pixel2catch.identification.recording import Recording
from pixel2catch.robot.joint_dynamics import JointDynamics

PHYSICS_DT = 1.0 / 240.0
STIFFNESS_FACTOR = 10.0
LAG = 0.003
"""Damping over stiffness that the fit starts from [s]."""


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("data", type=Path, help="folder of the two recordings")
    data = parser.parse_args().data
    fitted, held_out = (continuous(read_ur5(data / name)) for name in ("Movement_No1", "Movement_No3_Acc"))
    nominal = JointDynamics.nominal(fitted.joints)
    begin = time.perf_counter()
    stiffness = STIFFNESS_FACTOR * nominal.stiffness
    start = nominal.with_values(stiffness=stiffness, damping=LAG * stiffness)
    fit = fit_dynamics([fitted], start, FitCfg(free=("damping", "latency"), physics_dt=PHYSICS_DT))
    print(f"fitted {', '.join(fit.free)} in {time.perf_counter() - begin:.0f} s\n")
    print("RMSE of the positions [mrad], joint by joint; left what was fitted, right what was held out")
    for name, dynamics in (("nominal", nominal), ("fitted", fit.dynamics)):
        errors = [tracking_error([recording], dynamics, PHYSICS_DT) for recording in (fitted, held_out)]
        print(f"{name:>8} " + "   ".join(map(numbers, errors)))
    print()
    print(describe(fit))


def continuous(recording: Recording) -> Recording:
    """The same recording with its targets interpolated to 1 kHz."""
    t_cmd = np.arange(recording.t_cmd[0], recording.t_cmd[-1], 1e-3)
    columns = [np.interp(t_cmd, recording.t_cmd, column) for column in recording.q_cmd.T]
    return dataclasses.replace(recording, t_cmd=t_cmd, q_cmd=np.stack(columns, axis=-1))


def numbers(errors: np.ndarray) -> str:
    return "".join(f"{1e3 * error:8.2f}" for error in errors)


if __name__ == "__main__":
    main()
