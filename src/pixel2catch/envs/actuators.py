"""The actuators of all joints: command path, speed and effort limits, dry friction and gains."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from pixel2catch.batches import Flags, Joints
from pixel2catch.mdp.randomization import EpisodeParameters
from pixel2catch.mdp.tensors import write
from pixel2catch.robots.geometry import speed_to_end, travel_columns
from pixel2catch.robots.joint_dynamics import EFFORT_MARGIN, DryFriction, JointDynamics, filter_step
from pixel2catch.robots.spec import JointSpec
from pixel2catch.scene.constants import SPEED_MARGIN
from pixel2catch.sim.simulation import Simulation

FRICTION_SPEED = 0.1
"""Speed at which dry friction reaches 76 % of its value [rad/s] (ours; slow enough for an explicit step)."""


class JointActuators:
    """Command path, limits, friction and gains of every joint in every environment.

    Nominal joints have no command path: their servos follow the command of the end of each physics step, as
    in the training of the shipped policies, with MuJoCo's implicit damping and a smooth dry friction.
    Identified joints move as in `identification.simulation`: half of the damping is implicit, damping does
    not reduce a torque at its limit, and dry friction holds joints at rest.
    """

    def __init__(
        self,
        simulation: Simulation,
        dynamics: JointDynamics,
        joints: tuple[JointSpec, ...],
        *,
        limits_commands: bool = True,
    ) -> None:
        """Take over the controls of a simulation.

        Commands keep the acceleration limits of the joints, unless a servo before them does.
        """
        num_joints, nominal = len(joints), JointDynamics.of(joints)
        self._ctrl = simulation.bind("ctrl")
        self._gainprm, self._biasprm = (simulation.expand(f"actuator_{kind}prm") for kind in ("gain", "bias"))
        self._friction = simulation.bind("qfrc_applied")[:, :num_joints]
        efforts = simulation.model.actuator_forcerange[:, 1].tolist()
        numbers = (efforts, [joint.velocity_limit for joint in joints], dynamics.frictionloss)
        self.limits = ActuatorLimits(*(torch.as_tensor(each).to(self._ctrl) for each in numbers))
        self._stiffness = torch.as_tensor(dynamics.stiffness).to(self._ctrl)
        self._damping = torch.as_tensor(dynamics.damping).to(self._ctrl)
        # Copies of the present gains: in MuJoCo's parameters they are ten numbers apart, which is slower.
        self._state = ActuatorState(
            joint_pos=simulation.bind("qpos")[:, :num_joints],
            joint_vel=simulation.bind("qvel")[:, :num_joints],
            stiffness=self._stiffness.expand_as(self._ctrl).clone(),
            damping=self._damping.expand_as(self._ctrl).clone(),
        )
        self._command, self._last_vel = torch.zeros_like(self._ctrl), torch.zeros_like(self._ctrl)
        self._path, self._dry_friction, self._implicit, dt = None, None, 1.0, simulation.model.opt.timestep
        is_limited = limits_commands and any(np.isfinite([joint.acceleration_limit for joint in joints]))
        self._motion = CommandMotion(joints, dt, self._command) if is_limited else None
        if dynamics != nominal:
            self._path = CommandPath(dynamics, dt, self._command)
            friction, armature = (
                torch.as_tensor(each).to(self._command) for each in (dynamics.frictionloss, dynamics.armature)
            )
            self._dry_friction, self._implicit = DryFriction(friction, armature, self._command, dt), 0.5

    def reset(self, mask: Flags, joint_pos: Joints, parameters: EpisodeParameters) -> None:
        """Begin in the masked environments, with new gains, at joint positions [rad] as the command."""
        write(mask, joint_pos, self._command)
        self._last_vel.masked_fill_(mask[:, None], 0.0)
        if self._motion is not None:
            write(mask, joint_pos, self._motion.command)
            self._motion.velocity.masked_fill_(mask[:, None], 0.0)
        if self._path is not None and self._dry_friction is not None:
            self._path.reset(mask, joint_pos)
            self._dry_friction.bend.masked_fill_(mask[:, None], 0.0)
            write(mask, joint_pos, self._dry_friction.last)
        stiffness = self._stiffness * parameters.stiffness_scale
        damping = self._damping * parameters.damping_scale
        for target, value in (
            (self._gainprm[..., 0], stiffness),
            (self._biasprm[..., 1], -stiffness),
            (self._biasprm[..., 2], -self._implicit * damping),
            (self._state.stiffness, stiffness),
            (self._state.damping, damping),
        ):
            write(mask, value, target)

    @property
    def live(self) -> tuple[Tensor, ...]:
        """Return the tensors of the state besides the gains, one row per environment."""
        motion = () if self._motion is None else (self._motion.command, self._motion.velocity)
        state = (self._command, self._last_vel, *motion)
        if self._path is None or self._dry_friction is None:
            return state
        return (*state, *self._path.live, self._dry_friction.bend, self._dry_friction.last)

    def increment(self, joint_pos_target: Joints, num_steps: int) -> Joints:
        """Return the change of the command in each of `num_steps` physics steps to the target [rad]."""
        return (joint_pos_target.to(self._command) - self._command) / num_steps

    def advance(self, increment: Joints) -> None:
        """Move the command, and set controls and friction of the next physics step."""
        self._command.add_(increment)
        command = self._command if self._motion is None else self._motion.advance(self._command)
        aim = command if self._path is None else self._path.advance(command)
        state = self._state
        self._ctrl.copy_(self.limits.limited(aim, state))
        if self._dry_friction is None:
            self._friction.copy_(self.limits.friction(state.joint_vel))
        else:
            beyond = state.stiffness * (self.limits.led(aim, state) - self._ctrl)
            self._ctrl.sub_((1.0 - self._implicit) * state.damping / state.stiffness * state.joint_vel)
            self._friction.copy_(self._dry_friction.torque(state.joint_pos))
            self._friction.add_(self._damped_at_limit(beyond, state))

    def _damped_at_limit(self, beyond: Joints, state: "ActuatorState") -> Joints:
        """Torque that MuJoCo's damping takes from a servo at its limit in a physics step [N·m], to be added.

        The change of speed is assumed to be that of the step before. A servo whose excess over its limit
        [N·m] is smaller than that torque leaves the limit within the step.
        """
        damped = state.damping * (state.joint_vel - self._last_vel)
        self._last_vel.copy_(state.joint_vel)
        share = torch.nan_to_num(beyond / damped).clamp(0.0, 1.0)  # of the step, at the limit
        return self._implicit * damped * share * (2.0 - share)


@dataclass(frozen=True, kw_only=True)
class ActuatorState:
    """Joints and present gains of the servos, one row per environment."""

    joint_pos: Joints  #: Joint positions [rad].
    joint_vel: Joints  #: Joint speeds [rad/s].
    stiffness: Joints  #: Gain on the position error [N·m/rad].
    damping: Joints  #: Gain on the speed [N·m·s/rad].


@dataclass(frozen=True)
class ActuatorLimits:
    """Limits and friction of all joints, in joint order."""

    effort_limit: Float[Tensor, " num_joints"]  #: Largest torque [N·m].
    velocity_limit: Float[Tensor, " num_joints"]  #: Largest speed [rad/s].
    frictionloss: Float[Tensor, " num_joints"]  #: Dry friction [N·m].

    def led(self, command: Joints, state: ActuatorState) -> Joints:
        """Return the position command nearest to `command` that keeps the joint's speed limit.

        A servo whose damping d dominates moves at k / d times the distance of its command. The release uses
        its simulator's speed limit, which MuJoCo does not have.
        """
        lead = SPEED_MARGIN * self.velocity_limit * state.damping / state.stiffness
        return torch.clamp(command, state.joint_pos - lead, state.joint_pos + lead)

    def limited(self, command: Joints, state: ActuatorState) -> Joints:
        """Return the position command nearest to `command` that keeps the speed and effort limits.

        MuJoCo's `forcerange` is not used: while it clamps a force, the damping is explicit and unstable.
        """
        command = self.led(command, state)
        balance = state.joint_pos + state.damping * state.joint_vel / state.stiffness
        reach = EFFORT_MARGIN * self.effort_limit / state.stiffness
        return torch.clamp(command, balance - reach, balance + reach)

    def friction(self, joint_vel: Joints) -> Joints:
        """Return the dry friction of nominal joints [N·m], a smooth function of the speed.

        Differs: MuJoCo's `frictionloss` is a constraint, which doubles the time of a physics step.
        """
        return -self.frictionloss * torch.tanh(joint_vel / FRICTION_SPEED)


class CommandMotion:
    """Commands that keep the limits of joints with a limit of acceleration, in memory that keeps its address.

    The laws are those of `servo.laws`. Differs: the servo also limits the jerk, which delays commands by a
    part of a physics step.
    """

    def __init__(self, joints: tuple[JointSpec, ...], dt: float, command: Joints) -> None:
        speed, acceleration = np.array([(each.velocity_limit, each.acceleration_limit) for each in joints]).T
        is_limited, acceleration = np.isfinite(acceleration), np.nan_to_num(acceleration, posinf=1.0)
        numbers = {"speed": speed, "change": acceleration * dt, **travel_columns(joints, acceleration, dt)}
        self._limits = {name: torch.as_tensor(each).to(command) for name, each in numbers.items()}
        self._is_limited, self._dt = torch.as_tensor(is_limited).to(command.device), dt
        self.command, self.velocity = command.clone(), torch.zeros_like(command)

    def advance(self, wanted: Joints) -> Joints:
        """Return the command after a physics step to the wanted one [rad]; the next step overwrites it."""
        limits, command, distance = self._limits, self.command, wanted - self.command
        share = distance.abs() / (limits["change"] * self._dt)
        whole = torch.floor(torch.sqrt(2.0 * share + 0.25) - 0.5)
        speed = torch.minimum((share / (whole + 1.0) + 0.5 * whole) * limits["change"], limits["speed"])
        left = torch.where(distance < 0.0, command - limits["low_end"], limits["high_end"] - command)
        most = speed_to_end(left.clamp(min=0.0), limits["end_slope"], limits["end_base"])
        requested = torch.copysign(torch.minimum(speed, most), distance)
        low, high = self.velocity - limits["change"], self.velocity + limits["change"]
        self.velocity.copy_(torch.clamp(requested, low, high))
        moved = self.command + self.velocity * self._dt
        self.command.copy_(torch.where(self._is_limited, moved, wanted))
        return self.command


class CommandPath:
    """The command paths of all joints in all environments, in memory that keeps its address.

    Commands are linear between the ends of physics steps. A step gets their mean over a past step, which is
    exact at any latency.
    """

    def __init__(self, dynamics: JointDynamics, dt: float, command: Joints) -> None:
        share = _shares(0.5 + dynamics.command_lag(dt) / dt)
        self._share = torch.as_tensor(share).to(command)[:, None]
        self._history = command.expand(len(share), -1, -1).clone()
        self._transition = torch.as_tensor(dynamics.filter_transition(dt)).to(command)
        self._state = torch.stack((command, torch.zeros_like(command)), dim=-1)

    def reset(self, mask: Flags, joint_pos: Joints) -> None:
        """Set all past commands of the masked environments to their joints' positions [rad]."""
        self._history.copy_(torch.where(mask[:, None], joint_pos, self._history))
        at_rest = torch.stack((joint_pos, torch.zeros_like(joint_pos)), dim=-1)
        write(mask, at_rest, self._state)

    @property
    def live(self) -> tuple[Tensor, ...]:
        """Return the tensors of the state, one row per environment."""
        return self._history.movedim(0, 1), self._state

    def advance(self, command: Joints) -> Joints:
        """Return the targets of the servos in a physics step [rad] from the commands at its end [rad].

        The next step overwrites them.
        """
        self._history.copy_(torch.cat((command[None], self._history[:-1])))
        delayed = (self._share * self._history).sum(dim=0)
        filter_step(self._transition, self._state, delayed)
        return self._state[..., 0]


def _shares(age: Float[np.ndarray, " num_joints"]) -> Float[np.ndarray, "num_ages num_joints"]:
    """Return weights of commands, newest first: their mean over a step whose middle is this old [steps].

    The integral of their linear interpolation is a quadratic B-spline. The age is at least 0.5.
    """
    distance = np.abs(np.arange(int(np.ceil(age.max() + 0.5)) + 1)[:, None] - age)
    return np.where(distance < 0.5, 0.75 - distance**2, np.maximum(1.5 - distance, 0.0) ** 2 / 2)
