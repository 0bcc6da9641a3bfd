"""`pixel2catch doctor`, and its probes of wrong installations."""

import importlib.util
import json
import sys
from pathlib import Path

import pytest
import torch
from packaging.specifiers import SpecifierSet

from pixel2catch.cli import doctor as probes
from pixel2catch.cli.main import main
from pixel2catch.findings import check

NEEDED = {"Python", "packages", "policy, physics"}


def examined(capsys: pytest.CaptureFixture[str], *args: str) -> tuple[int | str | None, dict[str, dict]]:
    """Exit status and checks by name."""
    status: int | str | None = 0
    try:
        main(["doctor", "--json", *args])
    except SystemExit as ending:
        status = ending.code
    checks = json.loads(capsys.readouterr().out)["checks"]
    return status, {each["name"]: each for each in checks}


def test_a_machine_that_runs_these_tests_is_well(capsys: pytest.CaptureFixture[str]):
    status, checks = examined(capsys)
    assert status == 0
    assert {name for name, each in checks.items() if each["is_needed"]} == NEEDED
    good = NEEDED | {"OpenCV", "rosbags", "transformers", "torchvision"}
    assert {name for name in good if checks[name]["state"] != "good"} == set()
    assert checks["GPU"]["state"] == ("good" if torch.cuda.is_available() else "absent")


def test_the_table_names_what_to_install(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    """Without the optional packages, all that is needed is still there."""
    find_spec = importlib.util.find_spec
    hidden = "cv2", "rosbags", "transformers", "torchvision"
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name, *more: None if name in hidden else find_spec(name, *more)
    )
    assert main(["doctor"]) == 0
    table = capsys.readouterr().out
    for word in ("[perception]", "[identification]", "[sam2]", "work here"):
        assert word in table


def test_versions_out_of_range_are_named(monkeypatch: pytest.MonkeyPatch):
    ranges = {"numpy": SpecifierSet("<2"), "torch": SpecifierSet(">=2.11"), "no-such-thing": SpecifierSet()}
    monkeypatch.setattr(probes, "requirements", lambda extra="": ranges)
    with pytest.raises(
        probes.Broken, match=r"^numpy 2\.\S+ is not in <2, no-such-thing is missing: \S*.*pip install"
    ):
        probes.packages()
    ranges = {"numpy": SpecifierSet(">=99")}
    with pytest.raises(probes.Broken, match=r"is not in >=99: .*pip install .*\[maths\].* --upgrade"):
        probes.optional("numpy", "numpy", "maths")


def test_a_torchvision_that_does_not_match_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "torchvision.py").write_text("raise RuntimeError('operator torchvision::nms does not exist')")
    monkeypatch.delitem(sys.modules, "torchvision", raising=False)
    monkeypatch.syspath_prepend(tmp_path)
    result = check("torchvision", probes.torchvision)
    assert result.state == "BAD"
    assert "torchvision::nms does not exist" in result.found
    assert "pip uninstall torchvision" in result.found


def test_whatever_a_probe_raises_becomes_a_line():
    def broken() -> str:
        raise OSError("libsomething.so: cannot open shared object file")

    result = check("anything", broken)
    assert (result.state, result.is_needed) == ("BAD", False)
    assert "libsomething.so" in result.found
