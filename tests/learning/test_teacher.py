"""Trainings that imitate a teacher at first: how near they come to it, and when they stop asking it."""

import dataclasses
from pathlib import Path

import pytest
import torch
from reaching import CONTRACT, SMALL, TaughtEnv, roll_out

from pixel2catch.envs.catch_env import Observation
from pixel2catch.errors import InvalidValueError, PolicyMismatchError
from pixel2catch.learning.config import TrainCfg
from pixel2catch.learning.mappo import Mappo
from pixel2catch.policy import AgentContract, Policy


@pytest.fixture
def teacher(tmp_path: Path) -> Path:
    torch.manual_seed(1)
    policy = Policy(CONTRACT, SMALL.hidden)
    for agent in CONTRACT.agents:
        torch.nn.init.normal_(policy.network(agent).network[-1].bias, std=0.5)  # pyright: ignore[reportArgumentType]
    policy.save(tmp_path / "teacher")
    return tmp_path / "teacher"


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
    return (
        torch.cat([actions[name] - teacher_actions[name] for name in teacher_actions], -1)
        .square()
        .mean()
        .sqrt()
        .item()
    )


def test_the_pupil_acts_like_its_teacher(teacher: Path):
    cfg = dataclasses.replace(SMALL, teacher=teacher, teacher_share=1.0)
    begun, taught = (distance(teacher, *after_updates(cfg, [0.0] * number)) for number in (0, 15))
    assert taught < 0.1 * begun


def test_rewards_alone_count_after_its_share(teacher: Path):
    """A teacher that is not asked any more changes nothing, to the last bit."""
    taught, _ = after_updates(dataclasses.replace(SMALL, teacher=teacher, teacher_share=0.5), [0.5, 0.7])
    alone, _ = after_updates(SMALL, [0.5, 0.7])
    for name, tensor in alone.export().state_dict().items():
        assert torch.equal(tensor, taught.export().state_dict()[name]), name


@pytest.mark.parametrize(
    ("final", "expected"), [(0.0, [1.0, 0.75, 0.5, 0.0, 0.0]), (0.2, [1.0, 0.8, 0.6, 0.2, 0.2])]
)
def test_its_weight_falls_evenly(teacher: Path, final: float, expected: list[float]):
    cfg = dataclasses.replace(SMALL, teacher=teacher, teacher_share=0.4, final_teacher_weight=final)
    mappo, env = Mappo(cfg, TaughtEnv(cfg), CONTRACT), TaughtEnv(cfg)
    weights = []
    for progress in (0.0, 0.1, 0.2, 0.4, 0.9):
        roll_out(mappo, env)
        mappo.update(progress)
        weights += [step.teacher_weight.item() for step in mappo.steps.values()][:1]
    assert weights == pytest.approx(expected)


def test_a_share_out_of_range_is_refused():
    with pytest.raises(InvalidValueError, match=r"teacher_share is 1\.5; it must be from 0 to 1"):
        dataclasses.replace(SMALL, teacher_share=1.5)


def test_a_teacher_may_have_other_agents(tmp_path: Path):
    """One agent that moves all joints in another order teaches two."""
    robot = AgentContract(observation=CONTRACT.agents["arm"].observation, joints=("finger", "idle", "pan"))
    policy = Policy(dataclasses.replace(CONTRACT, agents={"robot": robot}), SMALL.hidden)
    layer = policy.network("robot").network[-1]
    torch.nn.init.zeros_(layer.weight)  # pyright: ignore[reportArgumentType]
    layer.bias.data = torch.tensor([0.1, 0.2, 0.3])  # pyright: ignore[reportAttributeAccessIssue]
    policy.save(tmp_path)
    env = TaughtEnv(SMALL)
    mappo = Mappo(dataclasses.replace(SMALL, teacher=tmp_path), env, CONTRACT)
    observation = env.reset()
    mappo.act(dataclasses.replace(observation, teacher={"robot": observation.policy["arm"]}))
    teacher_actions = {agent: batch.teacher_actions[0] for agent, batch in mappo.rollout.items()}
    assert torch.equal(teacher_actions["arm"], torch.tensor([0.3, 0.2]).expand(env.num_envs, 2))
    assert torch.equal(teacher_actions["hand"], torch.tensor([0.1]).expand(env.num_envs, 1))


def test_a_teacher_of_another_robot_is_refused(tmp_path: Path):
    hand = AgentContract(observation=(("pixel", 1),), joints=("thumb",))
    Policy(
        dataclasses.replace(CONTRACT, agents=CONTRACT.agents | {"hand": hand}, workcell="other"), SMALL.hidden
    ).save(tmp_path)
    cfg = dataclasses.replace(SMALL, teacher=tmp_path)
    with pytest.raises(PolicyMismatchError, match="'other'; not both move finger, thumb"):
        Mappo(cfg, TaughtEnv(cfg), CONTRACT)
