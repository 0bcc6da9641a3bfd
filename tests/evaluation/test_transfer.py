"""Policies in other engines: pairs of throws by hand, the tables, and the command."""

import importlib.util
import json
from dataclasses import replace
from itertools import product
from pathlib import Path

import pytest
import torch

from pixel2catch.cli.main import main
from pixel2catch.envs.cfg import CatchEnvCfg
from pixel2catch.errors import InvalidValueError
from pixel2catch.evaluation.metrics import rate
from pixel2catch.evaluation.policy_cells import (
    AS_TRAINED,
    EVENTS,
    PolicyEntry,
    cell_file,
    transfer_settings,
)
from pixel2catch.evaluation.policy_report import result_rows, transfer_sections
from pixel2catch.evaluation.report import Row, read_rows
from pixel2catch.methods import METHODS
from pixel2catch.policy import Policy, contract_of
from pixel2catch.reports import as_markdown

ENGINES = ("mujoco", "physx")
NEEDS_PHYSX = pytest.mark.skipif(importlib.util.find_spec("sapien") is None, reason="SAPIEN is not installed")


def test_settings_change_the_engine_and_the_restitution_alone():
    task = CatchEnvCfg()
    settings = transfer_settings(ENGINES, (0.0, 0.25))
    assert [each.name for each in settings] == ["mujoco-0", "physx-0", "mujoco-0.25", "physx-0.25"]
    changed = settings[3].level.change(task)
    assert (changed.scene.engine, changed.randomization.restitution) == ("physx", (0.25, 0.25))
    assert (changed.sensing, changed.throws) == (task.sensing, task.throws)
    home, other = transfer_settings(ENGINES, ())
    assert home.level.change(task) == task
    assert (other.level.label, other.level.change(task).randomization) == (AS_TRAINED, task.randomization)


def content(caught: str) -> dict:
    """A cell in which throws are caught or dropped."""
    found: dict = {"trials": len(caught), "failures": {"dropped": caught.count("0") / len(caught)}}
    for name in EVENTS:
        found |= rate(name, caught.count("1"), len(caught))
    return {"metrics": found | {"throws": dict.fromkeys(EVENTS.values(), caught)}}


def rows_of(folder: Path, methods: dict[str, str], settings, *caught: str) -> list[Row]:
    """Rows of policies with their methods, whose throws are given setting by setting."""
    policies = [PolicyEntry(name=name, folder=Path(name), method=method) for name, method in methods.items()]
    for (setting, policy), each in zip(product(settings, policies), caught, strict=True):
        file = cell_file(folder, policy, setting)
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(json.dumps(content(each)))
    return result_rows(
        policies, settings, folder, lambda setting: replace(setting, axis=settings[0].axis).name
    )


def test_the_tables_compare_each_engine_with_home(tmp_path: Path):
    """Intervals are Wilson's, of four throws."""
    methods = {"one": "proposed", "two": "proposed"}
    rows = rows_of(tmp_path, methods, transfer_settings(ENGINES, (0.5,)), "1111", "1100", "0111", "1110")
    text = as_markdown("Transfer", transfer_sections(rows))
    assert "| one | 0.5 | mujoco | 100.0 [51, 100] |" in text
    assert "| one | 0.5 | physx | 75.0 [30, 95] | 75.0 [30, 95] | 75.0 [30, 95] | -25.0 [" in text
    assert "| 0, 1 | 1 |" in text.splitlines()[-1]


def test_nothing_bounces_in_drake(tmp_path: Path):
    """Its cells at other restitutions are left out, unless home has no other engine's restitution then."""
    settings = transfer_settings(("mujoco", "drake"), (0.0, 0.25))
    assert [each.name for each in settings] == ["mujoco-0", "drake-0", "mujoco-0.25"]
    for engines, restitutions in ((("mujoco", "drake"), (0.25,)), (("drake", "mujoco"), (0.0, 0.25))):
        with pytest.raises(InvalidValueError, match="'drake': give --restitution 0"):
            transfer_settings(engines, restitutions)
    rows = rows_of(tmp_path, {"one": "proposed"}, settings, "11", "10", "01")
    assert "| one | 0 | drake | 50.0 [" in as_markdown("Transfer", transfer_sections(rows))


@pytest.fixture(scope="module")
def policy(tmp_path_factory: pytest.TempPathFactory) -> str:
    """An untrained policy."""
    torch.manual_seed(0)
    folder = tmp_path_factory.mktemp("runs") / "untrained"
    Policy(contract_of(METHODS["proposed"]), hidden=(16,)).save(folder)
    return str(folder)


def arguments(policy: str, out: Path, *options: str) -> list[str]:
    return ["transfer", policy, "--throws", "2", "--objects", "cube_s", "--out", str(out), *options]


def test_the_command_at_home(policy: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """The cell has the events of each throw; the same command again has nothing to compute."""
    coarse = arguments(
        policy, tmp_path, "--engines", "mujoco", "--restitution", "0", "--env.scene.physics-hz", "30"
    )
    assert main(coarse) == 0
    printed = capsys.readouterr()
    assert "1 of 1: untrained-mujoco-0 done" in printed.err
    assert main(coarse) == 0
    again = capsys.readouterr()
    assert ("done" in again.err, again.out) == (False, printed.out)
    assert {path.name for path in tmp_path.iterdir()} == {"cells", "table.md", "table.json", "heatmap.png"}
    (row,) = read_rows(tmp_path / "table.json")
    metrics = json.loads((tmp_path / "cells/untrained/mujoco-0.json").read_text())["metrics"]
    assert (row["trials"], len(metrics["throws"]["is_success"])) == (2, 2)
    assert metrics["throws"]["is_tracked"].count("1") == 2 * metrics["tracking_rate"]


@NEEDS_PHYSX
def test_the_command_away(policy: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    assert main(arguments(policy, tmp_path, "--env.scene.physics-hz", "120")) == 0
    assert f"| untrained | {AS_TRAINED} | physx |" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--engines", "bullet"), "unknown engine 'bullet'. Valid: mujoco, physx, drake"),
        (("--engines", "mujoco", "--throws", "30"), "throws is 30"),
        (("--engines", "mujoco", "--restitution", "1.5"), "restitution is 1.5"),
    ],
)
def test_refused_options(policy, tmp_path, capsys, options, message):
    assert main(arguments(policy, tmp_path / "out", *options)) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
