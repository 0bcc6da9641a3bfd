"""Stress and transfer: settings, the same throws for all, reports by hand, and the commands."""

import importlib.util
import json
import os
import pickle
from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import pytest
import torch
from actors import Scripted, still
from test_metrics import five_trials

from pixel2catch.cli.main import main
from pixel2catch.envs.cfg import CatchEnvCfg
from pixel2catch.envs.tasks import TASKS
from pixel2catch.errors import InvalidValueError, UnknownNameError
from pixel2catch.evaluation import policy_cells as cells
from pixel2catch.evaluation.metrics import rate
from pixel2catch.evaluation.protocol import EvaluationCfg
from pixel2catch.evaluation.report import Row
from pixel2catch.evaluation.stress import AXES, Axis, Level, Setting, select_settings
from pixel2catch.methods import METHODS, PROPOSED
from pixel2catch.policy import Policy, contract_of
from pixel2catch.reports import as_markdown
from pixel2catch.scene.objects import SEEN
from pixel2catch.workcells import find_workcell, workcells

SETTINGS = {setting.name: setting for setting in select_settings(())}
TASK = CatchEnvCfg()
SIZE = ("--num-envs", "2", "--trials", "1", "--env.scene.physics-hz", "30", "--objects", "cube_s", "sphere_l")

ENGINES = ("mujoco", "physx")
NEEDS_PHYSX = pytest.mark.skipif(importlib.util.find_spec("sapien") is None, reason="SAPIEN is not installed")


def changed(name: str) -> CatchEnvCfg:
    return SETTINGS[name].level.change(TASK)


def test_every_level_changes_the_task_and_has_a_source():
    for setting in SETTINGS.values():
        assert (setting.level.change(TASK) == TASK) == (setting.axis.name == "nominal")
        assert len(setting.level.source) > 10
        assert pickle.loads(pickle.dumps(setting)) == setting
        assert set(setting.name) <= set("abcdefghijklmnopqrstuvwxyzH0123456789_.-")
    assert len(SETTINGS) == sum(len(axis.levels) for axis in AXES.values())
    assert len({setting.title for setting in SETTINGS.values()}) == len(SETTINGS)


@pytest.mark.parametrize("name", sorted(workcells()))
def test_every_level_is_for_every_work_cell(name: str):
    workcell = find_workcell(name)
    for setting in SETTINGS.values():
        setting.level.change(TASK.with_workcell(workcell)).for_workcell(workcell)


def test_values_by_hand():
    level = Level(label="1", change=lambda task: replace(task, objects=("cube_s",)), source="ours")
    with pytest.raises(InvalidValueError, match="axis 'mine' changes objects; leave"):
        Setting(axis=Axis(name="mine", unit="", levels=(level,)), level=level).changed(TASK)
    assert changed("camera_position-2").sensing == replace(TASK.sensing, camera_offset=0.02)
    assert changed("camera_rotation-1").sensing.camera_turn == pytest.approx(0.0174533)
    assert changed("mass-60").randomization.mass_scale == (2.0, 2.0)
    assert changed("restitution-0.75").randomization.restitution == (0.75, 0.75)
    assert changed("clock_error-20_ms").sensing.clock_error == pytest.approx(0.02)
    assert changed("clock_error-no_stamps").sensing.unstamped == 1.0
    late = changed("latency_and_delay-2.5_and_0.5")
    assert (late.sensing.latency_steps, late.randomization.command_delay) == ((2.5, 2.5), (0.5, 0.5))
    assert changed("gains-50").randomization.gains.damping_scale == ((0.5, 1.5),)
    edge = changed("edge_noise-10").sensing
    assert edge.corner_noise + edge.edge_noise == 10.0
    flight = changed("together-flight")
    assert (flight.randomization.air_density, flight.throws.spin) == (1.2, 10.0)
    assert flight.throws.release_x == (2.0, 3.0)
    assert flight.sensing == TASK.sensing


def test_settings_come_in_the_order_of_the_tables():
    names = [setting.name for setting in select_settings(("mass", "nominal"))]
    assert names == ["nominal", "mass-15", "mass-60"]
    with pytest.raises(UnknownNameError):
        select_settings(("camera_positon",))


@pytest.mark.usefixtures("small_cells")
def test_every_round_has_the_throws_of_its_seed_whatever_the_policy_and_the_setting():
    """Physics among other processes takes one processor, with the same result."""
    task = replace(TASK, scene=replace(TASK.scene, physics_hz=30.0))
    disturbed = SETTINGS["together-camera_mount"].level.change(task)
    cfg = EvaluationCfg(objects=SEEN, num_envs=8, trials=2, task=task)
    processors = os.sched_getaffinity(0)
    both = cells.throw_rounds(still(), PROPOSED, cfg).record
    other = replace(cfg, trials=1, seed=1)
    wild, disturbed = Scripted(lambda _: (1.0, 1.0)), replace(other, task=disturbed)
    second = cells.throw_rounds(wild, PROPOSED, disturbed, is_alone=False).record
    same = cells.throw_rounds(still(), PROPOSED, other, is_alone=False).record
    assert os.sched_getaffinity(0) == processors
    for record in (second, same):
        assert torch.equal(both.object_id[8:], record.object_id)
    assert not torch.equal(both.object_id[:8], second.object_id)
    assert torch.equal(both.max_joint_speed[8:], same.max_joint_speed)
    envs = [each.make_env(PROPOSED) for each in (other, disturbed)]
    for env in envs:
        env.seed(1)
        env.reset()
    assert torch.equal(*(env.episode.throw.lin_vel for env in envs))


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
    task = ("--axes", "nominal", "edge_noise", "--camera", "people")
    return ["stress", *policies, *task, *SIZE, "--out", str(out), *options]


def files(folder: Path) -> dict[str, bytes]:
    """All files but table.json, which names the command and the time."""
    paths = (path for path in folder.rglob("*") if path.is_file() and path.name != "table.json")
    return {str(path.relative_to(folder)): path.read_bytes() for path in paths}


@pytest.mark.usefixtures("small_cells")
def test_the_command_end_to_end(policies: list[str], tmp_path: Path, refusal: Any, capsys: Any):
    """Four cells and a report; a lost cell is made again."""
    assert main(arguments(policies, tmp_path)) == 0
    printed = capsys.readouterr()
    assert "4 of 4: second-edge_noise-10 done" in printed.err
    assert "first: the policy was trained for another camera" in printed.err
    before = files(tmp_path)
    settings = ("nominal", "edge_noise-10")
    written = {f"cells/{policy}/{name}.json" for policy in ("first", "second") for name in settings}
    assert set(before) == written | {"table.md"}
    assert before["table.md"].decode() == printed.out
    rows = json.loads((tmp_path / "table.json").read_text())["results"]
    assert [(row["setting"], row["policy"], row["method"], row["trials"]) for row in rows[:2]] == [
        ("nominal", "first", "proposed", 2),
        ("nominal", "second", "only_wh", 2),
    ]
    assert "evaluation.seed: 0 there, 3 now" in refusal(*arguments(policies, tmp_path, "--seed", "3"))

    (tmp_path / "cells/first/edge_noise-10.json").unlink()
    assert main(arguments(policies, tmp_path)) == 0
    assert capsys.readouterr().err.count(" of 4: ") == 1
    assert files(tmp_path) == before


def test_a_cell_has_the_events_of_each_throw(
    policies: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(cells, "throw_rounds", lambda *_, **__: five_trials())
    cfg, file = EvaluationCfg(objects=("cube_s",)), tmp_path / "cell.json"
    cells.measure(Path(policies[0]), cfg, True, {}, file, "cpu")
    throws = json.loads(file.read_text())["metrics"]["throws"]
    assert throws == {"is_tracked": "11011", "is_success": "11000", "is_verified": "10000"}


def test_a_damaged_cell_and_another_policy_are_refused(policies: list[str], tmp_path: Path, refusal: Any):
    cell = tmp_path / "cells" / "first" / "nominal.json"
    cell.parent.mkdir(parents=True)
    for content, words in (("{", "delete it"), ('{"policy_sha256": "other"}', "policy_sha256: other there")):
        cell.write_text(content)
        assert words in refusal(*arguments(policies[:1], tmp_path))
    assert list(files(tmp_path)) == ["cells/first/nominal.json"]


def test_policies_have_names_of_their_own(policies: list[str]):
    with pytest.raises(InvalidValueError, match="'first'"):
        cells.find_policies([Path(policies[0]), Path(policies[0]) / "policy"])
    assert "proposed" in {each.method for each in cells.find_policies([])}


def content(caught: str) -> dict[str, Any]:
    """A cell in which throws are caught or dropped."""
    found: dict[str, Any] = {"trials": len(caught), "failures": {"dropped": caught.count("0") / len(caught)}}
    for name in cells.EVENTS:
        found |= rate(name, caught.count("1"), len(caught))
    return {"metrics": found | {"throws": dict.fromkeys(cells.EVENTS.values(), caught)}}


def rows_of(
    folder: Path, methods: dict[str, str], settings: Sequence[Setting], *caught: str, task: str = "nominal"
) -> list[Row]:
    """Rows of policies with their methods, whose throws are given setting by setting."""
    policies = [
        cells.PolicyEntry(name=name, folder=Path(name), method=method, task=TASKS[task])
        for name, method in methods.items()
    ]
    for (setting, policy), each in zip(product(settings, policies), caught, strict=True):
        file = cells.cell_file(folder, policy, setting)
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(json.dumps(content(each)))
    return cells.result_rows(policies, settings, folder, settings[0].axis)


def of_200(number: int) -> str:
    return "1" * number + "0" * (200 - number)


def test_a_table_by_hand(tmp_path: Path):
    """Means over two settings; 180 of 200 is 90.0 % with the interval 85 to 93."""
    methods, settings = {"one": "proposed", "two": "only_wh"}, select_settings(("nominal", "edge_noise"))
    rows = rows_of(tmp_path, methods, settings, *map(of_200, (180, 10, 20, 0)))
    text = as_markdown("Stress suite", cells.stress_sections(rows))
    assert "| nominal | 90.0 [85, 93] | 5.0 [3, 9] |" in text
    assert "| mean over settings | 50.0 | 2.5 |" in text


@pytest.mark.parametrize(("task", "mount"), [("nominal", False), ("wide", True)])
def test_what_a_policy_was_not_trained_on_is_marked(task: str, mount: bool, tmp_path: Path):
    """Camera mount: not in the nominal task, but in the wide one; edge noise in neither."""
    settings = select_settings(("edge_noise", "together"))
    rows = rows_of(tmp_path, {"one": "proposed"}, settings, *[of_200(180)] * 5, task=task)
    marks = {row["setting"]: row["is_trained_on"] for row in rows}
    assert (marks["edge_noise-10"], marks["together-camera_mount"]) == (False, mount)
    text = as_markdown("Stress suite", cells.stress_sections(rows))
    assert "| edge noise 10 px | 90.0 [85, 93] † |" in text
    assert ("| together camera mount | 90.0 [85, 93] |" in text) == mount


def test_settings_change_the_engine_and_the_restitution_alone():
    settings = cells.transfer_settings(ENGINES, (0.0, 0.25))
    assert [each.name for each in settings] == ["mujoco-0", "physx-0", "mujoco-0.25", "physx-0.25"]
    changed = settings[3].level.change(TASK)
    assert (changed.scene.engine, changed.randomization.restitution) == ("physx", (0.25, 0.25))
    assert (changed.sensing, changed.throws) == (TASK.sensing, TASK.throws)
    home, other = cells.transfer_settings(ENGINES, ())
    assert home.level.change(TASK) == TASK
    assert (other.level.label, other.level.change(TASK).randomization) == (
        cells.AS_TRAINED,
        TASK.randomization,
    )


def test_the_tables_compare_each_engine_with_home(tmp_path: Path):
    """Intervals are Wilson's, of four throws."""
    methods = {"one": "proposed", "two": "proposed"}
    rows = rows_of(
        tmp_path, methods, cells.transfer_settings(ENGINES, (0.5,)), "1111", "1100", "0111", "1110"
    )
    text = as_markdown("Transfer", cells.transfer_sections(rows))
    assert "| one | 0.5 | mujoco | 100.0 [51, 100] |" in text
    assert "| one | 0.5 | physx | 75.0 [30, 95] | 75.0 [30, 95] | 75.0 [30, 95] | -25.0 [" in text
    assert "| 0, 1 | 1 |" in text.splitlines()[-1]


def test_nothing_bounces_in_drake(tmp_path: Path):
    """Its cells at other restitutions are left out, unless home has no other engine's restitution then."""
    settings = cells.transfer_settings(("mujoco", "drake"), (0.0, 0.25))
    assert [each.name for each in settings] == ["mujoco-0", "drake-0", "mujoco-0.25"]
    for engines, restitutions in ((("mujoco", "drake"), (0.25,)), (("drake", "mujoco"), (0.0, 0.25))):
        with pytest.raises(InvalidValueError, match="'drake': give --restitution 0"):
            cells.transfer_settings(engines, restitutions)
    rows = rows_of(tmp_path, {"one": "proposed"}, settings, "11", "10", "01")
    assert "| one | 0 | drake | 50.0 [" in as_markdown("Transfer", cells.transfer_sections(rows))


@NEEDS_PHYSX
def test_transfer_away(policies: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    size = ("--num-envs", "2", "--trials", "1", "--objects", "cube_s", "--env.scene.physics-hz", "120")
    assert main(["stress", policies[1], *size, "--out", str(tmp_path), "--engines", *ENGINES]) == 0
    assert f"| second | {cells.AS_TRAINED} | physx |" in capsys.readouterr().out
