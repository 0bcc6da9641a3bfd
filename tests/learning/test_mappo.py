"""MAPPO against numbers worked out by hand, numbers of another implementation, and its traps."""

import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from reaching import CONTRACT, SMALL, ReachingEnv, TaughtEnv, roll_out

from pixel2catch.errors import InvalidValueError
from pixel2catch.learning.config import TrainCfg
from pixel2catch.learning.experiment import preset
from pixel2catch.learning.gradient_step import NUM_FREE, Standardizer, shuffled
from pixel2catch.learning.mappo import Mappo
from pixel2catch.mdp.tensors import assign
from pixel2catch.methods import METHODS
from pixel2catch.policy import HIDDEN, Policy


@pytest.fixture
def mappo() -> Mappo:
    torch.manual_seed(0)
    return Mappo(SMALL, ReachingEnv(SMALL), CONTRACT)


FROZEN = {
    "linear": (-0.0126347, 1.69721, 0.00455612, 0.983759, 3.25e-4, -0.00997961, 1.55848, 0.00518127, 1.00375),
    "kl": (-0.0124907, 1.65068, 0.00702277, 0.984087, 1 / 3375, -0.0107693, 2.00924, 0.00766507, 1.00813),
    "teacher": (-0.0122537, 2.63057, 0.00318282, 0.985514, 3.25e-4, -0.0142207, 2.17604, 0.00524064, 1.00263),
    "start": (-0.00950074, 3.57356, 0.00145457, 1.00238, 3.25e-4, -0.00909587, 3.05611, 0.00298486, 0.999992),
}
"""Metrics of both agents after four updates of skrl's MAPPO 2.1.1, on whose shell this training once ran."""

SQUARES = {"linear": 103.0941, "kl": 103.2317, "teacher": 102.0613, "start": 102.0829}
"""Sums of the squares of all weights of the policies then."""


class DrawsOfSkrl:
    """Orders as skrl drew them: for all epochs of an agent, then for those of the next one."""

    def __init__(self) -> None:
        self._waiting: list[torch.Tensor] = []

    def __call__(self, cfg: TrainCfg) -> torch.Tensor:
        if not self._waiting:
            drawn = [[shuffled(cfg) for _ in range(cfg.epochs)] for _ in CONTRACT.agents]
            self._waiting = [order for epoch in zip(*drawn, strict=True) for order in epoch]
        return self._waiting.pop(0)


@pytest.mark.parametrize("name", FROZEN)
def test_training_gives_the_numbers_of_skrl(name: str, tmp_path: Path, monkeypatch) -> None:
    torch.manual_seed(1)
    Policy(CONTRACT, SMALL.hidden).save(tmp_path)
    cfg = {
        "linear": SMALL,
        "kl": replace(SMALL, schedule="kl", kl_target=0.004, entropy_scale=0.01, gradient_clip=0.5),
        "teacher": replace(SMALL, teacher=tmp_path),
        "start": replace(SMALL, start=tmp_path, start_transitions=1024),
    }[name]
    torch.manual_seed(0)
    env = TaughtEnv(cfg)
    load = Policy.load

    def drawing(folder: Path, *options: str) -> Policy:
        """Load a policy, and draw as many numbers as that did then."""
        Policy(CONTRACT, SMALL.hidden)
        return load(folder, *options)

    monkeypatch.setattr(Policy, "load", drawing)
    monkeypatch.setattr("pixel2catch.learning.mappo.shuffled", DrawsOfSkrl())
    mappo, metrics = Mappo(cfg, env, CONTRACT), {}
    for progress in (0.0, 0.25, 0.5, 0.75):
        roll_out(mappo, env)
        metrics = mappo.named(mappo.update(progress).tolist())
    assert tuple(metrics.values())[:9] == pytest.approx(FROZEN[name], rel=1e-3, abs=1e-5)
    weights = torch.cat([tensor.flatten() for tensor in mappo.export().parameters()])
    assert weights.square().sum().item() == pytest.approx(SQUARES[name], rel=1e-5)


def test_a_local_critic_sees_no_state():
    """What the simulator alone knows changes every value of a central critic, and none of a local one."""
    for method in ("proposed", "proposed_local_critic"):
        env, outcomes = ReachingEnv(SMALL), []
        env.method, observation = METHODS[method], env.reset()
        for truth in (0.0, 7.0):
            torch.manual_seed(0)
            mappo = Mappo(SMALL, env, CONTRACT)
            mappo.act(replace(observation, state=torch.full_like(observation.state, truth)))
            outcomes.append([mappo.rollout[agent].values[0].clone() for agent in mappo.agents])
        are_equal = [torch.equal(one, other) for one, other in zip(*outcomes, strict=True)]
        assert are_equal == [method == "proposed_local_critic"] * 2


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::DeprecationWarning:torch", "ignore::FutureWarning:torch")
@pytest.mark.skipif(shutil.which("g++") is None, reason="needs a compiler")
def test_fused_agents_learn_the_same(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What they draw differs, so the second learns from the rollout of the first."""
    monkeypatch.setenv("TORCHINDUCTOR_CACHE_DIR", str(tmp_path))
    plain, compiled = (
        Mappo(replace(SMALL, fuse=fuse), ReachingEnv(SMALL), CONTRACT) for fuse in (False, True)
    )
    roll_out(compiled, ReachingEnv(SMALL))
    roll_out(plain, ReachingEnv(SMALL))
    compiled.load_state_dict(plain.state_dict())
    for name in ("rollout", "rewards"):
        assign(getattr(compiled, name), getattr(plain, name))
    compiled.is_done.copy_(plain.is_done)
    compiled.next_states = plain.next_states
    metrics = []
    for mappo in (plain, compiled):
        torch.manual_seed(0)
        metrics.append(mappo.named(mappo.update(0.0).tolist()))
    assert metrics[1] == pytest.approx(metrics[0], rel=1e-3)
    weights = (mappo.export().state_dict() for mappo in (compiled, plain))
    torch.testing.assert_close(*weights, rtol=1e-3, atol=1e-5)


@pytest.mark.gpu
def test_captured_steps_equal_eager_ones(monkeypatch: pytest.MonkeyPatch) -> None:
    cfg = replace(SMALL, device="cuda")
    outcomes = []
    for num_eager_calls in (1, 10**9):
        monkeypatch.setattr("pixel2catch.learning.mappo.NUM_EAGER_CALLS", num_eager_calls)
        torch.manual_seed(0)
        mappo, env = Mappo(cfg, ReachingEnv(cfg), CONTRACT), ReachingEnv(cfg)
        for progress in (0.0, 0.5):
            roll_out(mappo, env)
            metrics = mappo.named(mappo.update(progress).tolist())
        outcomes.append((metrics, mappo.export().state_dict()))
    assert outcomes[0][0] == pytest.approx(outcomes[1][0], rel=1e-4)
    for name, tensor in outcomes[0][1].items():
        torch.testing.assert_close(tensor, outcomes[1][1][name])


@pytest.mark.parametrize(("target", "changes"), [(10.0, 1.5**4), (1e-9, 1 / 1.5**4)])
def test_adaptive_learning_rate(target: float, changes: float) -> None:
    """Four epochs, each of which multiplies or divides the rate by 1.5; never below the lower bound."""
    cfg = replace(SMALL, schedule="kl", kl_target=target, learning_rate=1e-3, final_learning_rate=1e-5)
    mappo = Mappo(cfg, ReachingEnv(cfg), CONTRACT)
    roll_out(mappo, ReachingEnv(cfg))
    assert mappo.named(mappo.update(0.0).tolist())["learning_rate/hand"] == pytest.approx(1e-3 * changes)
    if target < 1.0:
        for _ in range(3):
            roll_out(mappo, ReachingEnv(cfg))
            mappo.update(0.0)
        assert mappo.steps["hand"].learning_rate.item() == pytest.approx(1e-5)


def test_discarded_rollout_leaves_room_for_a_whole_one(mappo: Mappo) -> None:
    env = ReachingEnv(SMALL)
    observation = env.reset()
    mappo.record(env.step(mappo.act(observation)))
    mappo.discard_rollout()
    roll_out(mappo, env)
    assert mappo.rollout["arm"].observations.isfinite().all()
    with pytest.raises(IndexError):
        mappo.act(observation)


def test_impossible_configurations() -> None:
    with pytest.raises(InvalidValueError, match="9 transitions cannot be split into 8"):
        TrainCfg(num_envs=3, rollout_steps=3)
    unused = {"teacher_share": 0.3, "final_teacher_weight": 0.1, "start_transitions": 9, "kl_target": 0.1}
    for name, value in unused.items():
        with pytest.raises(InvalidValueError, match=f"{name} is {value}, which does nothing without"):
            TrainCfg(**{name: value})


def test_networks_have_the_sizes_of_the_policy_to_start_from() -> None:
    assert preset("cpu").train.hidden != preset("cpu", start=Path("catch_alone+fit")).train.hidden == HIDDEN


def test_the_exported_policy_acts_like_the_learner_and_is_adopted(mappo: Mappo) -> None:
    """By the mean of its actions, and where inputs are clipped, too."""
    roll_out(mappo, ReachingEnv(SMALL))
    mappo.update(0.0)
    roll_out(mappo, ReachingEnv(SMALL))
    policy, networks = mappo.export(), mappo.networks["arm"]
    observations = {agent: 300.0 * batch.observations[0] for agent, batch in mappo.rollout.items()}
    inputs = networks.observation_scale(observations["arm"])
    assert inputs.abs().max() == 5.0
    expected = networks.policy(inputs).clamp(-1.0, 1.0)
    torch.testing.assert_close(policy.act(observations)["arm"], expected)
    other = Mappo(SMALL, ReachingEnv(SMALL), CONTRACT)
    other.adopt(policy)
    for name, tensor in other.export().state_dict().items():
        torch.testing.assert_close(tensor, policy.state_dict()[name])


def test_one_outlier_does_not_change_the_standardisation_of_inputs() -> None:
    """A single value of 1e5 among 2e8 made a standard deviation tenfold, and a trained policy failed."""
    scale = Standardizer(1)
    scale.learn(torch.tensor([320.0]), torch.tensor([400.0]), NUM_FREE)
    assert (scale.mean.item(), scale.std.item()) == pytest.approx((320.0, 20.0), abs=0.2)
    values = torch.full((8192, 1), 320.0)
    values[0] = 1e5
    scale.learn(values.mean(dim=0), values.var(dim=0), 8192)
    assert (scale.mean.item(), scale.std.item()) == pytest.approx((320.0, 26.8), abs=0.4)


def test_a_lasting_change_is_learnt() -> None:
    scale = Standardizer(1)
    scale.learn(torch.tensor([0.0]), torch.tensor([1e-6]), NUM_FREE)
    for _ in range(2000):
        scale.learn(torch.tensor([5.0]), torch.tensor([1.0]), 8192)
    assert scale.mean.item() == pytest.approx(5.0, abs=0.5)
    assert scale.std.item() == pytest.approx(1.0, abs=0.7)
