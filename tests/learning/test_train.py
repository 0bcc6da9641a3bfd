"""Whole trainings of a small task, and everything that can get in their way."""

import contextlib
import json
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch
from reaching import CONTRACT, SMALL, ReachingCfg, ReachingEnv, during_step, rows, summary

from domains import full_disk
from pixel2catch.errors import CheckpointError, InvalidValueError, NonFiniteError, PolicyMismatchError
from pixel2catch.learning.checkpoint import RunFolder
from pixel2catch.learning.config import TrainCfg
from pixel2catch.learning.gradient_step import GradientStep
from pixel2catch.learning.log import CsvLog
from pixel2catch.learning.train import train
from pixel2catch.policy import Policy


def test_it_learns(tmp_path: Path) -> None:
    """Both agents must push towards the goal: random pushes reach it in half of the episodes."""
    cfg = replace(SMALL, transitions=24 * 1024)
    result = train(cfg, ReachingEnv, CONTRACT, tmp_path / "run")
    assert float(rows(tmp_path / "run")[0]["success_rate"]) < 0.65
    assert result.metrics["success_rate"] > 0.97
    assert all(result.metrics[f"action_std/{agent}"] < 1.0 for agent in CONTRACT.agents)
    env = ReachingEnv(replace(cfg, seed=9))
    policy, observation = Policy.load(result.policy), env.reset()
    for _ in range(50):
        observation = env.step(policy.act(observation.policy)).observation
    assert env.statistics.pop()["success_rate"] > 0.97
    assert env.num_steps == 50


def test_run_folder(tmp_path: Path) -> None:
    result = train(SMALL, ReachingEnv, CONTRACT, tmp_path / "run", record={"preset": "cpu"})
    assert result.status == "finished"
    assert [int(row["transitions"]) for row in rows(tmp_path / "run")] == [1024, 2048, 3072, 4096]
    config = json.loads((tmp_path / "run/config.json").read_text())
    assert config["train"] == asdict(SMALL) | {"hidden": [64, 64], "physics_stages": []}
    assert config["preset"] == "cpu"
    assert config["policy"] == CONTRACT.to_dict()
    session = json.loads((tmp_path / "run/sessions.json").read_text())[0]
    assert session["versions"]["torch"] == torch.__version__
    ended = summary(tmp_path / "run")
    assert (ended["status"], ended["transitions"]) == ("finished", 4096)
    assert 0 < ended["seconds"] < 100
    assert list((tmp_path / "run").glob("events.out.tfevents.*"))
    assert Policy.load(result.policy).contract == CONTRACT
    assert not list((tmp_path / "run").rglob("*.tmp*"))


def test_resumed_training_equals_an_uninterrupted_one(tmp_path: Path) -> None:
    """With environments that begin anew at the same points, as a resumed training begins new episodes."""

    class RestartingEnv(ReachingEnv):
        def step(self, actions: dict[str, torch.Tensor]) -> Any:
            step = super().step(actions)
            if self.num_steps % (2 * SMALL.rollout_steps) == 0:
                self.generator.manual_seed(SMALL.seed)
                self.reset()
            return step

    one_go = train(SMALL, RestartingEnv, CONTRACT, tmp_path / "one_go")
    half = replace(SMALL, transitions=2048, final_learning_rate=5.5e-4)
    train(half, RestartingEnv, CONTRACT, tmp_path / "halves")
    resumed = train(SMALL, RestartingEnv, CONTRACT, tmp_path / "halves", resume=True)
    expected, found = (Policy.load(result.policy).state_dict() for result in (one_go, resumed))
    assert all(torch.equal(expected[name], found[name]) for name in expected)
    assert [row["transitions"] for row in rows(tmp_path / "halves")] == ["1024", "2048", "3072", "4096"]
    assert resumed.seconds > 0
    assert len(json.loads((tmp_path / "halves/sessions.json").read_text())) == 2


def test_resume_drops_what_is_repeated(tmp_path: Path) -> None:
    log = CsvLog(tmp_path / "metrics.csv")
    for transitions in (10, 20, 30):
        log.add({"transitions": transitions, "reward": 0.5})
    log.write()
    resumed = CsvLog(tmp_path / "metrics.csv", transitions=20)
    resumed.add({"transitions": 30, "reward": 0.25, "extra": 1.0})
    resumed.write()
    expected = "transitions,reward,extra\n10,0.5,\n20,0.5,\n30,0.25,1\n"
    assert (tmp_path / "metrics.csv").read_text() == expected


def test_two_trainings_do_not_write_into_one_folder(tmp_path: Path):
    folder = RunFolder(tmp_path / "run")
    with folder.open(resume=False):
        with pytest.raises(InvalidValueError, match="is in use by another"), folder.open(resume=False):
            pass
        assert folder.path.exists()
    assert not folder.path.exists()


def test_a_run_folder_is_not_overwritten(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match="no checkpoint to resume; start without --resume"):
        train(SMALL, ReachingEnv, CONTRACT, tmp_path, resume=True)
    train(SMALL, ReachingEnv, CONTRACT, tmp_path)
    with pytest.raises(CheckpointError, match="holds a run already; name another folder, or add --resume"):
        train(SMALL, ReachingEnv, CONTRACT, tmp_path)


def test_no_empty_folder_stays_behind(tmp_path: Path) -> None:
    def fail(*_: object) -> Any:
        raise InvalidValueError("no such task")

    (tmp_path / "mine").mkdir()
    for folder in ("runs/a", "mine"):
        with pytest.raises(InvalidValueError, match="no such task"):
            train(SMALL, fail, CONTRACT, tmp_path / folder)
    assert [path.name for path in tmp_path.iterdir()] == ["mine"]


def test_damaged_or_foreign_checkpoints(tmp_path: Path) -> None:
    train(SMALL, ReachingEnv, CONTRACT, tmp_path)
    with pytest.raises(PolicyMismatchError, match=r"method: .*'reaching'.*'other'"):
        train(SMALL, ReachingEnv, replace(CONTRACT, method="other"), tmp_path, resume=True)
    with pytest.raises(CheckpointError, match=r"(?s)does not fit this configuration.*size mismatch"):
        train(replace(SMALL, hidden=(64, 32)), ReachingEnv, CONTRACT, tmp_path, resume=True)
    for name in ("metrics.csv", "sessions.json"):
        (tmp_path / name).write_text("{\n{")
        with pytest.raises(CheckpointError, match=rf"{name}.*Remove this file"):
            train(SMALL, ReachingEnv, CONTRACT, tmp_path, resume=True)
    checkpoint = tmp_path / "checkpoint.pt"
    checkpoint.write_bytes(checkpoint.read_bytes()[:1000])
    with pytest.raises(CheckpointError, match="is damaged"):
        train(SMALL, ReachingEnv, CONTRACT, tmp_path, resume=True)


@pytest.mark.parametrize(
    ("quantity", "step", "name"),
    [
        ("hand/reward", 20, "reward of agent 'hand'"),
        ("arm/position", 20, "observation term 'position' of agent 'arm'"),
        ("any/state", 32, "value input"),
    ],
)
def test_nan_is_named_and_never_learnt_from(quantity: str, step: int, name: str, tmp_path: Path) -> None:
    """The first update is of good steps, the second of steps 17 to 32; the checkpoint is of the first."""
    cfg = replace(SMALL, checkpoint_seconds=0.0)
    task = ReachingCfg(bad_step=step, bad_quantity=quantity)
    with pytest.raises(NonFiniteError, match=name):
        train(cfg, partial(ReachingEnv, task=task), CONTRACT, tmp_path)
    assert summary(tmp_path)["status"] == "failed"
    state = torch.load(tmp_path / "failure.pt", weights_only=True)
    assert any(name in each for each in state["not_finite"])
    assert json.loads(state["config"])["train"]["num_envs"] == SMALL.num_envs
    rollouts = [tensor for batch in state["rollout"].values() for tensor in batch.values()]
    assert not all(tensor.isfinite().all() for tensor in (*rollouts, *state["rewards"].values()))
    assert all(tensor.isfinite().all() for tensor in Policy.load(tmp_path / "policy").state_dict().values())
    resumed = train(cfg, ReachingEnv, CONTRACT, tmp_path, resume=True)
    assert resumed.transitions == 4096
    assert len(rows(tmp_path)) == 4


def test_the_last_good_update_is_logged_when_the_next_fails(tmp_path: Path) -> None:
    """A row is written while the next rollout is collected, which fails here."""

    def fail() -> None:
        raise NonFiniteError("the physics broke")

    with pytest.raises(NonFiniteError, match="the physics broke"):
        train(SMALL, during_step(20, fail), CONTRACT, tmp_path)
    assert [row["transitions"] for row in rows(tmp_path)] == ["1024"]


def test_nan_in_the_networks_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    apply = GradientStep.apply

    def spoil(step: GradientStep) -> None:
        apply(step)
        step._networks.parts["value"][0].data.fill_(torch.nan)

    monkeypatch.setattr(GradientStep, "apply", spoil)
    with pytest.raises(NonFiniteError, match=r"value network of agent 'arm'"):
        train(SMALL, ReachingEnv, CONTRACT, tmp_path)


def test_full_disk(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Training goes on and says so; the old checkpoint and policy stay valid; the end is an error."""
    train(SMALL, ReachingEnv, CONTRACT, tmp_path)
    files = tmp_path / "checkpoint.pt", *(tmp_path / "policy").iterdir()
    before = {path: path.read_bytes() for path in files}
    longer = replace(SMALL, transitions=8192, checkpoint_seconds=0.0)
    message = r"could not be written.*earlier checkpoint there is still good"
    with contextlib.ExitStack() as stack:
        fill = during_step(0, lambda: stack.enter_context(full_disk(5000)))
        with pytest.raises(CheckpointError, match=message):
            train(longer, fill, CONTRACT, tmp_path, resume=True)
    assert "warning: could not write checkpoint" in capsys.readouterr().out
    assert before == {path: path.read_bytes() for path in files}
    assert not list(tmp_path.rglob("*.tmp*"))
    assert train(longer, ReachingEnv, CONTRACT, tmp_path, resume=True).transitions == 8192
    capsys.readouterr()
    with contextlib.ExitStack() as stack, pytest.raises(CheckpointError, match="no earlier checkpoint"):
        train(SMALL, during_step(0, lambda: stack.enter_context(full_disk(5000))), CONTRACT, tmp_path / "new")
    assert "finished" not in capsys.readouterr().out


def test_metrics_survive_a_full_disk(tmp_path: Path) -> None:
    log = CsvLog(tmp_path / "metrics.csv")
    log.add({"transitions": 10})
    log.write()
    with full_disk(limit=20):
        for transitions in (20, 30):
            log.add({"transitions": transitions})
        with pytest.raises(OSError, match=r"File too large|no space"):
            log.write()
    assert [row["transitions"] for row in rows(tmp_path)] == ["10"]
    log.write()
    assert [row["transitions"] for row in rows(tmp_path)] == ["10", "20", "30"]


def test_nan_in_a_reward_term_is_named(tmp_path: Path) -> None:
    def make(cfg: TrainCfg, _: float | None) -> Any:
        env = ReachingEnv(cfg)
        env.statistics.time_penalty = float("nan")
        return env

    with pytest.raises(NonFiniteError, match=r"reward_term/arm\.time"):
        train(SMALL, make, CONTRACT, tmp_path)


@pytest.mark.parametrize("staggered", [True, False])
def test_physics_rates_share_the_training(staggered: bool, tmp_path: Path) -> None:
    """Of four rollouts three begin in the first two thirds; at the change the environments are new.

    The simulation is checked once a rollout. A resume in the last stage makes only its environments.
    """
    made: list[Any] = []

    def make_env(cfg: TrainCfg, physics_hz: float | None) -> Any:
        made.append(ReachingEnv(cfg, physics_hz))
        return made[-1]

    cfg = replace(SMALL, physics_stages=(120.0, 120.0, 240.0), staggered=staggered)
    train(cfg, make_env, CONTRACT, tmp_path)
    assert [env.physics_hz for env in made] == [120.0, 240.0]
    assert [env.num_steps for env in made] == [3 * SMALL.rollout_steps, SMALL.rollout_steps]
    assert [env.num_checks for env in made] == [3, 1]
    assert [env.staggered_resets for env in made] == [[staggered], [staggered]]
    assert [cfg.rate_at(n) for n in (0, 2730, 2731, 4095, 4096)] == [120.0, 120.0, 240.0, 240.0, 240.0]
    longer = replace(cfg, transitions=5120)
    train(longer, make_env, CONTRACT, tmp_path, resume=True)
    assert [env.physics_hz for env in made] == [120.0, 240.0, 240.0]
    assert all(env.is_closed for env in made)
