"""From an MJCF of your own to a policy: its joints, its palm, a place, a training (docs/extending/robot.md).

pixel2catch train catch_teacher --import examples/robot_from_mjcf.py --workcell scoop --out runs/scoop
pixel2catch play runs/scoop --import examples/robot_from_mjcf.py
"""

from pathlib import Path
from typing import Any

import tyro

import pixel2catch as p2c
from pixel2catch.robots.spec import FingerSpec, JointGroup, JointSpec, PalmSpec, Placed, RobotSpec
from pixel2catch.robots.workcell import WorkcellSpec

DRIVE: dict[str, Any] = {"frictionloss": 0.3, "armature": 0.1, "effort_limit": 120.0, "velocity_limit": 2.8}
FINGER: dict[str, Any] = {"frictionloss": 0.01, "armature": 1e-3, "effort_limit": 0.7, "velocity_limit": 6.0}
ANGLES = {"pan": (-0.9, 0.9, 0.0), "lift": (-1.2, 1.2, -0.35), "elbow": (0.3, 2.4, 1.95)}
ANGLES |= {"tilt": (-1.2, 1.2, 0.0), "roll": (-0.5, 0.5, 0.0)}  # least, most, at the start [rad]
arm = [
    JointSpec(name=n, lower=a, upper=b, home=c, stiffness=2000, damping=250, **DRIVE)
    for n, (a, b, c) in ANGLES.items()
]
hand = [
    JointSpec(name=n, lower=0, upper=1.5, home=0.2, stiffness=3, damping=0.1, **FINGER)
    for n in ("left", "right", "thumb")
]
noise = {"gain_range": (0.8, 1.2), "action_noise": 0.03, "action_bias": 0.01}
GROUPS = (
    JointGroup(name="arm", role="arm", joints=tuple(arm), command="relative", **noise),
    JointGroup(name="hand", role="hand", joints=tuple(hand), command="absolute", **noise),
)
fingers = tuple(FingerSpec(name=n, root=f"scoop_{n}", tip=f"scoop_{n}") for n in ("left", "right", "thumb"))
low, high = (-0.14, -0.09, -0.09), (0.05, 0.09, 0.26)  # about palm, fingers and the link behind [m]
PALM = PalmSpec(name="palm", site="scoop_palm", body="scoop_palm", fingers=fingers, lower=low, upper=high)
SCOOP = RobotSpec(
    name="scoop", mjcf=Path(__file__).with_suffix(".xml"), root="scoop_base", groups=GROUPS, palms=(PALM,)
)
scoop = WorkcellSpec(name="scoop", robots=(Placed(robot=SCOOP, pos=(0.0, 0.0, 0.81)),))


def main(out: Path = Path("runs/scoop"), transitions: int = 3_000_000, num_envs: int = 256) -> None:
    """Train it for a while, and evaluate what it has learnt."""
    result = p2c.train("catch_teacher", out, workcell=scoop, transitions=transitions, num_envs=num_envs)
    found = p2c.evaluate(out, num_envs=min(num_envs, 100), trials=1, physics_hz=240.0)
    print(f"{result.status}: reached {found['tracking_rate']:.2f}, caught {found['success_rate']:.2f}")


if __name__ == "__main__":
    tyro.cli(main)
