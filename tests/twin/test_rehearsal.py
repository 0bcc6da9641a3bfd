"""`pixel2catch rehearse`, whole: twin, deployment and operator as processes, images and all."""

import json
from pathlib import Path

import pytest

from domains import own_domain
from pixel2catch.cli.main import main
from pixel2catch.errors import DeviceUnavailableError
from pixel2catch.rendering.renderer import find_gl_backend


def test_a_throw_is_rehearsed_and_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    """It may fail to catch on a busy machine; that it was thrown, judged, stopped and recorded may not."""
    try:
        find_gl_backend()
    except DeviceUnavailableError as error:
        pytest.skip(str(error))
    monkeypatch.setenv("ROS_DOMAIN_ID", "0")
    out, recording = tmp_path / "rehearsal", tmp_path / "tape"
    args = ["rehearse", "--throws", "1", "--clock", "0.1", "--seed", "3", "--json", "--domain", own_domain()]
    assert main([*args, "--out", str(out), "--record", str(recording)]) == 0
    report = json.loads(capsys.readouterr().out)
    assert json.loads((out / "report.json").read_text()) == report
    (throw,) = report["throws"]
    assert throw["object"] is not None, throw
    assert report["success_rate"] == float(throw["is_success"])
    assert report["deploy"]["image_to_command_ms"]["count"] > 20
    assert report["deploy"]["stops"]
    assert report["twin"]["joint_speed"] < 2.8
    assert (recording / "tape.mcap").stat().st_size > 1_000_000


@pytest.mark.parametrize(
    ("args", "words"),
    [
        (["--throws", "0"], "throws is 0"),
        (["--clock", "2"], "clock"),
        (["--plain"], "--lockstep: add it"),
        (["--lockstep", "--clock", "0.5"], "--clock is for real time"),
        (["--lockstep", "--perception-ms", "-1"], "perception_ms is -1"),
        (["--lockstep", "--perception-jitter-ms", "nan"], "perception_jitter_ms is nan"),
        (["--perception-jitter-ms", "5"], "go with --lockstep: add it"),
        (["--clock-error-ms", "-5"], "go with --lockstep: add it"),
    ],
)
def test_nonsense_is_refused_before_anything_starts(
    args: list[str], words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    assert main(["rehearse", *args, "--out", str(tmp_path / "out")]) == 2
    assert words in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
