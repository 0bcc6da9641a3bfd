"""`pixel2catch doctor`, and its probes of wrong installations."""

import json

import pytest
import torch
from packaging.specifiers import SpecifierSet

from pixel2catch.cli import doctor as probes
from pixel2catch.cli.main import main
from pixel2catch.installation import check

NEEDED = {"packages", "policy, physics"}


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
    good = NEEDED | {"extra perception", "extra identification", "extra sam2", "DDS"}
    assert {name for name in good if checks[name]["state"] != "good"} == set()
    assert checks["GPU"]["state"] == ("good" if torch.cuda.is_available() else "absent")


def test_what_is_missing_or_out_of_range_is_named(monkeypatch, capsys):
    """Without the packages of an extra, all that is needed is still there."""
    ranges = {"numpy": SpecifierSet("<2"), "torch": SpecifierSet(">=2.11"), "no-such-thing": SpecifierSet()}
    with monkeypatch.context() as patch:
        patch.setattr(probes, "requirements", lambda extra="": ranges if extra == "sam2" else {})
        assert main(["doctor"]) == 0
    table = capsys.readouterr().out
    for word in ("is not in <2", "no-such-thing is missing", "[sam2]", "work here"):
        assert word in table
    monkeypatch.setattr(probes, "requirements", lambda extra="": ranges)
    with pytest.raises(probes.Broken, match="pip install"):
        probes.packages()


def test_whatever_a_probe_raises_becomes_a_line():
    def broken() -> str:
        raise OSError("libsomething.so: cannot open shared object file")

    result = check("anything", broken)
    assert (result.state, result.is_needed) == ("BAD", False)
    assert "libsomething.so" in result.found
