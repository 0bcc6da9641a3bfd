"""What a trajectory makes a simulated robot do: limits, distances, torques, and how it excites the joints."""

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from jaxtyping import Float64

from pixel2catch.envs.servo import FRICTION_SPEED
from pixel2catch.identification.checks import Check, check_recording
from pixel2catch.identification.excitation_clearance import Clearance, clearances
from pixel2catch.identification.excitation_limits import HAND
from pixel2catch.identification.fit_simulation import FIT_DT, recorded_model
from pixel2catch.identification.recording import JOINT_SPECS, Recording
from pixel2catch.identification.simulated_recording import RecorderCfg, simulated_recordings
from pixel2catch.identification.trajectory import Trajectory
from pixel2catch.robot.joint_dynamics import JointDynamics

LIMIT_TOLERANCE = 0.005
"""Excess of a position limit that counts as none [rad].

Source: ours; in the start pose two joints stand at their limits, and the pull of others moves them a little.
"""

PERFECT = RecorderCfg(noise=0.0, stall=0.0, read_period=FIT_DT)
"""Measures every physics step, without noise."""


@dataclass(frozen=True, kw_only=True)
class Fault:
    """Something that a robot must not do.

    Attributes:
        text: What it is, in words.
        joints: Whose motion should shrink.
        remedy: By which factor. Default: ours.
    """

    text: str
    joints: tuple[str, ...]
    remedy: float = 0.85


@dataclass(frozen=True, kw_only=True, eq=False)
class Assessment:
    """What a trajectory makes a simulated robot do.

    Attributes:
        recording: The motion at every physics step.
        speed: Top speed of each joint [rad/s].
        torque_share: Top torque of each joint's servo, as a share of its limit.
        clearances: Distances to the table and of the robot's parts.
        checks: Whether each joint is excited enough to tell its dynamics.
        faults: What must not be.
    """

    recording: Recording
    speed: Float64[np.ndarray, " num_joints"]
    torque_share: Float64[np.ndarray, " num_joints"]
    clearances: tuple[Clearance, ...]
    checks: tuple[Check, ...]
    faults: tuple[Fault, ...]


def assess(trajectory: Trajectory, dynamics: JointDynamics) -> Assessment:
    """Simulate a trajectory and judge it.

    The motion is simulated as in a fit, without contacts, and every step of it is then placed in the whole
    scene: as long as nothing comes near anything, contacts would change nothing.

    Args:
        trajectory: Joint targets.
        dynamics: Of the same joints.
    """
    (recording,) = simulated_recordings([trajectory], dynamics, PERFECT, np.random.default_rng(0))
    speed = np.diff(recording.q, axis=0) / FIT_DT
    near = clearances(recording.joints, recording.t_meas, recording.q)
    return Assessment(
        recording=recording,
        speed=np.abs(speed).max(axis=0),
        torque_share=_torque_share(recording, speed, dynamics),
        clearances=near,
        checks=tuple(check for check in check_recording(recording) if check.name == "excitation"),
        faults=(*_limit_faults(recording, speed), *_clearance_faults(recording.joints, near)),
    )


def _limit_faults(recording: Recording, speed: np.ndarray) -> list[Fault]:
    """Joints beyond their limits of position or speed."""
    faults = []
    for column, joint in enumerate(recording.joints):
        spec, q = JOINT_SPECS[joint], recording.q[:, column]
        excess, top = max(spec.lower - q.min(), q.max() - spec.upper), np.abs(speed[:, column]).max()
        if excess > LIMIT_TOLERANCE:
            text = f"{joint} moves {excess:.3f} rad beyond its limits"
            faults.append(Fault(text=text, joints=(joint,)))
        if top > spec.velocity_limit:
            text = f"{joint} reaches {top:.2f} rad/s of {spec.velocity_limit:.2f}"
            faults.append(Fault(text=text, joints=(joint,), remedy=0.95 * spec.velocity_limit / top))
    return faults


def _clearance_faults(joints: Sequence[str], near: Sequence[Clearance]) -> list[Fault]:
    """Parts that come too near to each other; the arm is shrunk where it moves and has a part in it."""
    faults = []
    for clearance in near:
        if not clearance.is_kept:
            moved = [joint for joint in joints if (joint in HAND) == clearance.rule.is_of_hand]
            faults.append(Fault(text=clearance.sentence(), joints=tuple(moved or joints)))
    return faults


def _torque_share(
    recording: Recording, speed: np.ndarray, dynamics: JointDynamics
) -> Float64[np.ndarray, " num_joints"]:
    """Top torque of the servos, found backwards from the motion: what moves masses and overcomes friction."""
    model = recorded_model(recording.joints, FIT_DT)
    model.dof_armature[:] = dynamics.armature
    data = mujoco.MjData(model)
    change = np.diff(speed, axis=0)
    top = np.zeros(len(recording.joints))
    for q, before, jump in zip(recording.q[1:], speed, change, strict=False):
        data.qpos[:], data.qvel[:], data.qacc[:] = q, before, jump / FIT_DT
        mujoco.mj_inverse(model, data)
        friction = dynamics.frictionloss * np.tanh(before / FRICTION_SPEED)
        top = np.maximum(top, np.abs(data.qfrc_inverse + friction))
    return top / np.array([JOINT_SPECS[joint].effort_limit for joint in recording.joints])
