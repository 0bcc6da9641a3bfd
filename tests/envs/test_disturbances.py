"""What tests of policies disturb: each has its effect on the environment, and none where it is zero."""

from dataclasses import replace
from typing import Any

import pytest
import torch
from rollouts import AT_ONCE, rollout

from paper_robot import JOINTS
from pixel2catch.camera.camera_file import CameraFile
from pixel2catch.camera.pinhole import nominal_projection
from pixel2catch.envs.catch_env import CatchEnv, CatchEnvCfg
from pixel2catch.envs.tasks import find_task
from pixel2catch.mdp.randomization import RandomizationCfg
from pixel2catch.mdp.sensing import SensingCfg, detect
from pixel2catch.mdp.terminations import EpisodeCfg
from pixel2catch.mdp.throws import ThrowCfg
from pixel2catch.methods import METHODS, find_method
from pixel2catch.robots.joint_dynamics import JointDynamics
from pixel2catch.scene.constants import RGB_CAMERA
from pixel2catch.scene.scene import SceneCfg

PROPOSED = METHODS["proposed"]
EXACT = SensingCfg(corner_noise=0.0, joint_noise=0.0, joint_bias=0.0, latency_steps=(0, 0))
ELSEWHERE = CameraFile(camera=replace(RGB_CAMERA, pos=(-0.5, 0.2, 2.1), fx=600.0, fy=601.0))
MEASURED = replace(
    ELSEWHERE,
    pose_covariance=tuple(tuple(1e-4 if i == j else 0.0 for j in range(6)) for i in range(6)),
    focal_std=0.01,
)


def make(num_envs: int = 4, seed: int = 0, **changes: Any) -> CatchEnv:
    """Environments whose first draws after construction are those of the seed."""
    env = CatchEnv(replace(CatchEnvCfg(), **changes), PROPOSED, num_envs=num_envs)
    env.seed(seed)
    env.reset()
    return env


def object_path(env: CatchEnv, num_steps: int) -> torch.Tensor:
    """Positions of the object (num_steps + 1, num_envs, 3) in the robot's frame [m]."""
    places = [env.world.privileged(env.world.quiet_log()).object_pos]
    places += [env.world.privileged(step.log).object_pos for step in rollout(env, num_steps)]
    return torch.stack(places)


VANISHING: dict[str, Any] = {
    "sensing": SensingCfg(
        camera_offset=1e-9,
        box_bias=1e-6,
        edge_noise=1e-6,
        drop_rate=1e-9,
        clock_error=1e-9,
        stamp_jitter=1e-9,
    ),
    "throws": ThrowCfg(speed_deviation=1e-8, angle_deviation=1e-8),
    "randomization": RandomizationCfg(air_density=1e-9),
}


def test_vanishing_disturbances_throw_the_same():
    """Draws for disturbances come after the others: the first episode is the same, but for rounding."""
    plain, disturbed = make(seed=5), make(seed=5, **VANISHING)
    first, second = object_path(plain, 12), object_path(disturbed, 12)
    torch.testing.assert_close(first, second, atol=2e-5, rtol=0)


def test_boxes_are_those_of_the_calibrated_camera():
    """And a tracker that knows the camera is right about the position."""
    env = make(sensing=replace(EXACT, camera=ELSEWHERE), throws=AT_ONCE)
    camera = nominal_projection(ELSEWHERE.camera, torch.zeros(1))
    for step in rollout(env, 12):
        box, is_seen = detect(*env.world.surface_points(ELSEWHERE.camera), EXACT.least_visible, camera)
        assert is_seen.all()
        torch.testing.assert_close(step.measurement.box, box)
        truth = env.world.privileged(step.log).object_pos
        assert torch.equal(step.measurement.object_pos, truth)


def test_a_measured_camera_is_another_one_in_every_episode():
    """10 mrad at 600 px: a spread of about 6 px that stays through an episode."""
    task: dict[str, Any] = {"throws": ThrowCfg(hover_steps=(3, 3)), "episode": EpisodeCfg(max_steps=3)}
    env = make(200, sensing=replace(EXACT, camera=MEASURED), **task)
    exact = make(200, sensing=replace(EXACT, camera=ELSEWHERE), **task)
    shifts = []
    for step, known in zip(rollout(env, 2), rollout(exact, 2), strict=True):
        shifts.append((step.measurement.box - known.measurement.box)[:, 0])
    assert 5.0 < shifts[0].std() < 8.0
    torch.testing.assert_close(shifts[0], shifts[1], atol=0.05, rtol=0)
    assert env.episode.camera_errors is not None
    before = env.episode.camera_errors.camera.center.clone()
    list(rollout(env, 1))
    assert (env.episode.camera_errors.camera.center != before).any(dim=-1).all()


def test_a_bias_shifts_every_box_of_an_episode_and_the_tracked_position():
    env, exact = make(sensing=replace(EXACT, box_bias=5.0)), make(sensing=EXACT)
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
    spin = env.world.simulation.bind("qvel")[:, len(JOINTS) + 3 :].norm(dim=-1)
    assert 0.5 < spin.max() < 25.1
    assert spin.max() > 5.0


EVERYTHING = {
    "sensing": SensingCfg(
        camera=MEASURED, camera_offset=0.02, camera_turn=0.02, focal_error=0.02, box_bias=5.0, box_scale=1.1,
        edge_noise=5.0, drop_rate=0.1, blackout_steps=3, latency_steps=(0.2, 5.0), latency_grid=0.0,
        clock_error=0.01, stamp_jitter=0.003, unstamped=0.2,
    ),
    "randomization": RandomizationCfg(command_delay=(0, 3), air_density=(0.0, 1.2)),
    "throws": ThrowCfg(hover_steps=(2, 5), spin=10.0, speed_deviation=0.05, angle_deviation=0.04),
    "scene": SceneCfg(object_scale=1.1),
    "dynamics": JointDynamics.nominal().with_values(latency=0.012, filter_gain=300.0, filter_lookahead=0.1),
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
    for _ in range(2):
        env = CatchEnv(task, find_method(method), num_envs=8, device=device, seed=4)
        actions = {name: torch.full((8, n), 0.2, device=device) for name, n in env.action_sizes.items()}
        states = [env.step(actions).observation.state for _ in range(num_steps)]
        rollouts.append(torch.stack(states))
        env.close()
    assert rollouts[0].isfinite().all()
    torch.testing.assert_close(*rollouts)
    assert (rollouts[0][1:] != rollouts[0][:-1]).any(dim=-1).all()
