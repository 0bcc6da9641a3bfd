"""The environment through images: the same throws, other boxes."""

from collections.abc import Iterator

import pytest
import torch
from rendered_throws import FilmCfg, PerceptionRunner, RenderedDetector, moments

from pixel2catch.camera.image import Verdict
from pixel2catch.envs.catch_env import CatchEnv, CatchEnvCfg
from pixel2catch.errors import DeviceUnavailableError
from pixel2catch.evaluation.protocol import EvaluationCfg, recorded_throws
from pixel2catch.mdp.control_step import Measurement
from pixel2catch.mdp.sensing import SensingCfg
from pixel2catch.mdp.tensors import clone
from pixel2catch.methods import METHODS
from pixel2catch.perception.background import BackgroundSubtraction
from pixel2catch.rendering.renderer import find_gl_backend
from pixel2catch.scene.constants import CONTROL_DT, OBJECT_POS, OBJECT_VEL

METHOD = METHODS["proposed"]
FILM = FilmCfg(num_empty=2, num_held=2)
NUM_STEPS = 4


class Idle:
    """Does nothing."""

    def reset(self, is_ended: torch.Tensor | None = None) -> None:
        pass

    def act(self, observations: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
        num_envs = next(iter(observations.values())).shape[0]
        return {agent.name: torch.zeros(num_envs, agent.num_joints) for agent in METHOD.agents}


@pytest.fixture(scope="module")
def env() -> Iterator[CatchEnv]:
    """One environment whose eye looks at images; without noise of boxes and without latency."""
    try:
        find_gl_backend()
    except DeviceUnavailableError as error:
        pytest.skip(str(error))
    task = CatchEnvCfg(sensing=SensingCfg(corner_noise=0.0, latency_steps=(0, 0)))
    env = CatchEnv(task, METHOD, num_envs=1)
    eye = RenderedDetector(env.detector, env.world, FILM, PerceptionRunner(BackgroundSubtraction()))
    env.detector = eye
    yield env
    eye.close()
    env.close()


def throw(env: CatchEnv, *, through_images: bool) -> list[Measurement]:
    """What is measured in the first steps of one throw."""
    assert isinstance(env.detector, RenderedDetector)
    env.detector.open() if through_images else env.detector.close()
    env.seed(5)
    observation, measured = env.reset(), []
    for _ in range(NUM_STEPS):
        step = env.step(Idle().act(observation.policy))
        observation = step.observation
        measured.append(clone(step.measurement))
    return measured


def test_the_throw_and_the_noise_are_the_same_and_the_boxes_agree(env: CatchEnv):
    by_images, by_geometry = throw(env, through_images=True), throw(env, through_images=False)
    for seen, known in zip(by_images, by_geometry, strict=True):
        assert torch.equal(seen.joint_pos, known.joint_pos)
        assert torch.equal(seen.object_pos, known.object_pos)
        assert 0.0 < (seen.box - known.box).abs().max() <= 5.0


def test_the_eye_keeps_the_images_of_the_episode_and_what_was_found(env: CatchEnv):
    throw(env, through_images=True)
    assert isinstance(env.detector, RenderedDetector)
    assert len(env.detector.shots) == len(env.detector.boxes) == NUM_STEPS + 1
    assert all(seen.verdict is Verdict.SEEN for seen in env.detector.boxes)
    times = [shot.time for shot in env.detector.shots]
    assert torch.tensor(times).diff().tolist() == pytest.approx([CONTROL_DT] * NUM_STEPS, abs=1e-6)
    assert -20 * CONTROL_DT < times[0] <= -5 * CONTROL_DT


def test_throws_are_recorded_with_the_time_of_their_release():
    cfg = EvaluationCfg(objects=("cube_l", "sphere_s"), num_envs=2, trials=1)
    for throw in recorded_throws(cfg, Idle(), METHOD):
        states = moments(throw)
        times = [moment.time for moment in states]
        assert -19 * CONTROL_DT <= times[0] <= -4 * CONTROL_DT
        held = states[times.index(0.0) - 1]
        released, later = (states[times.index(0.0) + i] for i in (0, 3))
        assert abs(held.qvel[OBJECT_VEL]).max() < 0.01
        assert released.qvel[OBJECT_VEL][2] > 3.0
        assert later.qpos[OBJECT_POS][0] - released.qpos[OBJECT_POS][0] == pytest.approx(
            3 * CONTROL_DT * released.qvel[OBJECT_VEL][0], rel=0.02
        )
        assert throw.object_name in cfg.objects
