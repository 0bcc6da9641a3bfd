"""The joints' drives in simulation: what was identified is what a policy trains with, on both back ends."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from rollouts import HOVERING, make

from paper_robot import JOINTS
from pixel2catch.envs.actuators import (
    EFFORT_MARGIN,
    SPEED_MARGIN,
    ActuatorLimits,
    ActuatorState,
    CommandMotion,
    CommandPath,
    JointActuators,
)
from pixel2catch.envs.catch_env import CatchEnv, CatchEnvCfg
from pixel2catch.envs.world import CatchWorld
from pixel2catch.identification.recording import Recording
from pixel2catch.identification.simulation import RecordedMotion
from pixel2catch.mdp.dynamics_file import DynamicsFile, GainRanges
from pixel2catch.mdp.randomization import EpisodeParameters, RandomizationCfg, sample_parameters
from pixel2catch.mdp.sensing import SensingCfg
from pixel2catch.mdp.throws import ThrowCfg, sample_throws
from pixel2catch.methods import PROPOSED, find_method
from pixel2catch.robots.geometry import travel_columns
from pixel2catch.robots.joint_dynamics import JointDynamics, filter_step
from pixel2catch.scene.constants import CONTROL_DT
from pixel2catch.scene.scene import SceneCfg, build_model
from pixel2catch.servo.laws import limited_speed, speed_to
from pixel2catch.sim.batch import BatchSimulation
from pixel2catch.sim.simulation import Simulation
from pixel2catch.sim.warp import WarpSimulation
from pixel2catch.workcells.fr3_allegro import WORKCELLS as FR3_CELLS
from pixel2catch.workcells.ur5e_allegro import UR5E_ALLEGRO

FR3 = FR3_CELLS[0]
NOMINAL = JointDynamics.of()
HOME = np.array([joint.home for joint in JOINTS])
INWARDS = np.where(np.isclose(HOME, [joint.upper for joint in JOINTS]), -1.0, 1.0)
"""Away from the limits of joints that begin at one."""

IDENTIFIED = NOMINAL.with_values(
    stiffness=1.2 * NOMINAL.stiffness,
    damping=0.9 * NOMINAL.damping,
    frictionloss=2.0 * NOMINAL.frictionloss,
    armature=1.5 * NOMINAL.armature,
    latency=np.linspace(0.003, 0.021, 19),
    filter_gain=np.where(np.arange(19) % 2 == 0, 300.0, np.inf),
    filter_lookahead=np.where(np.arange(19) % 2 == 0, 0.1, 0.0),
)
ONE = ((1.0, 1.0),) * 19
UNCHANGED = RandomizationCfg(
    gains=GainRanges(stiffness_scale=ONE, damping_scale=ONE).of(UR5E_ALLEGRO),
    initial_joint_noise=0.0,
    mass_scale=(1.0, 1.0),
)


def parameters(num_envs: int) -> EpisodeParameters:
    """Every joint at home, every factor 1."""
    generator = torch.Generator().manual_seed(0)
    return sample_parameters(UNCHANGED, SensingCfg(), torch.zeros(19), torch.tensor([0]), num_envs, generator)


def targets(num_steps: int) -> np.ndarray:
    """A target of all joints for every control step, (num_steps, 19) [rad], as float32 knows them."""
    frequency = 0.5 + 0.1 * (np.arange(19) % 7)
    time = CONTROL_DT * np.arange(num_steps)[:, None]
    motion = 0.04 * (1.5 - np.cos(2 * np.pi * frequency * time))
    motion += np.random.default_rng(0).uniform(-0.01, 0.01, motion.shape)
    return (HOME + INWARDS * motion).astype(np.float32).astype(float)


def still_world(scene: SceneCfg, dynamics: JointDynamics, num_envs: int = 1) -> CatchWorld:
    """The world of the environment at the beginning of an episode."""
    world = CatchWorld(scene, dynamics, num_envs=num_envs, device="cpu")
    begin(world, torch.ones(num_envs, dtype=torch.bool))
    return world


def begin(world: CatchWorld, mask: torch.Tensor) -> None:
    throw = sample_throws(ThrowCfg(), len(mask), torch.Generator().manual_seed(0))
    world.reset(mask, parameters(len(mask)), throw)
    world.simulation.forward(mask)


def world_path(scene: SceneCfg, dynamics: JointDynamics, targets: np.ndarray) -> np.ndarray:
    """Joint positions at the ends of control steps in the world of the environment, (num_steps, 19) [rad]."""
    world, path = still_world(scene, dynamics), []
    for target in targets:
        world.run(torch.tensor(target, dtype=torch.float32)[None])
        path.append(world.simulation.bind("qpos")[0, :19].numpy().copy())
    return np.stack(path)


def recorded_path(scene: SceneCfg, dynamics: JointDynamics, targets: np.ndarray) -> np.ndarray:
    """The same by the simulation of a recording whose commands are the ramp, sampled densely."""
    dt, dense = scene.physics_dt, 16
    knots, knot_times = np.concatenate((HOME[None], targets)), CONTROL_DT * np.arange(len(targets) + 1)
    t_cmd = dt / dense * np.arange(len(targets) * scene.decimation * dense)
    middles = t_cmd + dt / dense / 2
    q_cmd = np.stack([np.interp(middles, knot_times, knots[:, j]) for j in range(19)], axis=-1)
    recording = Recording(
        joints=NOMINAL.joints, t_cmd=t_cmd, q_cmd=q_cmd, t_meas=knot_times, q=np.tile(HOME, (len(knots), 1))
    )
    return RecordedMotion([recording], dt).simulate([dynamics])[0]


@pytest.mark.parametrize("physics_hz", [120.0, 240.0])
def test_one_law_in_the_environment_and_in_the_fit(physics_hz):
    """Within 5 µrad, at motions of 0.1 rad: what remains is the sampling of the ramp."""
    scene, ramp = SceneCfg(physics_hz=physics_hz), targets(45)
    fit = recorded_path(scene, IDENTIFIED, ramp)
    environment = world_path(scene, IDENTIFIED, ramp)[-len(fit) :]
    assert np.ptp(environment, axis=0).min() > 0.03
    np.testing.assert_allclose(environment, fit, atol=5e-6)


def test_one_law_at_the_torque_limits():
    """Jumps there and back, at whose beginnings the arm's joints have no more than their torque."""
    scene = SceneCfg(physics_hz=600.0)
    jumps = HOME + np.where(np.arange(19) < 6, INWARDS * 0.25, 0.0) * (np.arange(36)[:, None] // 9 % 2)
    dynamics = IDENTIFIED.with_values(filter_gain=np.inf, filter_lookahead=0.0)
    fit = recorded_path(scene, dynamics, jumps)[:, :6]
    environment = world_path(scene, dynamics, jumps)[-len(fit) :, :6]
    assert np.ptp(environment, axis=0).min() > 0.1
    assert np.sqrt(((environment - fit) ** 2).mean(axis=0)).max() < 1.5e-3


def rollout(simulation: Simulation, ramp: np.ndarray) -> torch.Tensor:
    """Joint positions after every physics step of a ramp, two steps to a target, in both copies."""
    qpos, drives = simulation.bind("qpos"), JointActuators(simulation, IDENTIFIED, JOINTS)
    qpos[:, :19] = torch.tensor(HOME).to(qpos)
    everywhere = torch.ones(2, dtype=torch.bool)
    drives.reset(everywhere, qpos[:, :19].clone(), parameters(2))
    simulation.forward()
    path = []
    for target in ramp:
        increment = drives.increment(torch.tensor(target).expand(2, -1).to(qpos), 2)
        for _ in range(2):
            drives.advance(increment)
            simulation.step()
            path.append(qpos[:, :19].double().clone())
    return torch.stack(path)


def test_both_back_ends_agree():
    """Within 20 µrad over 60 steps, as in nominal motion: float64 against float32."""
    model = build_model(SceneCfg())
    model.dof_frictionloss[:19] = 0.0
    back_ends = BatchSimulation(model, 2), WarpSimulation(model, 2, "cpu")
    batch, warp = (rollout(simulation, targets(30)) for simulation in back_ends)
    torch.testing.assert_close(batch, warp, atol=2e-5, rtol=0)
    assert (batch[-1] - batch[0]).abs().min() > 1e-3


def test_a_file_of_some_joints_leaves_the_others_nominal():
    """Armature in the model, with all that follows from it; gains at the next episode, in their ranges."""
    arm = IDENTIFIED.select(NOMINAL.joints[:6])
    gains = GainRanges(stiffness_scale=ONE, damping_scale=ONE)
    task = CatchEnvCfg().with_dynamics(DynamicsFile(dynamics=arm, gains=gains))
    env = CatchEnv(task, PROPOSED, num_envs=2)
    model, nominal = env.world.simulation.model, build_model(SceneCfg())
    expected = np.concatenate((arm.armature, NOMINAL.armature[6:]))
    np.testing.assert_array_equal(model.dof_armature[:19], expected)
    np.testing.assert_allclose(model.dof_M0[:19] - nominal.dof_M0[:19], expected - NOMINAL.armature)
    stiffness = env.world.simulation.expand("actuator_gainprm")[..., 0]
    expected = torch.tensor(np.concatenate((arm.stiffness, NOMINAL.stiffness[6:])))
    torch.testing.assert_close(stiffness, expected.expand(2, -1))


def test_a_new_episode_does_not_feel_the_last_one():
    """With latency and filters, joints at rest at the start pose stay there: nothing old is on its way."""
    world = still_world(SceneCfg(), IDENTIFIED, num_envs=2)
    target = torch.tensor(HOME + INWARDS * 0.2).float().expand(2, -1)
    for _ in range(3):
        world.run(target)
    begin(world, torch.tensor((True, False)))
    world.run(torch.stack((torch.tensor(HOME).float(), target[1])))
    moved = (world.joint_pos - torch.tensor(HOME)).abs()
    assert moved[0, :6].max() < 1e-5
    assert moved[1, :6].min() > 0.02


DT = 1.0 / 240.0
NUM_STEPS, HOLD = 40, 8
TIMES = DT * np.arange(NUM_STEPS + 1)
DIRECT = JointDynamics.of().select(("elbow_joint", "index_joint_1"))
FILTERED = DIRECT.with_values(filter_gain=[300.0, 200.0], filter_lookahead=[0.1, 0.08])


def ramps() -> np.ndarray:
    """Commands (num_steps + 1, 2) at the edges of steps: first at rest, then a new ramp every eight steps."""
    knots = np.random.default_rng(5).uniform(-1.0, 1.0, (NUM_STEPS // HOLD, 2))
    knots = np.concatenate((np.zeros((1, 2)), knots))
    return np.stack([np.interp(TIMES, TIMES[::HOLD], knots[:, j]) for j in range(2)], axis=-1)


def passed(dynamics: JointDynamics, commands: np.ndarray) -> np.ndarray:
    """What arrives in every step of commands at the edges of steps, (num_steps, 2)."""
    path = CommandPath(dynamics, DT, torch.zeros(1, 2, dtype=torch.float64))
    path.reset(torch.ones(1, dtype=torch.bool), torch.zeros(1, 2, dtype=torch.float64))
    return np.stack([path.advance(torch.tensor(row)[None])[0].numpy().copy() for row in commands[1:]])


@pytest.mark.parametrize("latency", [(0.0, 0.3 * DT), (0.0123, 0.05), (DT, 3 * DT)])
def test_what_arrives_is_the_mean_of_the_delayed_ramp_over_the_step(latency):
    """At any latency: against a fine sum over every step."""
    dynamics = DIRECT.with_values(latency=np.array(latency))
    arrived, commands, lag = passed(dynamics, ramps()), ramps(), dynamics.command_lag(DT)
    fine = (np.arange(2000) + 0.5) / 2000 * DT
    for j in range(2):
        sent = TIMES[:-1, None] + fine - lag[j]
        mean = np.interp(sent, TIMES, commands[:, j]).mean(axis=1)
        np.testing.assert_allclose(arrived[:, j], mean, atol=1e-6)


def test_step_response_of_the_filter_is_the_analytic_one():
    """A damped oscillator, ω² = gain and 2ζω = gain · lookahead, from rest to 1."""
    transition = torch.tensor(FILTERED.filter_transition(DT))
    state, goal, path = torch.zeros(1, 2, 2, dtype=torch.float64), torch.ones(1, 2, dtype=torch.float64), []
    for _ in range(NUM_STEPS):
        filter_step(transition, state, goal)
        path.append(state[0].numpy().copy())
    decay = FILTERED.filter_gain * FILTERED.filter_lookahead / 2
    omega = np.sqrt(FILTERED.filter_gain - decay**2)
    time = TIMES[1:, None]
    wave = np.exp(-decay * time) * (np.cos(omega * time) + decay / omega * np.sin(omega * time))
    speed = np.exp(-decay * time) * FILTERED.filter_gain / omega * np.sin(omega * time)
    np.testing.assert_allclose(np.stack(path)[..., 0], 1.0 - wave, atol=1e-12)
    np.testing.assert_allclose(np.stack(path)[..., 1], speed, atol=1e-12)


def test_simulated_commands_keep_the_limits_as_the_servo_does():
    """Equal to the servo's laws, near an end of the travel and to the stop at the goal.

    A joint without a limit follows at once.
    """
    joint = replace(FR3.joints[3], travel=(-0.5, 2.5, 4.0, 0.3))
    motion = CommandMotion((joint, FR3.joints[7]), DT, torch.zeros(1, 2).double())
    columns = travel_columns([joint], np.array([10.0]), DT)
    law = SimpleNamespace(**{name: float(each[0]) for name, each in columns.items()}, speed=2.62)
    law.change, law.bend, law.lower, law.upper = 10.0 * DT, 10.0 * DT**2, -9.0, 9.0
    position, velocity = 0.0, 0.0
    goals = np.concatenate((np.full((240, 2), -0.6), ramps(), np.full((240, 2), 0.4)))
    for goal in goals:
        velocity = limited_speed(position, velocity, speed_to(position, goal[0], law), law)
        position += velocity * DT
        found = motion.advance(torch.tensor(goal)[None])[0].numpy()
        np.testing.assert_allclose(found, (position, goal[1]), atol=1e-12)
        assert position > law.low_end
    assert (position, velocity) == pytest.approx((0.4, 0.0), abs=1e-9)


def test_the_fr3_accelerates_within_its_limit():
    """A jump of the target; in a new episode, commands are at rest."""
    env = CatchEnv(CatchEnvCfg().with_workcell(FR3), find_method("proposed", FR3), num_envs=2)
    env.reset()
    world, home = env.world, env.world.joint_pos.clone()
    target, path = home + 0.3, []
    for _ in range(4):
        world.run(target)
        path.append(world.joint_pos[0, 0] - home[0, 0])
    assert 0.0 < path[0] < 0.5 * 10.0 * CONTROL_DT**2
    assert 0.0 < path[3] < 0.5 * 10.0 * (4 * CONTROL_DT) ** 2
    env.reset()
    begun = world.joint_pos.clone()
    world.run(begun)
    assert (world.joint_pos - begun)[:, :7].abs().max() < 1e-3


SPEED_LIMIT = 2.79253
SERVOS = ActuatorLimits(
    torch.tensor([joint.effort_limit for joint in JOINTS], dtype=torch.float64),
    torch.tensor([joint.velocity_limit for joint in JOINTS], dtype=torch.float64),
    torch.tensor(JointDynamics.of().frictionloss),
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
