"""The drives of all joints: what becomes of a joint target on its way to MuJoCo's controls."""

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pixel2catch.envs.command_path import CommandPath
from pixel2catch.envs.servo import Servos, ServoState
from pixel2catch.mdp.masks import select
from pixel2catch.mdp.randomization import EpisodeParameters
from pixel2catch.robots.joint_dynamics import JointDynamics
from pixel2catch.sim.simulation import Simulation


class Drives:
    """Command path, limits, friction and gains of every joint in every environment.

    Nominal joints have no command path: in a physics step their servos aim at the command of its end, as in
    the training of the shipped policies. That is a step earlier than behind a path without latency. Their
    damping is MuJoCo's, which acts on the speed at the end of a step. Of identified joints half of it does:
    so they move as in the simulation that they were identified with, at any time step nearly alike.

    Attributes:
        effort_limit: Largest torque of each joint [N·m].
    """

    def __init__(
        self,
        simulation: Simulation,
        dynamics: JointDynamics,
        nominal: JointDynamics,
        velocity_limits: Sequence[float],
    ) -> None:
        """Take over the simulation's controls; `reset` begins.

        Args:
            simulation: What is driven.
            dynamics: Of all joints.
            nominal: What they are without an identification.
            velocity_limits: Their largest speeds [rad/s].
        """
        self._simulation = simulation
        num_joints = len(dynamics.joints)
        self._qpos = simulation.bind("qpos")[:, :num_joints]
        self._qvel = simulation.bind("qvel")[:, :num_joints]
        self._ctrl = simulation.bind("ctrl")
        self._friction = simulation.bind("qfrc_applied")[:, :num_joints]
        efforts = simulation.model.actuator_forcerange[:, 1].tolist()
        self._servos = Servos.on(simulation.device, simulation.dtype, dynamics, efforts, velocity_limits)
        self._stiffness = torch.as_tensor(dynamics.stiffness).to(self._ctrl)
        self._damping = torch.as_tensor(dynamics.damping).to(self._ctrl)
        self._command = torch.zeros_like(self._ctrl)
        self._path, self._implicit = None, 1.0
        if dynamics != nominal:
            self._path = CommandPath(dynamics, simulation.model.opt.timestep, self._command)
            self._implicit = 0.5
        self.effort_limit: Float[Tensor, " num_joints"] = self._servos.effort_limit

    def reset(
        self,
        mask: Bool[Tensor, " num_envs"],
        joint_pos: Float[Tensor, "num_envs num_joints"],
        parameters: EpisodeParameters,
    ) -> None:
        """Begin in the masked environments, with new gains, at joint positions [rad] that are the command."""
        self._command.copy_(select(mask, joint_pos, self._command))
        if self._path is not None:
            self._path.reset(mask, joint_pos)
        stiffness = self._stiffness * parameters.stiffness_scale
        damping = self._damping * parameters.damping_scale
        gainprm = self._simulation.expand("actuator_gainprm")
        biasprm = self._simulation.expand("actuator_biasprm")
        for target, value in (
            (gainprm[..., 0], stiffness),
            (biasprm[..., 1], -stiffness),
            (biasprm[..., 2], -self._implicit * damping),
        ):
            target.copy_(select(mask, value.to(target), target))

    def increment(
        self, joint_pos_target: Float[Tensor, "num_envs num_joints"], num_steps: int
    ) -> Float[Tensor, "num_envs num_joints"]:
        """How far the command moves in each of `num_steps` physics steps to the target [rad]."""
        return (joint_pos_target.to(self._command) - self._command) / num_steps

    def advance(self, increment: Float[Tensor, "num_envs num_joints"]) -> None:
        """Move the command, and set what drives the joints in the next physics step."""
        self._command.add_(increment)
        aim = self._command if self._path is None else self._path.advance(self._command)
        state = ServoState(
            joint_pos=self._qpos,
            joint_vel=self._qvel,
            stiffness=self._simulation.expand("actuator_gainprm")[..., 0],
            damping=-self._simulation.expand("actuator_biasprm")[..., 2] / self._implicit,
        )
        explicit = (1.0 - self._implicit) * state.damping / state.stiffness
        self._ctrl.copy_(self._servos.limited(aim, state) - explicit * self._qvel)
        self._friction.copy_(self._servos.friction(self._qvel))
