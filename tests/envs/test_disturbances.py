"""What tests of policies disturb: each has its effect on the environment, and none where it is zero."""

import itertools
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import pytest
import torch
from rollouts import AT_ONCE, EXACT, HOVERING, make, object_path, rollout
from torch import Tensor

from paper_robot import JOINTS
from pixel2catch.camera.camera_file import CameraFile
from pixel2catch.camera.level import level_boxes
from pixel2catch.camera.pinhole import nominal_projection
from pixel2catch.envs.catch_env import CatchEnv, CatchEnvCfg
from pixel2catch.envs.tasks import find_task
from pixel2catch.mdp.control_step import BoxHistory
from pixel2catch.mdp.randomization import RandomizationCfg
from pixel2catch.mdp.sensing import ASSUMED_AGE, SensingCfg, detect
from pixel2catch.mdp.tensors import clone
from pixel2catch.mdp.terminations import EpisodeCfg
from pixel2catch.mdp.throws import ThrowCfg
from pixel2catch.methods import find_method
from pixel2catch.robots.joint_dynamics import JointDynamics
from pixel2catch.scene.constants import RGB_CAMERA
from pixel2catch.scene.objects import OBJECTS
from pixel2catch.scene.scene import SceneCfg

PROMPT = replace(EXACT, latency_steps=(0, 0))
ELSEWHERE = CameraFile(camera=replace(RGB_CAMERA, pos=(-0.5, 0.2, 2.1), fx=600.0, fy=601.0))
MEASURED = replace(
    ELSEWHERE,
    pose_covariance=tuple(tuple(1e-4 if i == j else 0.0 for j in range(6)) for i in range(6)),
    focal_std=0.01,
)


def test_boxes_are_those_of_the_calibrated_camera():
    """And a tracker that knows the camera is right about the position."""
    env = make(sensing=replace(PROMPT, camera=ELSEWHERE), throws=AT_ONCE)
    camera = nominal_projection(ELSEWHERE.camera, torch.zeros(1))
    for step in rollout(env, 12):
        box, is_seen = detect(*env.world.surface_points(camera.center), PROMPT.least_visible, camera)
        assert is_seen.all()
        torch.testing.assert_close(step.measurement.box, box)
        truth = env.world.privileged(step.log).object_pos
        assert torch.equal(step.measurement.object_pos, truth)


def test_a_bias_shifts_every_box_of_an_episode_and_the_tracked_position():
    env, exact = make(sensing=replace(PROMPT, box_bias=5.0)), make(sensing=PROMPT)
    first = None
    for step, true in zip(rollout(env, 12), rollout(exact, 12), strict=True):
        shift = step.measurement.box - true.measurement.box
        torch.testing.assert_close(shift[:, :2], shift[:, 2:], atol=1e-3, rtol=0)
        torch.testing.assert_close(shift[:, :2].norm(dim=-1), torch.full((4,), 5.0), atol=1e-3, rtol=0)
        first = shift.clone() if first is None else first
        torch.testing.assert_close(shift, first, atol=2e-3, rtol=0)
        assert (step.measurement.object_pos - true.measurement.object_pos).norm(dim=-1).min() > 0.01


def test_a_spinning_object_turns_as_fast_and_flies_as_before():
    env, plain = make(throws=replace(AT_ONCE, spin=25.0)), make(throws=AT_ONCE)
    path, same = object_path(env, 10), object_path(plain, 10)
    torch.testing.assert_close(path, same, atol=1e-4, rtol=0)
    assert 5.0 < env.world.simulation.bind("qvel")[:, len(JOINTS) + 3 :].norm(dim=-1).max() < 25.1


def test_forces_of_the_air_by_hand():
    """Drag of 0.02 /m slows by 0.5 m/s² at 5 m/s along (3, 0, 4), a side force adds as much; none at rest."""
    env = make(4, objects=("cube_s",), scene=SceneCfg(physics_hz=600.0))
    velocity = env.world.simulation.bind("qvel")[:, len(JOINTS) : len(JOINTS) + 3]
    speeds = torch.tensor([[3.0, 0.0, 4.0], [0.0, 0.0, 0.0], [-6.0, 0.0, -8.0], [3.0, 0.0, 4.0]])
    velocity.copy_(speeds)
    side = torch.zeros(4, 3)
    side[3, 1] = 0.02
    env.world.run(env.world.joint_pos, torch.tensor([0.02, 0.02, 0.01, 0.0]), side, num_steps=1)
    change = torch.tensor([[-0.3, 0.0, -0.4], [0.0, 0.0, 0.0], [0.6, 0.0, 0.8], [0.0, 0.5, 0.0]])
    torch.testing.assert_close(velocity.float(), speeds + change / 600.0, atol=1e-6, rtol=0)


def test_drag_of_an_episode_is_that_of_its_object_air_and_mass():
    """½ ρ A / m, with the mean area of the object's face and its drawn mass."""
    env = make(50, objects=tuple(OBJECTS), randomization=RandomizationCfg(air_density=1.2))
    specs = [OBJECTS[env.world.objects.names[i]] for i in env.episode.parameters.object_id]
    expected = 0.5 * 1.2 * torch.tensor([spec.drag_area / spec.mass for spec in specs])
    assert env.episode.drag is not None
    torch.testing.assert_close(env.episode.drag, expected / env.episode.parameters.mass_scale)


EVERYTHING = {
    "sensing": SensingCfg(
        camera=MEASURED, camera_offset=0.02, camera_turn=0.02, focal_error=0.02, box_bias=5.0, box_scale=1.1,
        edge_noise=5.0, drop_rate=0.1, blackout_steps=3, latency_steps=(0.2, 5.0), latency_grid=0.0,
        clock_error=0.01, stamp_jitter=0.003, unstamped=0.2,
    ),
    "randomization": RandomizationCfg(command_delay=(0, 3), air_density=(0.0, 1.2)),
    "throws": ThrowCfg(hover_steps=(2, 5), spin=10.0, speed_deviation=0.05, angle_deviation=0.04),
    "scene": SceneCfg(object_scale=1.1),
    "dynamics": JointDynamics.of().with_values(latency=0.012, filter_gain=300.0, filter_lookahead=0.1),
}  # fmt: skip
AT_WORST = replace(CatchEnvCfg(), **EVERYTHING)
WIDE = replace(find_task("wide"), scene=SceneCfg(physics_hz=60.0))


@pytest.mark.parametrize(
    ("task", "method", "device"),
    [
        (AT_WORST, "catch+fit", "cpu"),
        pytest.param(AT_WORST, "object_position", "cuda", marks=pytest.mark.gpu),
        pytest.param(WIDE, "catch+fit", "cuda", marks=pytest.mark.gpu),
    ],
    ids=["everything", "everything-cuda", "wide-cuda"],
)
def test_everything_at_once_runs_and_a_seed_gives_it_again(task: CatchEnvCfg, method: str, device: str):
    """Over resets, and on a CUDA device as one recording."""
    rollouts, num_steps = [], 26
    task = replace(task, episode=EpisodeCfg(max_steps=num_steps // 2 - 2))
    for seed in (4, 4, 5):
        env = CatchEnv(task, find_method(method), num_envs=8, device=device, seed=seed)
        actions = {name: torch.full((8, n), 0.2, device=device) for name, n in env.action_sizes.items()}
        states = [env.step(actions).observation.state for _ in range(num_steps)]
        rollouts.append(torch.stack(states))
        env.close()
    assert rollouts[0].isfinite().all()
    torch.testing.assert_close(*rollouts[:2])
    assert (rollouts[0] != rollouts[2]).any()
    assert (rollouts[0][1:] != rollouts[0][:-1]).any(dim=-1).all()


ANY = SensingCfg(latency_steps=(0.6, 4.3), latency_grid=0.0)
STILL = RandomizationCfg(action_noise=0.0, action_bias=0.0)
COARSE = SceneCfg(physics_hz=60.0)


def make_late(num_envs: int = 4, **changes: Any) -> CatchEnv:
    return make(num_envs, seed=7, method="proposed+boxes", scene=COARSE, **changes)


def remembered(env: CatchEnv, num_steps: int) -> Iterator[tuple[BoxHistory, Tensor]]:
    """The boxes after each step, and the latency of the episodes (num_envs, 1)."""
    for step in rollout(env, num_steps):
        yield clone(step.measurement.boxes), env.episode.parameters.latency[:, None].clone()


def test_a_box_between_two_latencies_is_the_mean_of_both():
    """Of one throw, seen half a control step earlier and half a step later; so is the tracked position."""
    paths = []
    for late in (1.0, 1.5, 2.0):
        env = make_late(2, sensing=replace(EXACT, latency_steps=(late, late)), throws=AT_ONCE)
        paths.append([clone(step.measurement) for step in rollout(env, 9)])
    for newer, between, older in zip(*paths, strict=True):
        torch.testing.assert_close(between.box, (newer.box + older.box) / 2, atol=1e-3, rtol=0)
        mean = (newer.object_pos + older.object_pos) / 2
        torch.testing.assert_close(between.object_pos, mean, atol=1e-5, rtol=0)
        assert (between.boxes.age == 1.5 + torch.arange(8)).all()
    assert (paths[0][-1].box - paths[2][-1].box).abs().max() > 3.0


def test_a_missed_image_makes_the_newest_box_older_by_one_step():
    """And adds none: boxes that are not of the beginning differ by the noise of each."""
    late = 2.5
    sensing = SensingCfg(latency_steps=(late, late), drop_rate=0.4)
    env = make_late(12, sensing=sensing, throws=HOVERING)
    path = [boxes for boxes, _ in remembered(env, 24)][int(late) :]
    is_missed = []
    for before, now in itertools.pairwise(path):
        is_new = now.age[:, 0] == late
        kept = torch.where(is_new, now.age[:, 1], now.age[:, 0])
        torch.testing.assert_close(kept, before.age[:, 0] + 1.0)
        assert torch.equal(now.box[:, 0] == before.box[:, 0], ~is_new[:, None].expand(-1, 4))
        is_missed.append(~is_new)
    missed = torch.stack(is_missed)
    assert missed.float().mean().item() == pytest.approx(0.4, abs=4 * (0.4 * 0.6 / missed.numel()) ** 0.5)
    last = path[-1]
    assert (last.age.diff(dim=1) >= 1.0).all()
    for one, other in itertools.combinations(last.box.unbind(dim=1), 2):
        assert (one != other).any(dim=-1).all()


def test_no_box_is_measured_in_a_blackout_however_late_images_are():
    """Of four control steps: the newest box grows older by four, and no more."""
    for late in (1.0, 1.5):
        sensing = replace(EXACT, latency_steps=(late, late), blackout_steps=4, least_visible=0.0)
        env = make_late(8, sensing=sensing, throws=AT_ONCE, episode=EpisodeCfg(max_steps=40))
        stale = torch.stack([boxes.age[:, 0] - late for boxes, _ in remembered(env, 27)])
        assert stale.amax(dim=0).tolist() == [4.0] * 8, late


def test_the_jitter_of_a_stamp_stays_with_its_box():
    env = make_late(8, sensing=replace(EXACT, stamp_jitter=0.004), throws=HOVERING)
    path, latencies = zip(*remembered(env, 4), strict=True)
    for before, now in itertools.pairwise(path):
        torch.testing.assert_close(now.age[:, 1:], before.age[:, :-1] + 1.0)
    error = path[-1].age[:, 0] - latencies[-1][:, 0]
    assert len(error.unique()) == 8
    assert 0.2 * 0.12 < error.std() < 5 * 0.12


def test_boxes_without_stamps_are_taken_for_as_old_as_in_training():
    """When they are delivered: after a missed image they are a control step older."""
    env = make_late(8, sensing=replace(ANY, unstamped=1.0, clock_error=0.02, drop_rate=0.3), throws=HOVERING)
    ages = torch.stack([boxes.age[:, 0] for boxes, _ in remembered(env, 12)])
    stale = ages - ASSUMED_AGE
    torch.testing.assert_close(stale, stale.round())
    assert stale.min().item() == pytest.approx(0.0, abs=1e-5)
    assert stale.max().item() > 0.5


def test_a_command_between_two_delays_moves_the_hand_between_both():
    """Of a change of the targets, half has arrived after 1.5 steps when with 1 all has, and with 2 none."""
    moved = []
    for delay in (1.0, 1.5, 2.0):
        randomization = replace(STILL, command_delay=(delay, delay), command_delay_grid=0.0)
        env = make_late(2, randomization=randomization, sensing=EXACT, throws=HOVERING)
        list(rollout(env, 18))  # then the hand is where action 0 wants it
        list(rollout(env, 1, action=0.1))
        before = env.world.joint_pos[:, 6:]
        list(rollout(env, 1, action=0.1))
        moved.append(env.world.joint_pos[:, 6:] - before)
    prompt, between, late = moved
    assert prompt.min() > 0.01
    torch.testing.assert_close(between, prompt / 2, rtol=0.1, atol=0)
    assert late.abs().max() < 2e-3


def test_perception_that_looks_at_one_image_in_several():
    """Newest ages go from the latency up by one, and begin again with each image that is looked at."""
    sensing = replace(EXACT, latency_steps=(1, 1), image_period=1.5)
    env = make_late(1, sensing=sensing, throws=HOVERING)
    ages = [boxes.age[0, 0].item() for boxes, _ in remembered(env, 31)]
    assert sum(age == 1.0 for age in ages[1:]) == 20
    assert max(ages) == 2.0
    assert all(after in (1.0, before + 1.0) for before, after in itertools.pairwise(ages))


def test_a_policy_for_any_camera_gets_boxes_of_the_level_camera_at_its_place():
    """Whatever the camera: mapped boxes, its place, and positions that its tracker projects back."""
    method, cfg = find_method("catch_alone+anycamera"), replace(PROMPT, any_camera=True)
    env = CatchEnv(CatchEnvCfg(sensing=cfg, throws=AT_ONCE), method, num_envs=8, seed=3)
    for step in rollout(env, 8):
        errors = env.episode.camera_errors
        assert errors is not None
        box, is_seen = detect(*env.world.surface_points(errors.camera.center), 0.05, errors.camera)
        assert is_seen.any()
        found = step.measurement
        torch.testing.assert_close(found.box[is_seen], level_boxes(box, errors.assumed)[is_seen])
        assert torch.equal(found.camera_pos, errors.assumed.center)
        truth = env.world.privileged(step.log).object_pos
        torch.testing.assert_close(found.object_pos[is_seen], truth[is_seen], atol=1e-4, rtol=0)


def test_side_forces_are_level_and_across_the_throw():
    env = make(64, randomization=RandomizationCfg(side_force=(0.005, 0.01)))
    force, along = env.episode.side_force, env.episode.throw.lin_vel
    assert force is not None
    torch.testing.assert_close((force * along).sum(dim=-1), torch.zeros(64), atol=1e-6, rtol=0)
    assert not force[:, 2].any()
    assert ((force.norm(dim=-1) >= 0.005) & (force.norm(dim=-1) <= 0.01)).all()
    assert 0.2 < (force[:, 1] > 0.0).float().mean() < 0.8
