"""Identify a real servo of a hand, Dynamixel XL330-M288, at four gains that are known, and print the results.

python benchmarks/identify_xl330.py DATA --out FILE

DATA is the folder bam/data.bak/raw of repository Rhoban/bam at revision af226046 (Apache-2.0): a pendulum of
0.49 kg at 0.1 m on the servo, which follows goals at 187 Hz for 6 s. For each gain `sin_time_square` and
`sin_sin` are fitted from one start and `up_and_down` is held out; `lift_and_drop` turns the torque off. The
servo's stiffness is proportional to its gain: a doubled gain doubles what is found, if the intervals hold.
"""

import json
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import tyro
from tyro.conf import Positional

from pixel2catch.identification.checks import check_recording
from pixel2catch.identification.fit import FitCfg, fit_dynamics
from pixel2catch.identification.identify import estimates
from pixel2catch.identification.recording import Recording
from pixel2catch.identification.simulation import RecordedMotion
from pixel2catch.robots.joint_dynamics import JointDynamics
from pixel2catch.robots.spec import JointGroup, JointSpec, PalmSpec, Placed, RobotSpec
from pixel2catch.robots.workcell import WorkcellSpec

GAINS = (100, 200, 400, 800)
FITTED, HELD_OUT = ("sin_time_square", "sin_sin"), "up_and_down"
MJCF = """<mujoco><worldbody><body name="pendulum"><joint name="servo" axis="0 1 0"/>
<inertial pos="0 0 -0.1" mass="0.49" diaginertia="1e-5 1e-5 1e-5"/><site name="palm"/>
</body></worldbody></mujoco>"""
START: dict[str, Any] = {"stiffness": 1.0, "damping": 0.05, "frictionloss": 0.02, "armature": 2e-3}
SERVO = JointSpec(
    name="servo", lower=-1.6, upper=1.6, home=0.0, effort_limit=0.5, velocity_limit=8.0, **START
)
"""A rough guess of small servos. Source: ours; torque: the maker's stall torque of 0.52 N·m at 5 V."""


def main(data: Positional[Path], out: Path) -> None:
    with TemporaryDirectory() as folder:
        results = [found_at(data, gain, rig(Path(folder, "rig.xml"))) for gain in GAINS]
    out.write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")
    lower = results[0]
    for result in results:
        ratio = np.log(result["stiffness"]["value"] / lower["stiffness"]["value"])
        width = np.hypot(result["stiffness"]["half_width"], lower["stiffness"]["half_width"])
        off = ratio - np.log(result["gain"] / lower["gain"])
        print(f"gain {result['gain']}: {result}\n  log of stiffness over gain: {off:+.3f} ± {width:.3f}")
        lower = result


def rig(mjcf: Path) -> WorkcellSpec:
    """The pendulum as a work cell of one joint."""
    mjcf.write_text(MJCF, encoding="utf-8")
    noise = {"gain_range": (0.8, 1.2), "action_noise": 0.0, "action_bias": 0.0}
    group = JointGroup(name="hand", role="hand", joints=(SERVO,), command="absolute", **noise)
    palm = PalmSpec(name="palm", site="palm", body="pendulum", fingers=(), lower=(0, 0, 0), upper=(0, 0, 0))
    robot = RobotSpec(name="rig", mjcf=mjcf, root="pendulum", groups=(group,), palms=(palm,))
    return WorkcellSpec(name="rig", robots=(Placed(robot=robot, pos=(0.0, 0.0, 1.0)),))


def found_at(folder: Path, gain: int, workcell: WorkcellSpec) -> dict:
    """Checks, parameters with half-widths of their logarithms, and errors on held-out motion at a gain."""
    contents = [json.loads(path.read_text()) for path in sorted(folder.glob("*.json"))]
    recordings = {each["trajectory"]: recording(each, workcell) for each in contents if each["kp"] == gain}
    start = JointDynamics.of(workcell.joints)
    fit = fit_dynamics([recordings[name] for name in FITTED], start, FitCfg())
    motion = RecordedMotion([recordings[HELD_OUT]])
    errors = {
        name: float(np.sqrt(np.mean((motion.simulate([each])[0] - motion.measured) ** 2)))
        for name, each in {"before": start, "after": fit.dynamics}.items()
    }
    checks = [check for name in (*FITTED, HELD_OUT) for check in check_recording(recordings[name])]
    failed = sorted({f"{check.name}: {check.detail}" for check in checks if check.is_good is False})
    result = {"gain": gain, "held out, RMS error [rad]": errors, "failed checks": failed}
    for name, found in estimates(fit).items():
        result[name] = {"value": float(found.value[0]), "half_width": float(found.half_width[0])}
    return result


def recording(content: dict, workcell: WorkcellSpec) -> Recording:
    """A recording of the rig."""
    columns = ("timestamp", "goal_position", "position")
    time, goal, q = np.array([[row[name] for name in columns] for row in content["entries"]]).T
    columns = {"t_cmd": time, "q_cmd": goal[:, None], "t_meas": time, "q": q[:, None]}
    return Recording(name=content["trajectory"], workcell=workcell, joints=("servo",), **columns)


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
