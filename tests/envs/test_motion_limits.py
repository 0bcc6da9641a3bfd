"""Speed and effort limits: laws of the servos, and what policies of any kind can make the joints do."""

import math

import torch
from hypothesis import given
from hypothesis import strategies as st
from rollouts import HOVERING, make

from paper_robot import JOINTS
from pixel2catch.envs.actuators import (
    EFFORT_MARGIN,
    FRICTION_SPEED,
    SPEED_MARGIN,
    ActuatorLimits,
    ActuatorState,
)
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


def random_state(seed: int, speed: float = 1.0) -> tuple[torch.Tensor, ActuatorState]:
    """A command and joints anywhere, at speeds up to a share of the limits, with randomised gains."""
    generator = torch.Generator().manual_seed(seed)

    def draw(low: float, high: float) -> torch.Tensor:
        return low + (high - low) * torch.rand(5, len(JOINTS), generator=generator, dtype=torch.float64)

    pos = draw(-3.0, 3.0)
    state = ActuatorState(
        joint_pos=pos,
        joint_vel=speed * draw(-1.0, 1.0) * SERVOS.velocity_limit,
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
    command, state = random_state(seed, speed=0.0)
    lead = SERVOS.limited(command, state) - state.joint_pos
    speed = state.stiffness / state.damping * lead
    assert (speed.abs() <= SPEED_MARGIN * SERVOS.velocity_limit * (1 + 1e-9)).all()


@given(SEEDS, st.floats(0.0, 1.0))
def test_a_command_that_keeps_the_limits_is_left_alone(seed, share):
    _, state = random_state(seed, speed=0.0)
    lead = SPEED_MARGIN * SERVOS.velocity_limit * state.damping / state.stiffness
    reach = EFFORT_MARGIN * SERVOS.effort_limit / state.stiffness
    command = state.joint_pos + share * torch.minimum(lead, reach)
    torch.testing.assert_close(SERVOS.limited(command, state), command)


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


def test_bang_bang_actions_keep_the_limits_in_free_motion():
    """Until the robot touches something, for 2 s; a contact's impulse is not the servos' to limit."""
    env = make(16, seed=4, method="single_agent", throws=HOVERING)
    phases = torch.arange(len(JOINTS))
    speed, share, num_free = 0.0, 0.0, 0
    for step in range(60):
        wave = torch.sin(2.0 * math.pi * step / torch.arange(2, env.num_envs + 2)[:, None] + phases)
        result = env.step({"robot": torch.where(wave >= 0.0, 1.0, -1.0)})
        record, log = result.record, result.log
        is_free = ~(record.is_self_contact | record.is_table_contact | record.is_hand_contact)
        num_free += int(is_free.sum())
        speed = max(speed, torch.where(is_free, log.joint_speed, 0.0).max().item())
        share = max(share, torch.where(is_free, log.torque_share, 0.0).max().item())
    assert num_free > 200
    assert 0.5 < speed < SPEED_LIMIT
    assert share <= 1.0
