"""Policies in other engines: pairs of throws by hand, the tables, and the command."""

import importlib.util
import json
from pathlib import Path

import pytest
import torch

from pixel2catch.cli import transfer as command
from pixel2catch.cli.fields import TaskOptions
from pixel2catch.cli.main import main
from pixel2catch.envs.cfg import CatchEnvCfg
from pixel2catch.errors import InvalidValueError
from pixel2catch.evaluation.grid import StudyGrid
from pixel2catch.evaluation.metrics import paired_difference
from pixel2catch.evaluation.policy_cells import (
    PolicyEntry,
    PolicyResult,
    find_policies,
    plan_results,
    policy_cells,
)
from pixel2catch.evaluation.report import Row, read_rows
from pixel2catch.evaluation.slots import ThisProcess
from pixel2catch.evaluation.stress_report import REAL_ROBOT
from pixel2catch.evaluation.transfer import (
    AS_TRAINED,
    order_rows,
    pooled,
    throw_metrics,
    transfer_rows,
    transfer_sections,
    transfer_settings,
)
from pixel2catch.methods import METHODS
from pixel2catch.policy import Policy, contract_of
from pixel2catch.reports import as_markdown
from pixel2catch.scene.scene import SceneCfg

ENGINES = ("mujoco", "physx")
NEEDS_PHYSX = pytest.mark.skipif(importlib.util.find_spec("sapien") is None, reason="SAPIEN is not installed")


def test_a_paired_difference_by_hand():
    """Of ten throws one is won and three are lost: -20 points; McNemar's p is 2 (4 + 1) / 16."""
    found = paired_difference("1111110000", "0001110010")
    assert (found["lost"], found["won"], found["difference"]) == (3, 1, -0.2)
    assert found["p_value"] == pytest.approx(0.625)
    half = 1.959964 * (5 - 4 / 12) ** 0.5 / 12
    assert found["difference_interval"] == pytest.approx([-2 / 12 - half, -2 / 12 + half])
    equal = paired_difference("1101", "1101")
    assert (equal["difference"], equal["p_value"]) == (0.0, 1.0)
    assert equal["difference_interval"][0] < 0.0 < equal["difference_interval"][1]


def test_settings_change_the_engine_and_the_restitution_alone():
    task = CatchEnvCfg()
    settings = transfer_settings(ENGINES, (0.0, 0.25))
    assert [each.name for each in settings] == ["mujoco-0", "mujoco-0.25", "physx-0", "physx-0.25"]
    changed = settings[3].level.change(task)
    assert (changed.scene.engine, changed.randomization.restitution) == ("physx", (0.25, 0.25))
    assert (changed.sensing, changed.throws) == (task.sensing, task.throws)
    home, other = transfer_settings(ENGINES, ())
    assert home.level.change(task) == task
    assert (other.level.label, other.level.change(task).randomization) == (AS_TRAINED, task.randomization)


def content(caught: str) -> dict:
    """A cell in which throws are caught or dropped."""
    rate, low, high = caught.count("1") / len(caught), 0.1, 0.9
    names = ("tracking_rate", "success_rate", "verified_hold_rate")
    rates = {name: rate for name in names} | {f"{name}_interval": [low, high] for name in names}
    throws = {"is_tracked": caught, "is_success": caught, "is_verified": caught}
    failures = {"never_reached": 0.0, "dropped": 1.0 - rate}
    counts = {"trials": len(caught), "throws": throws, "failures": failures, "max_penetration": 0.1 * rate}
    return {"metrics": {**rates, **counts}}


def rows_of(folder: Path, methods: dict[str, str], settings, *caught: str) -> list[Row]:
    """Rows of policies with their methods, whose throws are given setting by setting."""
    policies = [PolicyEntry(name=name, folder=Path(name), method=method) for name, method in methods.items()]
    results = plan_results(policies, settings, folder)
    for result, each in zip(results, caught, strict=True):
        write(result, each)
    return transfer_rows(results, 1)


def write(result: PolicyResult, caught: str) -> None:
    result.file.parent.mkdir(parents=True, exist_ok=True)
    result.file.write_text(json.dumps(content(caught)))


def test_the_tables_compare_each_engine_with_home(tmp_path: Path):
    """Intervals are Wilson's, of four throws."""
    methods = {"one": "proposed", "two": "proposed"}
    rows = rows_of(tmp_path, methods, transfer_settings(ENGINES, (0.5,)), "1111", "1100", "0111", "1110")
    text = as_markdown("Transfer", transfer_sections(rows, []))
    assert "| one | 0.5 | mujoco | 100.0 [51, 100] |" in text
    assert "| one | 0.5 | physx | 75.0 [30, 95] | 75.0 [30, 95] | 75.0 [30, 95] | -25.0 [" in text
    assert "| 0, 1 | 1 |" in text.splitlines()[-1]


def test_nothing_bounces_in_drake(tmp_path: Path):
    """Its cells at other restitutions are left out, unless home has no other engine's restitution then."""
    settings = transfer_settings(("mujoco", "drake"), (0.0, 0.25))
    assert [each.name for each in settings] == ["mujoco-0", "mujoco-0.25", "drake-0"]
    for engines, restitutions in ((("mujoco", "drake"), (0.25,)), (("drake", "mujoco"), (0.0, 0.25))):
        with pytest.raises(InvalidValueError, match="'drake': give --restitution 0"):
            transfer_settings(engines, restitutions)
    rows = rows_of(tmp_path, {"one": "proposed"}, settings, "11", "10", "01")
    assert "| one | 0 | drake | 50.0 [" in as_markdown("Transfer", transfer_sections(rows, []))


def test_rounds_are_pooled():
    """Three of four and one of two: four of six; of its failures two sixths are drops."""
    found = pooled([content("1110"), content("01")])
    assert (found["trials"], found["throws"]["is_success"]) == (6, "111001")
    assert found["success_rate"] == pytest.approx(4 / 6)
    assert found["success_rate_interval"] == pytest.approx([0.300, 0.903], abs=1e-3)  # Wilson's, by hand
    assert found["failures"] == pytest.approx({"never_reached": 0.0, "dropped": 2 / 6})
    assert found["max_penetration"] == pytest.approx(0.075)


def test_the_order_of_the_methods_is_compared_in_every_engine(tmp_path: Path):
    """At home as on the real robot; in the other engine the best two change places."""
    methods = {name: name for name in ("proposed", "single_agent", "only_wh")}
    caught = ("1111", "1100", "0000", "1100", "1111", "0000")
    rows = rows_of(tmp_path, methods, transfer_settings(ENGINES, (0.5,)), *caught)
    orders = list(order_rows(rows))
    assert [each["tau"] for each in orders] == pytest.approx([1.0, 1 / 3])
    violation = REAL_ROBOT["proposed"] - REAL_ROBOT["single_agent"]
    assert [each["rank_violation"] for each in orders] == pytest.approx([0.0, 2 * violation / 3])
    text = as_markdown("Transfer", transfer_sections(rows, orders))
    assert "| physx | 0.5 | single_agent > proposed > only_wh | 0.33 | 14.0 | 1 of 3 |" in text


@pytest.fixture(scope="module")
def policy(tmp_path_factory: pytest.TempPathFactory) -> str:
    """An untrained policy."""
    torch.manual_seed(0)
    folder = tmp_path_factory.mktemp("runs") / "untrained"
    Policy(contract_of(METHODS["proposed"]), hidden=(16,)).save(folder)
    return str(folder)


def arguments(policy: str, out: Path, *options: str) -> list[str]:
    return ["transfer", policy, "--throws", "2", "--objects", "cube_s", "--out", str(out), *options]


def test_rounds_have_the_throws_of_the_whole(
    policy: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Two rounds, each a cell of its own, are what one evaluation of two rounds is; then nothing is to do."""
    monkeypatch.setattr(command, "THROWS_AT_ONCE", 2)
    physics = CatchEnvCfg(scene=SceneCfg(physics_hz=30.0))
    coarse = TaskOptions(env=physics, given=("scene.physics_hz",))
    made = command.Transfer(
        policies=(Path(policy),),
        engines=("mujoco",),
        restitution=(0.0,),
        throws=4,
        objects=("cube_s",),
        task=coarse,
        out=tmp_path,
    )
    made.run()
    printed = capsys.readouterr()
    assert "2 of 2: untrained-mujoco-0-round-1 done" in printed.err
    made.run()
    again = capsys.readouterr()
    assert ("done" in again.err, again.out) == (False, printed.out)
    names = {"cells", "table.md", "table.json", "heatmap.png"}
    assert {path.name for path in tmp_path.iterdir()} == names
    (row,) = read_rows(tmp_path / "table.json")
    settings = [coarse.beneath(each, "transfer") for each in transfer_settings(("mujoco",), (0.0,))]
    (whole,) = plan_results(find_policies((Path(policy),)), settings, tmp_path / "whole")
    StudyGrid(policy_cells([whole], made._evaluation(), throw_metrics)).run([ThisProcess("", "cpu")])
    metrics = (whole.read() or {})["metrics"]
    assert (row["trials"], row["success_rate"]) == (4, metrics["success_rate"])
    files = sorted(tmp_path.glob("cells/untrained/mujoco-0/round-*.json"))
    rounds = [json.loads(path.read_text())["metrics"]["throws"] for path in files]
    for name, texts in metrics["throws"].items():
        assert texts == "".join(each[name] for each in rounds)


@NEEDS_PHYSX
def test_the_command_away(policy: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    assert main(arguments(policy, tmp_path, "--env.scene.physics-hz", "120")) == 0
    assert f"| untrained | {AS_TRAINED} | physx |" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--engines", "bullet"), "unknown engine 'bullet'. Valid: mujoco, physx, drake"),
        (("--engines", "mujoco", "mujoco"), "engines is mujoco mujoco"),
        (("--engines", "mujoco", "--throws", "30"), "throws is 30"),
        (("--engines", "mujoco", "--restitution", "1.5"), "restitution is 1.5"),
    ],
)
def test_refused_options(policy, tmp_path, capsys, options, message):
    assert main(arguments(policy, tmp_path / "out", *options)) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
