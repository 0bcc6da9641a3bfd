"""Commands with their defaults: help, devices, shipped policies, and what evaluate prints."""

import hashlib
import json
import re
import subprocess
import sys
from dataclasses import fields, replace
from pathlib import Path

import pytest
import training_costs

from pixel2catch.camera.camera_file import CameraFile
from pixel2catch.cli.console import TABLE_WIDTH, results_console
from pixel2catch.cli.fields import HIDDEN
from pixel2catch.cli.main import COMMANDS, main, parse
from pixel2catch.cli.reproduce import METHODS
from pixel2catch.evaluation.loading import load_policy, sha256
from pixel2catch.learning.config import TrainCfg
from pixel2catch.learning.experiment import preset
from pixel2catch.mdp.dynamics_file import DynamicsFile
from pixel2catch.methods import PROPOSED, find_method
from pixel2catch.policy import Policy, contract_of
from pixel2catch.scene.constants import RGB_CAMERA
from pixel2catch.shipped import DEFAULT_POLICY, shipped_policies


def test_nothing_heavy_is_imported_before_it_is_used():
    check = """
import sys, pixel2catch
assert not {'torch', 'mujoco', 'numpy'} & set(sys.modules)
import pixel2catch.cli.main
for args in (["--help"], ["train", "--help"]):
    try:
        pixel2catch.cli.main.main(args)
    except SystemExit:
        assert not {'torch', 'mujoco', 'warp', 'scipy'} & set(sys.modules)
    else:
        raise AssertionError(args)
"""
    assert subprocess.run([sys.executable, "-c", check], check=False, capture_output=True).returncode == 0


def test_a_default_folder_that_is_there_gets_a_number(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    for name in ("track", "track-2", "track-3"):
        assert parse(["track", "0"]).out == Path(name)
        Path(name).mkdir()


@pytest.mark.parametrize("name", shipped_policies())
def test_shipped_policies_fit_this_code(name: str):
    """They are called as their method, or as another work cell."""
    policy, method = load_policy(Path(name))
    own = policy.contract.workcell
    assert (method.name if own == "ur5e_allegro" else own) == name


def test_shipped_policies_of_every_compared_method():
    """One of each compared method, policies for laboratories and their teacher, other robots."""
    expected = {*METHODS, "catch_alone+fit", "catch_alone+anycamera", "catch_teacher+age"}
    assert set(shipped_policies()) == expected | {"fr3_allegro", "two_ur5e_allegro", "ur5e_leap"}
    assert load_policy(None)[1] == find_method(DEFAULT_POLICY)


@pytest.mark.usefixtures("small_cells")
def test_evaluate_prints_one_json_object(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    Policy(contract_of(PROPOSED), hidden=(16,)).save(tmp_path)
    files = {name: tmp_path / f"{name}.json" for name in ("dynamics", "camera")}
    DynamicsFile().save(files["dynamics"])
    CameraFile(camera=replace(RGB_CAMERA, pos=(-0.4, 0.0, 2.2)), focal_std=0.01).save(files["camera"])
    given = [argument for name, file in files.items() for argument in (f"--{name}", str(file))]
    size = ("--num-envs", "4", "--trials", "1", "--env.scene.physics-hz", "60")
    args = ("--objects", "cube_s", "cone_l", *size, "--json")
    assert main(["evaluate", str(tmp_path), *args, *given]) == 0
    output = capsys.readouterr()
    assert "trained for another camera" in output.err
    assert f"next: pixel2catch play {tmp_path}" in output.err
    metrics = json.loads(output.out)
    assert (metrics["trials"], metrics["physics_hz"]) == (4, 60.0)
    assert metrics["objects_thrown"] == ["cube_s", "cone_l"]
    assert set(metrics["objects"]) <= {"cube_s", "cone_l"}
    assert metrics["policy"] == str(tmp_path)
    for name, file in files.items():
        assert metrics[f"{name}_sha256"] == hashlib.sha256(file.read_bytes()).hexdigest()
    assert sha256(Path("people")) == "people"  # a camera without a file
    assert metrics.keys() >= {"success_rate_interval", "verified_hold_rate", "failures"}


def test_the_costs_of_a_training_are_those_of_its_parts(tmp_path: Path):
    out = tmp_path / "costs.json"
    training_costs.main(["--num-envs", "4", "--updates", "1", "--out", str(out)])
    (row,) = json.loads(out.read_text())["results"]
    assert (row["device"], row["num_envs"]) == ("cpu", 4)
    parts = [row[f"{part}_us"] for part in ("rollout", "update")]
    assert min(parts) > 0.0
    assert sum(parts) == pytest.approx(1e6 / row["training_steps_per_second"])
    assert row["rss_bytes"] > 1e8 > row["device_bytes"]


def help_of(capsys: pytest.CaptureFixture[str], *args: str) -> str:
    with pytest.raises(SystemExit) as ending:
        main([*args])
    assert ending.value.code == 0
    return capsys.readouterr().out


def test_help_is_short(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("COLUMNS", "100")
    lines = help_of(capsys, "--help").splitlines()
    assert [line.split()[0] for line in lines if line.startswith("  ")] == [*COMMANDS]
    assert max(len(line) for line in lines if line.startswith("  ")) <= 80
    brief, whole = (help_of(capsys, "train", f"--help{more}") for more in ("", "-all"))
    assert len(brief.splitlines()) <= 80
    groups = re.findall(r"(?m)^\W{1,3}(\w+)(?: options| arguments)?\W*$", brief)
    assert groups == ["positional", "options", "task", "learner", "imitation", "machine"]
    for name in HIDDEN:
        option = f"--{name.replace('_', '-')} "
        assert (option in brief, option in whole) == (False, True), name


def test_train_has_and_explains_every_option_of_its_configuration(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "100")
    text = " ".join(help_of(capsys, "train", "--help-all").replace("│", "").split())
    assert "None" not in text
    for field in fields(TrainCfg):
        flag = f"--{field.name.replace('_', '-')}" + ("" if field.default is False else r" [A-Z{\[]\S*")
        said = re.search(rf"{flag} .*?[A-Z].*?(\(default: .*?\)|Default: .*?\.)", text)
        assert said, field.name
        if type(field.default) in (int, float, str) and field.default != "cuda":
            assert said[1].startswith(f"(default: {field.default}"), field.name


def test_what_is_not_given_to_train_is_of_the_preset():
    for args, expected in (
        (["--preset", "paper", "--seed", "4"], preset("paper", device="cpu", seed=4)),
        ([], preset("cpu")),
    ):
        command = parse(["train", "--device", "cpu", *args])
        assert (command.train, command.env) == (expected.train, expected.env)


def test_a_terminal_without_a_width_gets_whole_tables(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("COLUMNS", "0")
    assert results_console().width == TABLE_WIDTH
