import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from made_up import SESSION, plan, write_evaluation, write_study, write_training

from pixel2catch.errors import StudyError
from pixel2catch.evaluation.comparison.plan import ComparisonFolder, Run
from pixel2catch.methods import PROPOSED
from pixel2catch.policy import Policy, contract_of

RUN = Run(method="proposed", seed=0)


def test_every_method_has_one_seed_before_any_has_two():
    names = [run.name for run in plan().runs()]
    assert names == ["only_wh-seed0", "proposed-seed0", "only_wh-seed1", "proposed-seed1"]


def test_another_configuration_is_refused_with_names_and_values(tmp_path: Path):
    folder = write_study(tmp_path)
    before = (tmp_path / "study.json").read_bytes()
    with pytest.raises(StudyError, match=r"training lr: 0\.1 in the study, 0\.2 now"):
        folder.open(plan(configuration={"training lr": 0.2}), [SESSION])
    assert (tmp_path / "study.json").read_bytes() == before


def test_methods_and_seeds_may_be_added(tmp_path: Path):
    folder = write_study(tmp_path)
    folder.open(plan(methods=("single_agent",), seeds=3), [SESSION])
    assert folder.plan() == plan(methods=("only_wh", "proposed", "single_agent"), seeds=3)
    assert len(folder.sessions()) == 2


def test_configuration_may_change_as_long_as_nothing_is_there(tmp_path: Path):
    folder = ComparisonFolder(tmp_path)
    folder.open(plan(), [])
    folder.open(plan(configuration={"training lr": 0.2}), [])
    assert folder.plan().configuration == {"training lr": 0.2}


@pytest.mark.parametrize("content", [None, "{"])
def test_results_without_a_readable_study_are_left_alone(content: str | None, tmp_path: Path):
    folder = write_study(tmp_path)
    (tmp_path / "study.json").unlink()
    if content:
        (tmp_path / "study.json").write_text(content)
    with pytest.raises(StudyError, match=r"study\.json"):
        folder.open(plan(), [])


@pytest.mark.parametrize("content", ["", "{", json.dumps({"status": "interrupted"})])
def test_only_a_finished_training_is_done(content: str, tmp_path: Path):
    folder = ComparisonFolder(tmp_path)
    write_training(folder, RUN)
    assert folder.is_trained(RUN)
    (folder.run(RUN) / "summary.json").write_text(content)
    assert not folder.is_trained(RUN)


def test_a_result_counts_for_its_own_policy_only(tmp_path: Path):
    folder = ComparisonFolder(tmp_path)
    write_training(folder, RUN)
    assert folder.result(RUN, "seen") is None
    write_evaluation(folder, RUN, "seen", successes=3)
    assert folder.result(RUN, "seen") is not None
    torch.manual_seed(0)
    Policy(contract_of(PROPOSED), hidden=(4,)).save(folder.run(RUN) / "policy")
    assert folder.result(RUN, "seen") is None


def test_a_run_without_a_checkpoint_starts_anew(tmp_path: Path):
    folder = ComparisonFolder(tmp_path)
    write_training(folder, RUN)
    other = replace(RUN, seed=1)
    write_training(folder, other)
    (folder.run(other) / "checkpoint.pt").touch()
    assert not folder.prepare(RUN)
    assert not folder.run(RUN).exists()
    assert folder.prepare(other)
    assert folder.metrics(other).exists()
