"""Options of train: fields of task and learning, what a run records, and what it goes on with."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import pytest
import torch

from pixel2catch.cli.main import main, parse
from pixel2catch.envs.catch_env import CatchEnv
from pixel2catch.envs.tasks import TASKS
from pixel2catch.evaluation.loading import load_policy
from pixel2catch.methods import METHODS, find_method
from pixel2catch.policy import Policy
from pixel2catch.scene.constants import OBJECT_RADIUS
from pixel2catch.shipped import policy_folder

SIZE = ("--num-envs", "4", "--rollout-steps", "2", "--mini-batches", "2", "--transitions", "16")
TRAIN = ("train", "only_center", "--device", "cpu", *SIZE, "--hidden", "8")
LATE = ("--env.sensing.latency-steps", "1", "3", "--env.throws.hover-steps", "7", "7")


def test_what_is_set_reaches_the_environment():
    cfg = parse([*TRAIN, "--task", "wide", "--env.variants.0.share=0.5", *LATE]).env
    assert [variant.share for variant in cfg.variants] == [0.5, 0.2, 0.2, 0.1]
    assert cfg.variants[0].sensing == TASKS["wide"].variants[0].sensing
    env = CatchEnv(dataclasses.replace(cfg, variants=()), METHODS["only_center"], num_envs=64)
    try:
        assert set(env.episode.parameters.latency.tolist()) == {1.0, 2.0, 3.0}
        assert set(env.episode.throw.hover_steps.tolist()) == {7}
    finally:
        env.close()


def test_a_given_physics_rate_holds_throughout():
    command = parse([*TRAIN, "--env.scene.physics-hz", "120"])
    assert (command.train.physics_stages, command.env.scene.physics_hz) == ((), 120.0)
    assert command.train.rate_at(0) is None
    assert parse([*TRAIN, "--physics-stages", "60", "120"]).train.physics_stages == (60.0, 120.0)
    assert len(parse(TRAIN).train.physics_stages) == 6


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run for the wide task, with a latency and weights of its own."""
    out = tmp_path_factory.mktemp("own") / "run"
    own = ("--task", "wide", "--preset", "cpu", "--physics-stages", "30", "60")
    assert main([*TRAIN, *LATE, *own, "--out", str(out)]) == 0
    return out


def test_a_run_goes_on_with_its_own_configuration(run: Path, refusal: Any):
    before = json.loads((run / "config.json").read_text())
    for wrong in (("--task", "nominal"), ("--workcell", "ur5e_leap"), ("--preset", "fast")):
        assert wrong[1] in refusal(*TRAIN, *wrong, "--resume", "--out", run)
    assert "only_center" in refusal("train", "proposed", "--resume", "--out", run)
    assert main(["train", "--task", "wide", "--resume", "--transitions", "24", "--out", str(run)]) == 0
    after = json.loads((run / "config.json").read_text())
    assert (before["train"].pop("transitions"), after["train"].pop("transitions")) == (16, 24)
    assert after == before


@pytest.mark.usefixtures("small_cells")
def test_a_policy_is_of_its_task_and_is_evaluated_in_the_papers(run: Path, capsys):
    policy, _ = load_policy(run)
    assert (policy.contract.task, policy.contract.object_radius) == ("wide", OBJECT_RADIUS)
    size = ("--objects", "cube_s", "--num-envs", "2", "--trials", "1", "--env.scene.physics-hz", "60")
    assert main(["evaluate", str(run), *size, "--json"]) == 0
    metrics = json.loads(capsys.readouterr().out)
    assert (metrics["method"], metrics["trials"]) == ("only_center", 2)


def test_a_run_records_terms_and_weights_of_its_agents(tmp_path: Path):
    out = tmp_path / "run"
    rewards = ("--rewards", "arm.success", "5", "arm.drop", "0")
    assert main([*TRAIN, *rewards, "--env.scene.physics-hz", "30", "--out", str(out)]) == 0
    config = json.loads((out / "config.json").read_text())
    assert config["train"]["rewards"] == {"arm.success": 5.0, "arm.drop": 0.0}
    assert config["env"]["name"] == "nominal"
    assert list(config["agents"]) == [agent.name for agent in find_method("only_center").agents]
    assert config["agents"]["arm"]["observation"] == ["pixels", "palm_pose", "joint_pos", "last_action"]
    weights = config["agents"]["arm"]["rewards"]
    assert [weights[f"arm.{name}"] for name in ("success", "drop", "nearness")] == [5.0, 0.0, 0.1]
    text = (out / "summary.json").read_text()  # no episode has ended: rates are null, not NaN
    assert json.loads(text, parse_constant=pytest.fail)["metrics"]["success_rate"] is None


def test_a_training_goes_on_from_a_shipped_policy_by_its_name(tmp_path: Path):
    """Within the transitions in which the value networks alone learn, no weight of the policy moves."""
    small = ("--device", "cpu", *SIZE, "--env.scene.physics-hz", "30", "--out", str(tmp_path / "run"))
    teacher = ("--teacher", "object_position")
    assert main(["train", "catch_alone+fit", *small, *teacher, "--start", "catch_alone+fit"]) == 0
    shipped, trained = (
        Policy.load(policy_folder(path)) for path in (Path("catch_alone+fit"), tmp_path / "run")
    )
    for (name, before), after in zip(shipped.named_parameters(), trained.parameters(), strict=True):
        assert torch.equal(before, after), name
