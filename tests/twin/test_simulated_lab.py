"""The lab behind the wires: throws and verdicts are those of the environment."""

from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from pixel2catch.camera.camera_file import CameraFile
from pixel2catch.camera.pinhole import project
from pixel2catch.envs.cfg import CatchEnvCfg
from pixel2catch.evaluation.loading import load_policy
from pixel2catch.evaluation.protocol import TRIAL_STEPS, EvaluationCfg
from pixel2catch.mdp.randomization import RandomizationCfg
from pixel2catch.mdp.sensing import SensingCfg
from pixel2catch.scene.constants import OBJECT_POS, RGB_CAMERA
from pixel2catch.scene.objects import SEEN
from pixel2catch.scene.scene import SceneCfg
from pixel2catch.twin import TaskArgs
from pixel2catch.twin.simulated_lab import Phase, SimulatedLab

DECIMATION = 4
QUIET = RandomizationCfg(action_noise=0.0, action_bias=0.0)
TASK = CatchEnvCfg(scene=SceneCfg(physics_hz=30.0 * DECIMATION), randomization=QUIET)
EXACT = replace(TASK, sensing=SensingCfg(joint_bias=0.0))


@pytest.fixture
def lab() -> Iterator[SimulatedLab]:
    with closing(SimulatedLab(TASK, seed=0)) as lab:
        yield lab


def control_step(lab: SimulatedLab, start: np.ndarray, end: np.ndarray) -> None:
    for i in range(1, DECIMATION + 1):
        lab.step(start + i / DECIMATION * (end - start))


def hold_until(lab: SimulatedLab, phase: Phase) -> np.ndarray:
    target = lab.joints.position
    while lab.phase is not phase:
        control_step(lab, target, target)
    return target


@pytest.mark.parametrize(("seed", "is_caught"), [(5, False), (6, True)])
def test_a_throw_goes_and_is_judged_as_in_the_environment(seed: int, is_caught: bool):
    """The encoders have no offset, which no environment lets its servos feel."""
    lab = SimulatedLab(EXACT, seed=0)
    policy, method = load_policy(Path("proposed"))
    env = EvaluationCfg(objects=SEEN, num_envs=1, task=EXACT).make_env(method)
    env.seed(seed)
    observation, expected, targets = env.reset(), None, list[np.ndarray]()
    while not expected or not (expected.is_success or expected.is_dropped or len(targets) == TRIAL_STEPS):
        step = env.step(policy.act(observation.policy))
        observation, expected = step.observation, step.record
        targets.append(step.joint_pos_target[0].double().numpy().copy())
    lab.prepare(seed)
    before = hold_until(lab, Phase.HELD)
    for number, target in enumerate(targets, start=1):
        if number == int(lab.episode.throw.hover_steps):
            lab.throw()
        control_step(lab, before, target)
        before = target
    assert lab.phase is Phase.OVER
    for name in ("steps", "held_steps", "is_tracked", "is_success", "is_dropped", "object_id"):
        assert torch.equal(getattr(lab.record, name), getattr(expected, name)), name
    assert lab.record.max_joint_speed == pytest.approx(expected.max_joint_speed, rel=1e-3)
    assert lab.truth()["is_success"] == is_caught
    env.close()
    lab.close()


def test_the_camera_is_drawn_within_its_uncertainty_and_assumed_as_calibrated(tmp_path: Path):
    variances = tuple(tuple(4e-4 * (i == j) for j in range(6)) for i in range(6))
    file = CameraFile(camera=RGB_CAMERA, pose_covariance=variances, focal_std=0.01)
    file.save(tmp_path / "camera.json")
    policy, _ = load_policy(Path("catch_alone+anycamera"))
    tasks = [TaskArgs(camera=tmp_path / "camera.json").make(policy, seed) for seed in (0, 0, 1)]
    true, again, other = (task.scene.camera for task in tasks)
    assert true == again != other
    assert tasks[0].sensing.camera == file
    with closing(SimulatedLab(tasks[0], seed=0)) as lab:
        assert lab.camera == RGB_CAMERA
        lab.prepare(0)
        hold_until(lab, Phase.HELD)
        place = torch.tensor(lab.exposure().moment.qpos[None, OBJECT_POS])
        center = np.reshape(lab.truth()["box"], (2, 2)).mean(axis=0)
    shown, assumed = (project(each, place)[0][0].numpy() for each in (true, RGB_CAMERA))
    assert np.abs(center - shown).max() < 3.0 < 10.0 < np.linalg.norm(center - assumed)


def test_an_object_that_nobody_catches_is_missed_when_it_falls(lab: SimulatedLab):
    lab.prepare(3)
    hold_until(lab, Phase.HELD)
    lab.throw()
    hold_until(lab, Phase.FLYING)
    start = lab.time
    hold_until(lab, Phase.OVER)
    assert lab.outcome == "missed"
    assert 0.8 < lab.time - start < 1.6


def test_encoders_round_and_repeat_themselves_at_rest(lab: SimulatedLab):
    """To 9.5 µrad (arm) and 89 µrad (hand), with noise that is seen where a position is between two steps."""
    step = np.repeat([9.5e-6, 8.9e-5], [6, 13])
    readings = np.array([lab.encoders(lab.time).position for _ in range(400)])
    counts = readings / step
    np.testing.assert_allclose(counts, np.rint(counts), atol=1e-6)
    assert np.abs(readings - lab.joints.position).max() < 2.0 * step.max()
    assert (np.ptp(counts, axis=0) <= 2.001).all()
    assert (np.diff(readings, axis=0) == 0.0).mean() > 0.5


def test_an_offset_of_an_encoder_moves_the_joint_and_no_reading(lab: SimulatedLab):
    target = lab.joints.position
    for _ in range(60):
        control_step(lab, target, target)
    offset = lab.episode.parameters.joint_bias[0].numpy()
    true = lab.exposure().moment.qpos[:6]
    assert np.abs(offset).max() > 1e-3
    assert true == pytest.approx(target[:6] - offset[:6], abs=1e-4)
    assert lab.encoders(lab.time).position[:6] == pytest.approx(target[:6], abs=1e-4)


def test_encoders_follow_between_physics_steps(lab: SimulatedLab):
    """In an even motion they foretell where the joints are at the next step."""
    start = lab.joints.position
    for _ in range(10):
        control_step(lab, start, start + 0.02)
        start = start + 0.02
    goal = start + 0.02 / DECIMATION
    foretold = lab.encoders(lab.time + lab.physics_dt).position
    now, way = lab.joints.position, np.abs(lab.joints.velocity[:6]).min() * lab.physics_dt
    lab.step(goal)
    assert way > 1e-3
    assert np.abs(lab.joints.position - foretold)[:6].max() < 0.05 * way
    assert np.abs(lab.joints.position - now)[:6].min() > 0.8 * way
