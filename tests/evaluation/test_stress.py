"""The stress suite: what it asks, that it asks everyone the same, and the real command."""

import csv
import json
import os
import pickle
from dataclasses import replace
from pathlib import Path
from subprocess import CompletedProcess

import pytest
import torch
from torch import Tensor

from commands import pixel2catch
from pixel2catch.cli.main import main
from pixel2catch.envs.catch_env import CatchEnv
from pixel2catch.envs.cfg import CatchEnvCfg
from pixel2catch.errors import InvalidValueError, StudyError, UnknownNameError
from pixel2catch.evaluation.protocol import EvaluationCfg
from pixel2catch.evaluation.stress.measuring import (
    find_policies,
    in_processes,
    measure,
    throw_rounds,
)
from pixel2catch.evaluation.stress.suite import AXES, Setting, select_settings
from pixel2catch.methods import METHODS, PROPOSED, Method
from pixel2catch.policy import Policy, contract_of
from pixel2catch.scene.objects import SEEN
from pixel2catch.workcells import find_workcell, workcells

SETTINGS = {setting.name: setting for setting in select_settings(())}
TASK = CatchEnvCfg()
SIZE = ("--num-envs", "3", "--trials", "1", "--physics-hz", "30", "--objects", "cube_s", "sphere_l")


class Still:
    """Does nothing at all."""

    def reset(self, is_ended: Tensor | None = None) -> None:
        pass

    def act(self, observations: dict[str, Tensor]) -> dict[str, Tensor]:
        num_envs = len(observations["arm"])
        return {"arm": torch.zeros(num_envs, 6), "hand": torch.zeros(num_envs, 13)}


class Wild(Still):
    """Swings the arm."""

    def act(self, observations: dict[str, Tensor]) -> dict[str, Tensor]:
        return {name: value + 1.0 for name, value in super().act(observations).items()}


def changed(name: str) -> CatchEnvCfg:
    return SETTINGS[name].level.change(TASK)


@pytest.mark.parametrize("setting", SETTINGS.values(), ids=lambda setting: setting.name)
def test_every_level_changes_the_task_and_says_why(setting: Setting):
    assert (setting.level.change(TASK) == TASK) == (setting.axis.name == "nominal")
    assert len(setting.level.source) > 10
    assert pickle.loads(pickle.dumps(setting)) == setting
    assert set(setting.name) <= set("abcdefghijklmnopqrstuvwxyzH0123456789_.-")


@pytest.mark.parametrize("name", sorted(workcells()))
def test_every_level_is_for_every_work_cell(name: str):
    workcell = find_workcell(name)
    for setting in SETTINGS.values():
        setting.level.change(TASK.with_workcell(workcell)).for_workcell(workcell)


def test_settings_have_names_of_their_own():
    settings = select_settings(())
    assert len(SETTINGS) == len(settings) == sum(len(axis.levels) for axis in AXES.values())
    assert len({setting.title for setting in settings}) == len(settings)


def test_values_by_hand():
    assert changed("camera_position-2").sensing == replace(TASK.sensing, camera_offset=0.02)
    assert changed("camera_rotation-1").sensing.camera_turn == pytest.approx(0.0174533)
    assert changed("focal_length-5").sensing.focal_error == pytest.approx(0.05)
    assert changed("drops-15").sensing.drop_rate == pytest.approx(0.15)
    assert changed("mass-60").randomization.mass_scale == (2.0, 2.0)
    assert changed("restitution-0.75").randomization.restitution == (0.75, 0.75)
    assert changed("latency-2.5").sensing.latency_steps == (2.5, 2.5)
    assert changed("clock_error-20_ms").sensing.clock_error == pytest.approx(0.02)
    assert changed("clock_error-no_stamps").sensing.unstamped == 1.0
    late = changed("latency_and_delay-2.5_and_0.5")
    assert (late.sensing.latency_steps, late.randomization.command_delay) == ((2.5, 2.5), (0.5, 0.5))
    assert changed("gains-50").randomization.gains.damping_scale == ((0.5, 1.5),)
    edge = changed("edge_noise-10").sensing
    assert edge.corner_noise + edge.edge_noise == 10.0


def test_a_combination_changes_several_parts():
    flight = changed("together-flight")
    assert (flight.randomization.air_density, flight.throws.spin, flight.throws.release_x) == (
        1.2,
        10.0,
        (2.0, 3.0),
    )
    assert flight.sensing == TASK.sensing
    parts = ("sensing", "randomization", "throws")
    reality = changed("together-reality")
    assert all(getattr(reality, part) != getattr(TASK, part) for part in parts)


def test_settings_come_in_the_order_of_the_tables():
    chosen = select_settings(("latency", "nominal"))
    latencies = ("0", "1", "1.5", "2", "2.5", "3", "3.5", "4", "5")
    assert [setting.name for setting in chosen] == ["nominal", *(f"latency-{n}" for n in latencies)]


def test_an_unknown_axis_is_named():
    with pytest.raises(UnknownNameError, match="camera_position"):
        select_settings(("camera_positon",))


def test_every_round_has_the_throws_of_its_seed_whatever_the_policy_and_the_setting():
    task = replace(TASK, scene=replace(TASK.scene, physics_hz=30.0))
    disturbed = SETTINGS["together-camera_mount"].level.change(task)
    cfg = EvaluationCfg(objects=SEEN, num_envs=3, trials=2, task=task)
    both = throw_rounds(Still(), PROPOSED, cfg).record
    second = throw_rounds(Wild(), PROPOSED, replace(cfg, trials=1, seed=1, task=disturbed)).record
    assert torch.equal(both.object_id[3:], second.object_id)
    assert torch.equal(both.aim[3:], second.aim)
    assert not torch.equal(both.aim[:3], second.aim)


@pytest.fixture(scope="module")
def policies(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """Two untrained policies, one of them inside a run folder."""
    torch.manual_seed(0)
    root, folders = tmp_path_factory.mktemp("runs"), []
    for name, place in (("proposed", "first/policy"), ("only_wh", "second")):
        Policy(contract_of(METHODS[name]), hidden=(16,)).save(root / place)
        folders.append(str(root / place.split("/")[0]))
    return folders


def arguments(policies: list[str], out: Path, *options: str) -> list[str]:
    return ["stress", *policies, "--axes", "nominal", "edge_noise", *SIZE, "--out", str(out), *options]


def files(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.fixture(scope="module")
def measured(
    policies: list[str], tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, CompletedProcess[str]]:
    """A folder of results, and what the command said of it."""
    folder = tmp_path_factory.mktemp("measured")
    return folder, pixel2catch(*arguments(policies, folder, "--json"))


def test_the_command_end_to_end(
    policies: list[str],
    measured: tuple[Path, CompletedProcess[str]],
    capsys: pytest.CaptureFixture[str],
):
    """Four cells and a report; then nothing to do; other throws are refused; a lost cell is made again."""
    folder, printed = measured
    table = json.loads(printed.stdout)
    assert len([line for line in printed.stderr.splitlines() if " of 4: " in line]) == 4
    assert {name: each["method"] for name, each in table["policies"].items()} == {
        "first": "proposed",
        "second": "only_wh",
    }
    assert list(table["settings"]) == ["nominal", "edge_noise-10"]
    assert "not asked for" in table["reality"]["sentence"]
    before = files(folder)
    cells = {f"cells/{policy}/{name}.json" for policy in table["policies"] for name in table["settings"]}
    assert set(before) == cells | {"table.json", "table.csv", "table.md", "table.tex", "heatmap.png"}
    assert json.loads(before["table.json"]) == table
    rows = list(csv.DictReader(before["table.csv"].decode().splitlines()))
    assert [(row["setting"], row["policy"], row["trials"]) for row in rows[:2]] == [
        ("nominal", "first", "3"),
        ("nominal", "second", "3"),
    ]
    assert before["heatmap.png"].startswith(b"\x89PNG")

    assert main(arguments(policies, folder, "--json")) == 0
    again = capsys.readouterr()
    assert " of 4: " not in again.err
    assert again.out == printed.stdout
    assert main(arguments(policies, folder, "--num-envs", "4")) == 2
    refusal = capsys.readouterr().err
    assert "evaluation.num_envs: 3 there, 4 now" in refusal
    assert "--out" in refusal
    assert files(folder) == before

    (folder / "cells/first/edge_noise-10.json").unlink()
    assert main(arguments(policies, folder)) == 0
    mended = capsys.readouterr()
    assert "3 of 4: first, edge noise 10 px" in mended.err
    assert mended.err.count(" of 4: ") == 1
    assert "| edge noise 10 px |" in mended.out
    assert files(folder) == before  # the same throws, the same result


def test_cells_do_not_depend_on_the_number_of_processes(
    policies: list[str],
    measured: tuple[Path, CompletedProcess[str]],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
):
    """One after the other, and two at once: the same files."""
    assert main(arguments(policies, tmp_path, "--jobs", "2")) == 0
    assert capsys.readouterr().err.count(" of 4: ") == 4
    assert files(tmp_path) == files(measured[0])


def test_physics_of_a_process_among_others_takes_one_processor(monkeypatch: pytest.MonkeyPatch):
    seen: list[int] = []
    make_env = EvaluationCfg.make_env

    def watched(cfg: EvaluationCfg, method: Method) -> CatchEnv:
        seen.append(len(os.sched_getaffinity(0)))
        return make_env(cfg, method)

    monkeypatch.setattr(EvaluationCfg, "make_env", watched)
    before = os.sched_getaffinity(0)
    task = replace(TASK, scene=replace(TASK.scene, physics_hz=30.0))
    cfg = EvaluationCfg(objects=SEEN, num_envs=2, trials=1, task=task)
    trials = [throw_rounds(Still(), PROPOSED, cfg, is_alone=is_alone) for is_alone in (True, False)]
    assert seen == [len(before), 1]
    assert os.sched_getaffinity(0) == before
    assert torch.equal(trials[0].record.max_joint_speed, trials[1].record.max_joint_speed)


def test_errors_and_ends_of_processes_are_reported():
    with pytest.raises(InvalidValueError, match="too bad"):
        list(in_processes(1, fail, [("too bad",)]))
    with pytest.raises(StudyError, match="fewer --jobs"):
        list(in_processes(1, os._exit, [(1,)]))


def fail(reason: str) -> None:
    raise InvalidValueError(reason)


@pytest.mark.parametrize(("jobs", "device"), [(0, "cpu"), (2, "cuda")])
def test_impossible_numbers_of_jobs_are_refused(jobs: int, device: str):
    with pytest.raises(InvalidValueError, match="--jobs 1"):
        measure([], EvaluationCfg(objects=SEEN, device=device), jobs=jobs)


def test_a_damaged_cell_and_another_policy_are_refused(
    policies: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    cell = tmp_path / "cells" / "first" / "nominal.json"
    cell.parent.mkdir(parents=True)
    cell.write_text("{")
    assert main(arguments(policies[:1], tmp_path)) == 2
    assert "delete it" in capsys.readouterr().err
    cell.write_text(json.dumps({"policy_sha256": "of another"}))
    assert main(arguments(policies[:1], tmp_path)) == 2
    assert "policy_sha256: of another there" in capsys.readouterr().err
    assert list(files(tmp_path)) == ["cells/first/nominal.json"]


def test_two_policies_of_one_name_are_refused(policies: list[str]):
    with pytest.raises(InvalidValueError, match="'first'"):
        find_policies([Path(policies[0]), Path(policies[0]) / "policy"])


def test_shipped_policies_are_the_default():
    assert "proposed" in {each.method for each in find_policies([])}
