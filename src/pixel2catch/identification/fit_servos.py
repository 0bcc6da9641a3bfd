"""Servos and command filters of simulated recordings, as NumPy arrays of all copies at once.

NumPy does in a few microseconds what takes PyTorch tens, and a fit is many steps of few copies. Arrays are of
shape (num_copies, num_joints); in every step their shapes are left unchecked.
"""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float

from pixel2catch.envs.command_path import filtered
from pixel2catch.envs.servo import EFFORT_MARGIN, FRICTION_SPEED
from pixel2catch.identification.recording import JOINT_SPECS
from pixel2catch.robot.joint_dynamics import JointDynamics, filter_transition
from pixel2catch.sim.batch import BatchSimulation


class Servos:
    """The servos of all copies: those of `envs/servo.py` in the limit of short time steps.

    MuJoCo's implicit damping acts on the speed at the end of a step, as if the armature were larger by
    damping · dt / 2, which for the arm is as much as the armature itself. So half of it is implicit here,
    which is the trapezoidal rule, and a servo that stays at its torque limit is a torque alone. What
    is identified then hardly depends on the time step.
    """

    def __init__(
        self,
        simulation: BatchSimulation,
        dynamics: Sequence[JointDynamics],
        link_inertia: Float[np.ndarray, " num_joints"],
        dt: float,
    ) -> None:
        """Give every copy of the simulation its dynamics.

        Args:
            simulation: The copies.
            dynamics: Of each.
            link_inertia: What a joint moves beside its armature [kg·m²].
            dt: Time step [s].
        """
        self._stiffness, self._damping, self._friction, armature = (
            np.stack([getattr(each, name) for each in dynamics])
            for name in ("stiffness", "damping", "frictionloss", "armature")
        )
        self._dt, self._half, self._inertia = dt, self._damping / 2, armature + link_inertia
        self._limit = EFFORT_MARGIN * np.array(
            [JOINT_SPECS[name].effort_limit for name in dynamics[0].joints]
        )
        simulation.expand("dof_armature").numpy()[:] = armature
        simulation.expand("actuator_gainprm").numpy()[:, :, 0] = self._stiffness
        bias = simulation.expand("actuator_biasprm").numpy()
        bias[:, :, 1] = -self._stiffness
        self._bias = bias[:, :, 2]
        self._ctrl, self._applied, self._qpos, self._qvel = (
            simulation.bind(name).numpy() for name in ("ctrl", "qfrc_applied", "qpos", "qvel")
        )

    def drive(self, first: np.ndarray, last: np.ndarray, share: np.ndarray) -> None:
        """Set what drives the joints in the next step.

        Args:
            first: The target with which the step begins [rad].
            last: The target with which it ends [rad].
            share: The share of the step in which the first one holds.
        """
        resting = self._stiffness * self._qpos + self._damping * self._qvel
        (before, time_before), (after, time_after) = (
            self._limited(self._stiffness * target - resting) for target in (first, last)
        )
        is_at_limit = (np.minimum(time_before, time_after) >= self._dt) & (before * after > 0.0)
        torque = np.where(is_at_limit, np.copysign(self._limit, after), after + share * (before - after))
        implicit = np.where(is_at_limit, 0.0, self._half)
        self._bias[:] = -implicit
        self._ctrl[:] = self._qpos + (torque + implicit * self._qvel) / self._stiffness
        self._applied[:] = -self._friction * np.tanh(self._qvel / FRICTION_SPEED)

    def _limited(self, torque: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Mean torque of a step in which an unlimited servo would begin with one, and the time at the limit.

        There the joint accelerates at the limit until damping has brought the servo below it, and follows the
        trapezoidal rule from then on. The result gives the same speed at the end of the step.
        """
        excess = np.maximum(np.abs(torque) - self._limit, 0.0)
        at_limit = np.minimum(excess / (self._limit * self._damping) * self._inertia, self._dt)
        rest = self._dt - at_limit
        gain = at_limit / self._inertia + rest / (self._inertia + self._half * rest)
        mean = self._limit * gain * (self._inertia / self._dt + self._half)
        return np.where(excess > 0.0, np.copysign(mean, torque), torque), at_limit


class Filters:
    """The command filters of all copies; nothing where no joint has one."""

    def __init__(
        self,
        dt: float,
        start: Float[np.ndarray, "2 num_copies num_joints"],
        dynamics: Sequence[JointDynamics],
    ) -> None:
        """Begin with positions and speeds of the joints."""
        self._transition = torch.from_numpy(np.stack([filter_transition(each, dt) for each in dynamics]))
        self._state = torch.from_numpy(np.moveaxis(start, 0, -1).copy())
        self._is_there = any(each.has_filter.any() for each in dynamics)

    def advance(self, command: np.ndarray) -> np.ndarray:
        """What the servos aim at in a step with a command [rad]."""
        if not self._is_there:
            return command
        self._state = filtered(self._transition, self._state, torch.from_numpy(command))
        return self._state[..., 0].numpy()
