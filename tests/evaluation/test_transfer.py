"""Policies in other engines: pairs of throws by hand, the tables, and the real command."""

import csv
import importlib.util
import json
from pathlib import Path

import pytest
import torch

from pixel2catch.circumstances import circumstances
from pixel2catch.cli import transfer as command
from pixel2catch.cli.main import main
from pixel2catch.envs.cfg import CatchEnvCfg
from pixel2catch.errors import InvalidValueError
from pixel2catch.evaluation.metrics import paired_difference
from pixel2catch.evaluation.stress.measuring import PolicyEntry, find_policies, measure, plan_results
from pixel2catch.evaluation.stress.report import REAL_ROBOT
from pixel2catch.evaluation.transfer.cells import AS_TRAINED, pooled, throw_metrics, transfer_settings
from pixel2catch.evaluation.transfer.report import as_csv, as_markdown, as_page, make_table, picture
from pixel2catch.methods import METHODS
from pixel2catch.policy import Policy, contract_of

ENGINES = ("mujoco", "physx")
NEEDS_PHYSX = pytest.mark.skipif(importlib.util.find_spec("sapien") is None, reason="SAPIEN is not installed")


def test_a_paired_difference_by_hand():
    """Of ten throws one is won and three are lost: -20 points; McNemar's p is 2 (4 + 1) / 16."""
    found = paired_difference("1111110000", "0001110010")
    assert (found["lost"], found["won"], found["difference"]) == (3, 1, -0.2)
    assert found["p_value"] == pytest.approx(0.625)
    half = 1.959964 * (5 - 4 / 12) ** 0.5 / 12
    assert found["difference_interval"] == pytest.approx([-2 / 12 - half, -2 / 12 + half])


def test_equal_throws_differ_by_nothing():
    found = paired_difference("1101", "1101")
    assert (found["difference"], found["p_value"]) == (0.0, 1.0)
    assert found["difference_interval"][0] < 0.0 < found["difference_interval"][1]


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
    """A cell in which throws are caught or dropped, and every second catch holds."""
    rate, low, high = caught.count("1") / len(caught), 0.1, 0.9
    names = ("tracking_rate", "success_rate", "verified_hold_rate")
    rates = {name: rate for name in names} | {f"{name}_interval": [low, high] for name in names}
    throws = {"is_tracked": caught, "is_success": caught, "is_verified": caught}
    failures = {"never_reached": 0.0, "dropped": 1.0 - rate}
    counts = {"trials": len(caught), "throws": throws, "failures": failures, "max_penetration": 0.1 * rate}
    return {"metrics": {**rates, **counts}}


def test_the_tables_compare_each_engine_with_home():
    policies = [PolicyEntry(name=name, folder=Path(name), method="proposed") for name in ("one", "two")]
    results = plan_results(policies, transfer_settings(ENGINES, (0.5,)), Path("out"))
    assert [(each.policy.name, each.setting.axis.name) for each in results][:2] == [
        ("one", "mujoco"),
        ("two", "mujoco"),
    ]
    table = make_table(results, [content(c)["metrics"] for c in ("1111", "1100", "0111", "1110")])
    text = as_markdown(table)
    assert not table["orders"]
    assert "| one | 0.5 | mujoco | 100.0 [10, 90] |" in text
    assert "| one | 0.5 | physx | 75.0 [10, 90] | 75.0 [10, 90] | 75.0 [10, 90] | -25.0 [" in text
    assert "| 0, 1 | 1 |" in text.splitlines()[-1]
    rows = list(csv.DictReader(as_csv(table).splitlines()))
    assert len(rows) == 4 * 3
    assert [row["lost"] for row in rows if row["rate"] == "success_rate"] == ["", "", "1", "0"]
    assert picture(table).startswith(b"\x89PNG")


def test_nothing_bounces_in_drake():
    """Its cells at other restitutions are left out, where it is not the only engine that could have them."""
    settings = transfer_settings(("mujoco", "drake"), (0.0, 0.25))
    assert [each.name for each in settings] == ["mujoco-0", "mujoco-0.25", "drake-0"]
    for engines, restitutions in ((("mujoco", "drake"), (0.25,)), (("drake", "mujoco"), (0.0, 0.25))):
        with pytest.raises(
            InvalidValueError, match="nothing bounces in engine 'drake': give --restitution 0"
        ):
            transfer_settings(engines, restitutions)
    policies = [PolicyEntry(name="one", folder=Path("one"), method="proposed")]
    results = plan_results(policies, settings, Path("out"))
    table = make_table(results, [content(caught)["metrics"] for caught in ("11", "10", "01")])
    assert "| one | 0 | drake | 50.0 [10, 90] |" in as_markdown(table)
    assert picture(table).startswith(b"\x89PNG")


def test_rounds_are_pooled():
    """Three of four and one of two: four of six; of its failures two sixths are drops."""
    found = pooled([content("1110"), content("01")])
    assert (found["trials"], found["throws"]["is_success"]) == (6, "111001")
    assert found["success_rate"] == pytest.approx(4 / 6)
    assert found["success_rate_interval"] == pytest.approx([0.300, 0.903], abs=1e-3)  # Wilson's, by hand
    assert found["failures"] == pytest.approx({"never_reached": 0.0, "dropped": 2 / 6})
    assert found["max_penetration"] == pytest.approx(0.075)


def test_the_order_of_the_methods_is_compared_in_every_engine():
    """At home as on the real robot; in the other engine the best two change places."""
    methods = ("proposed", "single_agent", "only_wh")
    policies = [PolicyEntry(name=name, folder=Path(name), method=name) for name in methods]
    results = plan_results(policies, transfer_settings(ENGINES, (0.5,)), Path("out"))
    caught = ("1111", "1100", "0000", "1100", "1111", "0000")
    table = make_table(results, [content(c)["metrics"] for c in caught])
    assert [each["tau"] for each in table["orders"]] == pytest.approx([1.0, 1 / 3])
    violation = REAL_ROBOT["proposed"] - REAL_ROBOT["single_agent"]
    assert [each["rank_violation"] for each in table["orders"]] == pytest.approx([0.0, 2 * violation / 3])
    page = as_page(table, picture(table), circumstances())
    assert "<td>single_agent &gt; proposed &gt; only_wh</td>" in page
    assert page.count("data:image/png;base64,") == 1
    assert "| physx | 0.5 | single_agent > proposed > only_wh | 0.33 | 14.0 | 1 of 3 |" in as_markdown(table)


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
    """An estimate, two cells and a report; then nothing to do."""
    options = ("--engines", "mujoco", "--restitution", "0", "0.5", "--physics-hz", "30", "--json")
    assert main(arguments(policy, tmp_path, *options)) == 0
    printed = capsys.readouterr()
    assert "2 rounds of 2 throws to do: about" in printed.err
    table = json.loads(printed.out)
    assert [(cell["engine"], cell["restitution"]) for cell in table["cells"]] == [
        ("mujoco", "0"),
        ("mujoco", "0.5"),
    ]
    names = {path.name for path in tmp_path.iterdir()}
    assert names == {"cells", "table.md", "table.csv", "table.json", "heatmap.png", "page.html"}
    cell = json.loads((tmp_path / "cells/untrained/mujoco-0.5.json").read_text())
    assert len(cell["metrics"]["throws"]["is_success"]) == 2
    assert main(arguments(policy, tmp_path, *options)) == 0
    again = capsys.readouterr()
    assert "to do" not in again.err
    assert again.out == printed.out


def test_rounds_have_the_throws_of_the_whole(
    policy: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two rounds, each a job of its own, are what one evaluation of two rounds is."""
    monkeypatch.setattr(command, "THROWS_AT_ONCE", 2)
    made = command.Transfer(
        policies=(Path(policy),),
        engines=("mujoco",),
        restitution=(0.0,),
        throws=4,
        objects=("cube_s",),
        physics_hz=30.0,
        out=tmp_path,
    )
    made.run()
    assert len([*tmp_path.glob("cells/untrained/mujoco-0/round-*.json")]) == 2
    (cell,) = json.loads((tmp_path / "table.json").read_text())["cells"]
    whole = plan_results(
        find_policies((Path(policy),)), transfer_settings(("mujoco",), (0.0,)), tmp_path / "whole"
    )
    (content,) = measure(whole, made._evaluation(), summarize=throw_metrics)
    assert cell["throws"] == content["metrics"]["trials"] == 4
    assert cell["success_rate"]["rate"] == content["metrics"]["success_rate"]
    rounds = [
        json.loads(path.read_text()) for path in sorted(tmp_path.glob("cells/untrained/mujoco-0/*.json"))
    ]
    for name, texts in content["metrics"]["throws"].items():
        assert texts == "".join(each["metrics"]["throws"][name] for each in rounds)


@NEEDS_PHYSX
def test_the_command_away(policy: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    assert main(arguments(policy, tmp_path, "--physics-hz", "120")) == 0
    assert f"| untrained | {AS_TRAINED} | physx |" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--engines", "bullet"), "unknown engine 'bullet'. Valid: mujoco, physx, drake"),
        (("--engines", "mujoco", "mujoco"), "engines is mujoco mujoco; name each once"),
        (("--engines", "mujoco", "--throws", "30"), "throws is 30; it must be at most 20, or a multiple"),
        (("--engines", "mujoco", "--restitution", "1.5"), "restitution is 1.5; it must be from 0 to 1"),
    ],
)
def test_what_cannot_be_is_refused(policy, tmp_path, capsys, options, message):
    assert main(arguments(policy, tmp_path / "out", *options)) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
