"""The environment as a whole: beginnings, endings, throws, sensing and repeatability."""

from dataclasses import replace

import pytest
import torch
from rollouts import AT_ONCE, EXACT, HOVERING, after, make, object_path, object_pos, rollout
from torch import Tensor

from paper_robot import JOINTS
from pixel2catch.camera.pinhole import nominal_projection
from pixel2catch.envs.catch_env import STAGGER_STEPS, CatchEnv, CatchEnvCfg
from pixel2catch.envs.tasks import find_task
from pixel2catch.errors import InvalidValueError
from pixel2catch.mdp.sensing import detect
from pixel2catch.mdp.tensors import clone
from pixel2catch.mdp.terminations import HOLD_STEPS, EpisodeCfg
from pixel2catch.mdp.throws import ThrowCfg
from pixel2catch.methods import find_method
from pixel2catch.robots.joint_dynamics import JointDynamics
from pixel2catch.scene.constants import CONTROL_DT, RGB_CAMERA
from pixel2catch.scene.objects import OBJECTS
from pixel2catch.scene.scene import SceneCfg

OBJECT = slice(len(JOINTS), len(JOINTS) + 7)
CAMERA = nominal_projection(RGB_CAMERA, torch.zeros(1))
THROWN = ThrowCfg(hover_steps=(1, 1))


def move_object(env: CatchEnv, row: int, pos: Tensor) -> None:
    """Put one object at rest somewhere, between two control steps."""
    simulation = env.world.simulation
    simulation.bind("qpos")[row, OBJECT.start : OBJECT.start + 3] = pos.to(simulation.dtype)
    simulation.bind("qvel")[row, OBJECT.start : OBJECT.start + 6] = 0.0
    simulation.forward()


def test_a_stagger_lasts_one_episode():
    """The next objects hover as long as the task says."""
    env = make(32, throws=ThrowCfg(hover_steps=(3, 3)), episode=EpisodeCfg(max_steps=6))
    env.reset(is_staggered=True)
    hovering = env.episode.throw.hover_steps.clone()
    assert hovering.min() >= 3
    assert 20 < hovering.max() <= 3 + STAGGER_STEPS
    list(rollout(env, 6))
    assert env.episode.throw.hover_steps.tolist() == [3] * 32


def test_a_drop_ends_and_resets_only_its_environment():
    env = make(3, throws=HOVERING)
    list(rollout(env, 3))
    before = env.world.joint_pos
    move_object(env, 1, torch.tensor([1.0, 0.0, 0.3]))
    step = next(rollout(env, 1))
    assert step.terminated.tolist() == [False, True, False]
    assert step.record.is_dropped.tolist() == [False, True, False]
    assert step.record.steps.tolist() == [4, 4, 4]
    assert object_pos(env)[1, 0] > 2.0  # a new throw waits at its release point
    moved = (env.world.joint_pos - before)[:, :6].abs().amax(dim=-1)
    assert moved[1] > 0.02  # another start pose
    assert moved[[0, 2]].max() < 0.02
    later = next(rollout(env, 1))
    assert later.record.steps.tolist() == [5, 1, 5]
    assert not later.terminated.any()


def test_a_diverged_environment_starts_again_and_leaves_no_nan_behind(monkeypatch):
    env = make(3, throws=HOVERING)
    list(rollout(env, 3))
    step = env.world.simulation.step

    def diverge(mask=None) -> None:
        step(mask)
        for field in ("qvel", "site_xpos", "sensordata", "actuator_force"):
            env.world.simulation.bind(field)[1] = torch.nan

    monkeypatch.setattr(env.world.simulation, "step", diverge)
    diverged = next(rollout(env, 1))
    assert diverged.terminated.tolist() == [False, True, False]
    assert diverged.record.is_dropped.tolist() == [False, True, False]
    monkeypatch.undo()
    later = next(rollout(env, 1))
    for each in (diverged, later):
        parts = [*each.observation.policy.values(), each.observation.state, *each.rewards.values()]
        assert all(part.isfinite().all() for part in parts)
    assert env.statistics.pop()["diverged"] == 1.0


def test_what_a_reset_environment_sees_is_new():
    """Both frames of the first observation are equal; differences and last actions are zero."""
    env = make(2, throws=HOVERING, episode=EpisodeCfg(max_steps=5))
    *_, last = rollout(env, 5, action=0.5)
    assert last.terminated.all()
    for agent, width in (("arm", 25), ("hand", 39)):
        older, newer = last.observation.policy[agent].split(width, dim=-1)
        assert torch.equal(older, newer)
        assert not newer[:, 2:6].any()
        assert not newer[:, 13 + env.action_sizes[agent] :].any()
    assert (last.measurement.joint_pos_target - env.world.joint_pos).abs().max() < 1e-6
    commanded = last.joint_pos_target
    assert (commanded - last.measurement.joint_pos_target).abs().max() > 0.1


def test_an_object_held_for_twenty_steps_is_a_success_at_exactly_that_step():
    """Environment 0 holds at once, 1 loses the object after ten steps for one, 2 never reaches it."""
    env = make(3, throws=HOVERING, objects=("cube_s",))
    ended, rewards = {}, {}
    for number in range(1, 36):
        truth = env.world.privileged(env.world.quiet_log())
        reach = truth.palm_pos[:, 0] + torch.tensor([0.0104, 0.0, 0.0489])  # 5 cm along the palm's normal
        move_object(env, 0, reach[0])
        move_object(env, 1, reach[1] + (number == 11) * torch.tensor([0.5, 0.0, 0.0]))
        step = next(rollout(env, 1))
        for row in step.terminated.nonzero()[:, 0].tolist():
            ended.setdefault(row, number)
            assert step.record.is_success[row]
        rewards[number] = step.rewards["arm"].clone()
    assert ended == {0: HOLD_STEPS, 1: 11 + HOLD_STEPS}
    assert rewards[20][0] > 9.5
    assert max(rewards[number][0] for number in range(2, 20)) < 1.0


def test_objects_hover_and_then_fly_to_where_they_are_aimed():
    """They are still until they are thrown, and come down within 5 mm."""
    env = make(8)
    throw = clone(env.episode.throw)
    path = object_path(env, 60)
    distance = (path - path[0]).norm(dim=-1)
    for row, steps in enumerate(throw.hover_steps.tolist()):
        assert distance[: steps + 1, row].max() < 1e-5
        assert distance[steps + 1, row] > 0.05
    arrival = after(path, throw.hover_steps + throw.flight_time() / CONTROL_DT)
    assert (arrival - throw.aim).norm(dim=-1).max() < 0.005


def test_box_and_tracked_position_are_as_late_as_the_latency():
    """And exact; the first position of the episode stays."""
    env = make(4, sensing=replace(EXACT, latency_steps=(2, 2)), throws=THROWN)
    boxes = [detect(*env.world.surface_points(CAMERA.center), EXACT.least_visible, CAMERA)[0]] * 3
    path = [object_pos(env)] * 3
    for step in rollout(env, 20):
        box, is_seen = detect(*env.world.surface_points(CAMERA.center), EXACT.least_visible, CAMERA)
        boxes.append(torch.where(is_seen[:, None], box, boxes[-1]))
        path.append(env.world.privileged(step.log).object_pos)
        torch.testing.assert_close(step.measurement.box, boxes[-3])
        torch.testing.assert_close(step.measurement.object_pos, path[-3])
        assert torch.equal(step.measurement.initial_object_pos, path[0])
    assert (boxes[-1] - boxes[0]).abs().max() > 50


def test_a_term_that_changes_its_width_is_named():
    width, method = 1, find_method("catch_alone")
    term = (lambda frame: frame.now.palm_pos[:, 0, 2:].repeat(1, width),)
    agent = replace(method.agents[0], observation=term)
    env = CatchEnv(CatchEnvCfg(), replace(method, name="mine", agents=(agent,)), num_envs=3)
    width = 2
    for act in (env.reset, lambda: env.step({agent.name: torch.zeros(3, agent.num_joints)})):
        with pytest.raises(InvalidValueError, match=r"'<lambda>' \(.*shape \(3, 2\).*be \(3, 1\)"):
            act()


def test_snapshots_do_not_follow_the_simulation():
    env = make(2)
    first = next(rollout(env, 1, action=1.0))
    truth = env.world.privileged(first.log)
    snapshots = (
        *(first.observation.state, *first.observation.policy.values(), *first.rewards.values()),
        *(*vars(truth).values(), *first.log, *vars(first.record).values()),
        *(first.joint_pos_target, env.world.joint_pos, *env.world.surface_points(CAMERA.center)),
    )
    copies = [value.clone() for value in snapshots]
    list(rollout(env, 8, action=-1.0))
    env.reset()
    assert all(torch.equal(value, copy) for value, copy in zip(snapshots, copies, strict=True))


def test_every_object_is_thrown_without_nan():
    scene = SceneCfg(physics_hz=60.0)
    env = make(2 * len(OBJECTS), 1, objects=tuple(OBJECTS), episode=EpisodeCfg(max_steps=55), scene=scene)
    torch.manual_seed(0)
    finite, thrown = True, set[int]()
    for _ in range(57):
        thrown |= {*env.episode.parameters.object_id.tolist()}
        actions = {name: 2 * torch.rand(env.num_envs, n) - 1 for name, n in env.action_sizes.items()}
        step = env.step(actions)
        values = (step.observation.state, *step.rewards.values(), *(v.float() for v in step.log))
        finite &= all(bool(value.isfinite().all()) for value in values)
    assert finite
    assert thrown == {*range(len(OBJECTS))}
    assert env.statistics.pop()["episodes"] >= env.num_envs


def test_a_teacher_sees_the_same_world():
    """Its observations are those that it would have if its own method were in the environment."""
    pupil, teacher = find_method("catch_alone+fit"), find_method("catch_teacher+age")
    taught = CatchEnv(CatchEnvCfg(), pupil, num_envs=3, seed=6, teacher=teacher)
    alone = CatchEnv(CatchEnvCfg(), teacher, num_envs=3, seed=6)
    actions = {"robot": torch.full((3, len(JOINTS)), 0.2)}
    both = [(taught.reset(), alone.reset())]
    both += [(taught.step(actions).observation, alone.step(actions).observation) for _ in range(8)]
    for seen, expected in both:
        torch.testing.assert_close(seen.teacher["robot"], expected.policy["robot"])
    assert not alone.reset().teacher


@pytest.mark.parametrize("latency", [None, 0.012])
def test_a_branch_goes_on_as_the_original_did_and_draws_nothing(latency: float | None):
    """With equal noise, though other episodes began meanwhile; nominal joints, and a command path."""
    path = {} if latency is None else {"latency": latency, "filter_gain": 300.0, "filter_lookahead": 0.1}
    env = make(3, throws=AT_ONCE, dynamics=JointDynamics.of().with_values(**path))
    list(rollout(env, 12, action=0.3))
    state = clone(env.live)
    env.seed(1)
    expected = [clone(step.observation.policy) for step in rollout(env, 6, action=-0.2)]
    env.reset()
    env.seed(1)
    with env.branched(state):
        found = [clone(step.observation.policy) for step in rollout(env, 6, action=-0.2)]
    torch.testing.assert_close(found, expected, rtol=0.0, atol=0.0)
    assert torch.equal(env._generator.get_state(), torch.Generator().manual_seed(1).get_state())


@torch.no_grad()
def test_rays_that_are_left_out_would_hit_nothing(monkeypatch: pytest.MonkeyPatch):
    env = make(32, **vars(replace(find_task("sizes"), scene=SceneCfg(physics_hz=30.0))))
    ray, shares, num_hidden = env.world.simulation.ray, [], 0

    def checked(origin, directions, groups, mask):
        nonlocal num_hidden
        everywhere = ray(origin, directions, groups)
        hidden = ((everywhere >= 0.0) & (everywhere < 1.0)).any(dim=-1)
        assert not (hidden & ~mask).any()
        chosen = ray(origin, directions, groups, mask)
        assert torch.equal(chosen, torch.where(mask[:, None], everywhere, -1.0))
        num_hidden += int(hidden.sum())
        shares.append(float(mask.float().mean()))
        return chosen

    monkeypatch.setattr(env.world.simulation, "ray", checked)
    generator = torch.Generator().manual_seed(0)
    for _ in range(80):
        sizes = env.action_sizes.items()
        env.step({name: 2.0 * torch.rand(32, size, generator=generator) - 1.0 for name, size in sizes})
    assert num_hidden > 100
    assert sum(shares) / len(shares) < 0.7
