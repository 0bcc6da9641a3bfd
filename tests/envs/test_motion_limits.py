"""Speed and effort limits: laws of the servos, and what policies of any kind can make the joints do."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from paper_robot import JOINTS
from pixel2catch.envs.actuators import (
    EFFORT_MARGIN,
    FRICTION_SPEED,
    SPEED_MARGIN,
    ActuatorLimits,
    ActuatorState,
)
from pixel2catch.envs.catch_env import CatchEnv, CatchEnvCfg
from pixel2catch.mdp.throws import ThrowCfg
from pixel2catch.methods import METHODS
from pixel2catch.robots.joint_dynamics import JointDynamics

SPEED_LIMIT = 2.79253
SERVOS = ActuatorLimits(
    torch.tensor([joint.effort_limit for joint in JOINTS], dtype=torch.float64),
    torch.tensor([joint.velocity_limit for joint in JOINTS], dtype=torch.float64),
    torch.tensor(JointDynamics.nominal().frictionloss),
)
STIFFNESS = torch.tensor([joint.stiffness for joint in JOINTS], dtype=torch.float64)
DAMPING = torch.tensor([joint.damping for joint in JOINTS], dtype=torch.float64)
SEEDS = st.integers(0, 2**31)


def random_state(seed: int) -> tuple[torch.Tensor, ActuatorState]:
    """A command and joints anywhere, at speeds within the limits, with randomised gains."""
    generator = torch.Generator().manual_seed(seed)

    def draw(low: float, high: float) -> torch.Tensor:
        return low + (high - low) * torch.rand(5, len(JOINTS), generator=generator, dtype=torch.float64)

    pos = draw(-3.0, 3.0)
    state = ActuatorState(
        joint_pos=pos,
        joint_vel=draw(-1.0, 1.0) * SERVOS.velocity_limit,
        stiffness=STIFFNESS * draw(0.7, 1.3),
        damping=DAMPING * draw(0.7, 1.3),
    )
    return pos + draw(-2.0, 2.0), state


def torque(command: torch.Tensor, state: ActuatorState) -> torch.Tensor:
    return state.stiffness * (command - state.joint_pos) - state.damping * state.joint_vel


@given(SEEDS)
def test_torque_of_a_limited_command_is_within_the_effort_limit(seed):
    command, state = random_state(seed)
    limited = torque(SERVOS.limited(command, state), state)
    assert (limited.abs() <= EFFORT_MARGIN * SERVOS.effort_limit * (1 + 1e-9)).all()


@given(SEEDS)
def test_steady_speed_of_a_limited_command_is_within_the_speed_limit(seed):
    """At rest, where effort does not bind further out, k / d times the distance is the speed that follows."""
    command, state = random_state(seed)
    at_rest = ActuatorState(**{**vars(state), "joint_vel": torch.zeros_like(state.joint_vel)})
    lead = SERVOS.limited(command, at_rest) - state.joint_pos
    speed = state.stiffness / state.damping * lead
    assert (speed.abs() <= SPEED_MARGIN * SERVOS.velocity_limit * (1 + 1e-9)).all()


@given(SEEDS, st.floats(0.0, 1.0))
def test_a_command_that_keeps_the_limits_is_left_alone(seed, share):
    _, state = random_state(seed)
    at_rest = ActuatorState(**{**vars(state), "joint_vel": torch.zeros_like(state.joint_vel)})
    lead = SPEED_MARGIN * SERVOS.velocity_limit * state.damping / state.stiffness
    reach = EFFORT_MARGIN * SERVOS.effort_limit / state.stiffness
    command = state.joint_pos + share * torch.minimum(lead, reach)
    torch.testing.assert_close(SERVOS.limited(command, at_rest), command)


@given(SEEDS)
def test_friction_opposes_motion_and_is_bounded(seed):
    _, state = random_state(seed)
    friction = SERVOS.friction(state.joint_vel)
    assert (friction * state.joint_vel <= 0.0).all()
    assert (friction.abs() <= SERVOS.frictionloss).all()
    torch.testing.assert_close(SERVOS.friction(-state.joint_vel), -friction)


def test_friction_by_hand():
    speed = torch.full((1, len(JOINTS)), FRICTION_SPEED, dtype=torch.float64)
    torch.testing.assert_close(SERVOS.friction(speed)[0], -math.tanh(1.0) * SERVOS.frictionloss)
    assert not SERVOS.friction(0.0 * speed).any()


def actions(kind: str, step: int, num_envs: int, generator: torch.Generator) -> torch.Tensor:
    """Random, bang-bang or sinusoidal actions of all joints, other ones in each environment."""
    if kind == "random":
        return 2.0 * torch.rand(num_envs, len(JOINTS), generator=generator) - 1.0
    period = torch.arange(2, num_envs + 2)[:, None]
    wave = torch.sin(2.0 * math.pi * step / period + torch.arange(len(JOINTS)))
    return wave if kind == "sinusoidal" else torch.where(wave >= 0.0, 1.0, -1.0)


@pytest.mark.parametrize("kind", ["bang-bang"])
def test_no_policy_breaks_the_limits_in_free_motion(kind):
    """Until the robot touches something, for 2 s; a contact's impulse is not the servos' to limit."""
    env = CatchEnv(
        CatchEnvCfg(throws=ThrowCfg(hover_steps=(80, 80))), METHODS["single_agent"], num_envs=16, seed=4
    )
    generator = torch.Generator().manual_seed(0)
    speed, share, num_free = 0.0, 0.0, 0
    for step in range(60):
        result = env.step({"robot": actions(kind, step, env.num_envs, generator)})
        is_free = ~(
            result.record.is_self_contact | result.record.is_table_contact | result.record.is_hand_contact
        )
        num_free += int(is_free.sum())
        speed = max(speed, torch.where(is_free, result.log.joint_speed, 0.0).max().item())
        share = max(share, torch.where(is_free, result.log.torque_share, 0.0).max().item())
    assert num_free > 200
    assert 0.5 < speed < SPEED_LIMIT
    assert share <= 1.0
