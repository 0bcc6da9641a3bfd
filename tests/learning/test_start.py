"""Trainings that begin with another policy: with its weights, or with a teacher to imitate at first."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from reaching import CONTRACT, SMALL, ReachingEnv, TaughtEnv, roll_out

from pixel2catch.envs.catch_env import Observation
from pixel2catch.errors import InvalidValueError, PolicyMismatchError
from pixel2catch.learning.config import TrainCfg
from pixel2catch.learning.mappo import Mappo
from pixel2catch.learning.train import train
from pixel2catch.policy import AgentContract, Policy

NUM_ROLLOUTS = 8
RATE = 1e-3


def starting(policy: Path, **changes: object) -> TrainCfg:
    """A training of eight rollouts, in the first two of which the value networks alone learn."""
    rollout = SMALL.rollout_transitions
    cfg = replace(SMALL, start=policy, start_transitions=2 * rollout, transitions=NUM_ROLLOUTS * rollout)
    rates = {"schedule": "linear", "learning_rate": RATE, "final_learning_rate": RATE}
    return replace(cfg, **(rates | changes))


@pytest.fixture
def policy(tmp_path: Path) -> Path:
    """A policy whose inputs are not standardised by 0 and 1."""
    torch.manual_seed(1)
    networks = Policy(CONTRACT, SMALL.hidden)
    for agent in CONTRACT.agents:
        networks.network(agent).input_mean.fill_(0.25)
        networks.network(agent).input_std.fill_(2.0)
    networks.save(tmp_path / "run" / "policy")
    return tmp_path / "run"


def test_a_training_goes_on_from_a_run_and_is_resumed(policy: Path, tmp_path: Path) -> None:
    cfg = starting(policy)
    half = replace(cfg, transitions=cfg.transitions // 2)
    train(half, ReachingEnv, CONTRACT, tmp_path / "out")
    result = train(cfg, ReachingEnv, CONTRACT, tmp_path / "out", resume=True)
    assert result.status == "finished"
    assert result.transitions == cfg.transitions


def test_the_adaptive_learning_rate_waits_for_the_policy(policy: Path) -> None:
    """A frozen policy has no divergence, which would raise the rate to its bound."""
    cfg = starting(policy, schedule="kl", kl_target=10.0, final_learning_rate=1e-5)
    mappo, env = Mappo(cfg, ReachingEnv(cfg), CONTRACT), ReachingEnv(cfg)
    rates = []
    for progress in (0.0, 0.5):
        roll_out(mappo, env)
        rates.append(mappo.named(mappo.update(progress).tolist())["learning_rate/arm"])
    assert rates == pytest.approx([RATE, RATE * 1.5**cfg.epochs])


def test_what_does_not_fit_is_refused(policy: Path, tmp_path: Path) -> None:
    with pytest.raises(InvalidValueError, match=r"--hidden"):
        Mappo(replace(SMALL, hidden=(8,)), ReachingEnv(SMALL), CONTRACT).adopt(Policy.load(policy / "policy"))
    other = replace(CONTRACT, method="other")
    with pytest.raises(PolicyMismatchError, match="method"):
        train(starting(policy), ReachingEnv, other, tmp_path / "out")


@pytest.fixture
def teacher(policy: Path) -> Path:
    """Its actions differ from 0."""
    networks = Policy.load(policy / "policy")
    for agent in CONTRACT.agents:
        torch.nn.init.normal_(networks.network(agent).network[-1].bias, std=0.5)  # pyright: ignore[reportArgumentType]
    networks.save(policy / "policy")
    return policy / "policy"


def after_updates(cfg: TrainCfg, progress: list[float]) -> tuple[Mappo, Observation]:
    """A mappo after one update at each of these shares of the training, and what it sees last."""
    torch.manual_seed(2)
    env = TaughtEnv(cfg)
    mappo = Mappo(cfg, env, CONTRACT)
    torch.manual_seed(3)
    for share in progress:
        roll_out(mappo, env)
        mappo.update(share)
    return mappo, env.reset()


def distance(teacher: Path, mappo: Mappo, observation: Observation) -> float:
    """Root mean square of the difference of their actions."""
    pupil, expert = mappo.export(), Policy.load(teacher)
    actions, teacher_actions = pupil.act(observation.policy), expert.act(observation.teacher)
    differences = torch.cat([actions[name] - teacher_actions[name] for name in teacher_actions], -1)
    return differences.square().mean().sqrt().item()


def test_the_pupil_acts_like_its_teacher(teacher: Path):
    cfg = replace(SMALL, teacher=teacher, teacher_share=1.0)
    begun, taught = (distance(teacher, *after_updates(cfg, [0.0] * number)) for number in (0, 15))
    assert taught < 0.1 * begun


def test_rewards_alone_count_after_its_share(teacher: Path):
    """A teacher that is not asked any more changes nothing, to the last bit."""
    taught, _ = after_updates(replace(SMALL, teacher=teacher, teacher_share=0.5), [0.5, 0.7])
    alone, _ = after_updates(SMALL, [0.5, 0.7])
    for name, tensor in alone.export().state_dict().items():
        assert torch.equal(tensor, taught.export().state_dict()[name]), name


def test_its_weight_falls_evenly(teacher: Path):
    cfg = replace(SMALL, teacher=teacher, teacher_share=0.4, final_teacher_weight=0.2)
    mappo, env = Mappo(cfg, TaughtEnv(cfg), CONTRACT), TaughtEnv(cfg)
    weights = []
    for progress in (0.0, 0.1, 0.2, 0.4, 0.9):
        roll_out(mappo, env)
        mappo.update(progress)
        weights += [step.teacher_weight.item() for step in mappo.steps.values()][:1]
    assert weights == pytest.approx([1.0, 0.8, 0.6, 0.2, 0.2])


def test_a_teacher_may_have_other_agents(tmp_path: Path):
    """One agent that moves all joints in another order teaches two."""
    robot = AgentContract(observation=CONTRACT.agents["arm"].observation, joints=("finger", "idle", "pan"))
    policy = Policy(replace(CONTRACT, agents={"robot": robot}), SMALL.hidden)
    layer = policy.network("robot").network[-1]
    torch.nn.init.zeros_(layer.weight)  # pyright: ignore[reportArgumentType]
    layer.bias.data = torch.tensor([0.1, 0.2, 0.3])  # pyright: ignore[reportAttributeAccessIssue]
    policy.save(tmp_path)
    env = TaughtEnv(SMALL)
    mappo = Mappo(replace(SMALL, teacher=tmp_path), env, CONTRACT)
    observation = env.reset()
    mappo.act(replace(observation, teacher={"robot": observation.policy["arm"]}))
    teacher_actions = {agent: batch.teacher_actions[0] for agent, batch in mappo.rollout.items()}
    assert torch.equal(teacher_actions["arm"], torch.tensor([0.3, 0.2]).expand(env.num_envs, 2))
    assert torch.equal(teacher_actions["hand"], torch.tensor([0.1]).expand(env.num_envs, 1))


def test_a_teacher_of_another_robot_is_refused(tmp_path: Path):
    hand = AgentContract(observation=(("pixel", 1),), joints=("thumb",))
    Policy(replace(CONTRACT, agents=CONTRACT.agents | {"hand": hand}, workcell="other"), SMALL.hidden).save(
        tmp_path
    )
    cfg = replace(SMALL, teacher=tmp_path)
    with pytest.raises(PolicyMismatchError, match="'other'; not both move finger, thumb"):
        Mappo(cfg, TaughtEnv(cfg), CONTRACT)
