"""Speeds and stops of a simulated arm under the servo's limits."""

from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from servo_rows import HOME, LIMITS, Lab, given

from pixel2catch.envs.cfg import CatchEnvCfg
from pixel2catch.robots.joint_dynamics import JointDynamics
from pixel2catch.servo.limits import STOP_TIME, JointLimits
from pixel2catch.servo.link import Fault
from pixel2catch.twin.simulated_lab import SimulatedLab
from pixel2catch.workcells.ur5e_allegro import UR5E_ALLEGRO

PHYSICS_HZ = 510.0
"""A tick of the servo is a step of the physics; it must be a multiple of the control rate."""

FASTEST = 3.14  #: Speed limit of a UR5e's joints [rad/s]; its specification here has 2.79.
SPUN_OUT = 14  #: Ticks in which motion from before a stop still accelerates joints.
SWING = np.array([0.5, 0.3, 0.3, 0.5, 0.5])
"""Swing to each side of the start pose [rad]; no joint reaches the end of its travel."""


class PhysicalLab(Lab):
    """A lab whose robot is simulated."""

    def __init__(self, robot: SimulatedLab, joints: JointLimits) -> None:
        super().__init__(limits=replace(LIMITS, joints=joints, dt=1.0 / PHYSICS_HZ))
        self._robot = robot
        self.joint_pos[0] = self.target[0] = robot.joints.position
        self.speeds: list[np.ndarray] = []

    def follow(self, command: np.ndarray) -> None:
        self._robot.step(command[0])
        self.joint_pos[0] = self._robot.joints.position
        self.speeds.append(self._robot.joints.velocity[:5])


@contextmanager
def physical_lab(lag: float | None, share: float = 1.0, is_identified: bool = True) -> Iterator[PhysicalLab]:
    """Return a running lab with a lag, nominal if absent, which is in the limits if it is identified."""
    nominal = dynamics = JointDynamics.nominal()
    if lag is not None:
        dynamics = nominal.with_values(stiffness=nominal.damping / lag)
    task = replace(CatchEnvCfg(), dynamics=dynamics)
    task = replace(task, scene=replace(task.scene, physics_hz=PHYSICS_HZ))
    known = dynamics if is_identified else nominal
    with closing(SimulatedLab(task, seed=0)) as robot:
        joints = JointLimits.of(UR5E_ALLEGRO, share, known, is_identified=is_identified)
        lab = PhysicalLab(robot, joints)
        lab.started()
        yield lab


def check_swings(lab: PhysicalLab, share: float) -> None:
    """Swing from side to side at the largest speed, and stop in the middle.

    Two faults are allowed: torque limits keep an arm with a short lag from following, and a swing moves
    fingers with a long lag.
    """
    for swing in range(4):
        lab.target[0, :5] = HOME[:5] + (SWING if swing % 2 else -SWING)
        lab.run(0.3 if swing < 3 else 0.15)
    first = len(lab.speeds) + SPUN_OUT
    lab.tick(given(is_stop_requested=np.array([True])))
    lab.run(STOP_TIME)
    assert np.abs(lab.speeds).max() < share * FASTEST
    assert np.abs(lab.speeds[-1]).max() < 0.1
    if lab.outputs[-1]["stopped_by"] & Fault.STOP_REQUEST:
        assert np.abs(lab.speeds).max() > 0.6 * share * FASTEST
        stop = np.diff(lab.speeds[first:], axis=0) * PHYSICS_HZ
        assert np.abs(stop).max() < 2.0 * lab.limits.joints.deceleration[0]
    else:
        stops = Fault.TRACKING_ERROR | Fault.JOINTS_IMPLAUSIBLE | Fault.HAND_ASTRAY
        assert any(output["stopped_by"] & stops for output in lab.outputs)


LAGS = ((0.02, True), *product((0.06, 0.1, 0.14), (True, False)))


@pytest.mark.parametrize(
    ("lag", "is_identified", "share"),
    [
        (None, True, 1.0),
        *(pytest.param(*lag, share, marks=pytest.mark.slow) for lag in LAGS for share in (1.0, 0.25)),
    ],
)
def test_a_swing_and_a_stop_at_any_lag(lag: float | None, is_identified: bool, share: float):
    with physical_lab(lag, share, is_identified=is_identified) as lab:
        check_swings(lab, share)
        assert lag or lab.outputs[-1]["stopped_by"] == Fault.STOP_REQUEST
