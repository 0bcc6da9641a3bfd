"""The environment as a whole: beginnings, endings, throws, sensing and repeatability."""

from dataclasses import replace

import pytest
import torch
from rollouts import EXACT, HOVERING, rollout
from torch import Tensor

from paper_robot import JOINTS
from pixel2catch.envs.catch_env import STAGGER_STEPS, CatchEnv, CatchEnvCfg
from pixel2catch.envs.tasks import find_task
from pixel2catch.mdp.control_step import History
from pixel2catch.mdp.observations import observe
from pixel2catch.mdp.sensing import detect
from pixel2catch.mdp.tensors import clone
from pixel2catch.mdp.terminations import HOLD_STEPS, EpisodeCfg
from pixel2catch.mdp.throws import ThrowCfg
from pixel2catch.methods import METHODS, find_method
from pixel2catch.scene.objects import OBJECTS

PROPOSED = METHODS["proposed"]
OBJECT = slice(len(JOINTS), len(JOINTS) + 7)


def make(num_envs: int, seed: int = 0, **changes: object) -> CatchEnv:
    return CatchEnv(replace(CatchEnvCfg(), **changes), PROPOSED, num_envs=num_envs, seed=seed)


def object_pos(env: CatchEnv) -> Tensor:
    return env.world.privileged(env.world.quiet_log()).object_pos


def move_object(env: CatchEnv, row: int, pos: Tensor) -> None:
    """Put one object at rest somewhere, between two control steps."""
    simulation = env.world.simulation
    simulation.bind("qpos")[row, OBJECT.start : OBJECT.start + 3] = pos.to(simulation.dtype)
    simulation.bind("qvel")[row, OBJECT.start : OBJECT.start + 6] = 0.0
    simulation.forward()


def test_a_time_out_ends_every_episode_at_its_step():
    env = make(3, throws=HOVERING, episode=EpisodeCfg(max_steps=4))
    ended = [step.terminated.tolist() for step in rollout(env, 9)]
    assert ended == [[number % 4 == 0] * 3 for number in range(1, 10)]


def test_a_stagger_lasts_one_episode():
    """The next objects hover as long as the task says, and so do those of its variants."""
    env = make(32, throws=ThrowCfg(hover_steps=(3, 3)), episode=EpisodeCfg(max_steps=6))
    env.reset(is_staggered=True)
    hovering = env.episode.throw.hover_steps.clone()
    assert hovering.min() >= 3
    assert 20 < hovering.max() <= 3 + STAGGER_STEPS
    list(rollout(env, 6))
    assert env.episode.throw.hover_steps.tolist() == [3] * 32
    wide = find_task("wide").with_longer_hovering(7)
    assert all(
        longer.throws.hover_steps == (usual.throws.hover_steps[0], usual.throws.hover_steps[1] + 7)
        for longer, usual in zip(wide.all_variants, find_task("wide").all_variants, strict=True)
    )


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
    after = next(rollout(env, 1))
    assert after.record.steps.tolist() == [5, 1, 5]
    assert not after.terminated.any()


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
    assert (
        last.joint_pos_target.sub(last.measurement.joint_pos_target).abs().max() > 0.1
    )  # what was commanded


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


def test_hover_lasts_5_to_19_control_steps_and_is_still():
    env = make(48)
    start, first_move = object_pos(env), torch.zeros(48, dtype=torch.long)
    for number, _ in enumerate(rollout(env, 21), start=1):
        distance = (object_pos(env) - start).norm(dim=-1)
        is_moving = distance > 0.05
        assert (is_moving | (distance < 1e-5)).all(), "an object either hovers or flies"
        first_move = torch.where(is_moving & (first_move == 0), number, first_move)
    hover_steps = first_move - 1
    assert (hover_steps.min().item(), hover_steps.max().item()) == (5, 19)


def test_throws_come_down_where_they_are_aimed():
    """Within 5 mm, at any physics rate."""
    env = make(16, throws=ThrowCfg(hover_steps=(1, 1)))
    path, aim = [], next(rollout(env, 1)).record.aim
    for _ in rollout(env, 29):
        path.append(object_pos(env))
    path = torch.stack(path)
    for row in range(16):
        flight, target = path[:, row], aim[row]
        peak = int(flight[:20, 2].argmax())  # a lost object flies again later
        after = peak + int((flight[peak:, 2] < target[2]).nonzero()[0])
        above, below = flight[after - 1], flight[after]
        share = (above[2] - target[2]) / (above[2] - below[2])
        crossing = above + share * (below - above)
        assert (crossing - target)[:2].norm() < 0.005


def test_a_box_is_measured_exactly_after_the_latency():
    latency = 2
    env = make(4, sensing=replace(EXACT, latency_steps=(2, 2)), throws=ThrowCfg(hover_steps=(1, 1)))
    points, is_visible = env.world.surface_points()
    seen = [detect(points, is_visible, EXACT.least_visible)[0]] * (latency + 1)
    for step in rollout(env, 20):
        box, is_seen = detect(*env.world.surface_points(), EXACT.least_visible)
        seen.append(torch.where(is_seen[:, None], box, seen[-1]))
        torch.testing.assert_close(step.measurement.box, seen[-1 - latency])
    assert (seen[-1] - seen[0]).abs().max() > 50


def test_snapshots_do_not_follow_the_simulation():
    env = make(2)
    first = next(rollout(env, 1, action=1.0))
    truth = env.world.privileged(first.log)
    snapshots = (
        *(first.observation.state, *first.observation.policy.values(), *first.rewards.values()),
        *(*vars(truth).values(), *first.log, *vars(first.record).values()),
        *(first.joint_pos_target, env.world.joint_pos, *env.world.surface_points()),
    )
    copies = [value.clone() for value in snapshots]
    list(rollout(env, 8, action=-1.0))
    env.reset()
    assert all(torch.equal(value, copy) for value, copy in zip(snapshots, copies, strict=True))


def test_a_seed_gives_its_rollout_again():
    rollouts = []
    for seed in (1, 1, 2):
        env = make(3, seed=seed, episode=EpisodeCfg(max_steps=8))
        rollouts.append(torch.stack([step.observation.state for step in rollout(env, 20, action=0.4)]))
    assert torch.equal(rollouts[0], rollouts[1])
    assert not torch.equal(rollouts[0], rollouts[2])


def test_a_tracker_is_as_late_as_the_box_and_the_first_position_stays():
    env = make(2, sensing=replace(EXACT, latency_steps=(2, 2)), throws=ThrowCfg(hover_steps=(1, 1)))
    path = [env.world.privileged(env.world.quiet_log()).object_pos] * 3
    first = path[0].clone()
    for step in rollout(env, 15):
        path.append(env.world.privileged(step.log).object_pos)
        torch.testing.assert_close(step.measurement.object_pos, path[-3])
        assert torch.equal(step.measurement.initial_object_pos, first)
    assert (path[-1] - first).norm(dim=-1).min() > 1.0


@pytest.mark.parametrize("name", ["journal", "catch+fit", "without_pf+age"])
def test_recorded_measurements_give_the_observations_again(name):
    """What a deployment needs: measurements of the robot alone determine what the policy sees."""
    method = find_method(name)
    env = CatchEnv(replace(CatchEnvCfg(), episode=EpisodeCfg(max_steps=7)), method, num_envs=2, seed=5)
    history = None
    for step in rollout(env, 21, action=0.2):
        now = clone(step.measurement)
        if step.terminated.all():
            history = History(now, now, now)
        elif history is not None:
            history = History(history.before, history.now, now)
        if history is not None:
            for agent, again in observe(method.layouts, history).items():
                assert torch.equal(again, step.observation.policy[agent])
    assert history is not None


def test_every_object_is_thrown_without_nan():
    env = make(2 * len(OBJECTS), objects=tuple(OBJECTS), episode=EpisodeCfg(max_steps=55))
    finite = True
    for _ in range(57):
        actions = {name: 2 * torch.rand(env.num_envs, n) - 1 for name, n in env.action_sizes.items()}
        step = env.step(actions)
        values = (step.observation.state, *step.rewards.values(), *(v.float() for v in step.log))
        finite &= all(bool(value.isfinite().all()) for value in values)
    assert finite
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
