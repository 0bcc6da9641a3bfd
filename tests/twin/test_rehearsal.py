"""`pixel2catch rehearse`, whole: twin, deployment and operator as processes, images and all."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from domains import own_domain
from pixel2catch.cli.main import main


@pytest.mark.usefixtures("opengl")
def test_a_throw_is_rehearsed_and_reported(tmp_path: Path, monkeypatch, capsys):
    """Processes, network and report; `test_stepped` has what is thrown and caught, in time that is stepped.

    On a busy machine images are late, and the robot may be stopped before the throw: then that is said.
    """
    monkeypatch.setenv("ROS_DOMAIN_ID", own_domain())
    out, recording = tmp_path / "rehearsal", tmp_path / "tape"
    args = ["rehearse", "--throws", "1", "--clock", "0.2", "--seed", "3"]
    assert main([*args, "--out", str(out), "--record", str(recording)]) == 0
    report = json.loads((out / "report.json").read_text())
    assert "throws in" in capsys.readouterr().out
    (throw,) = report["throws"]
    assert report["success_rate"] == float(throw["is_success"])
    assert report["deploy"]["num_ticks"] > 100
    assert report["twin"]["joint_speed"] < 2.8
    assert (recording / "tape.mcap").stat().st_size > 1_000_000
    assert " cycles, " in (out / "twin.txt").read_text().splitlines()[-1]  # it ends in order
    if throw["object"] is None:
        assert "did not come within" in throw["problem"], throw["problem"]
    else:
        assert report["deploy"]["image_to_command_ms"]["count"] > 20
        assert report["deploy"]["stops"]


PARENT = """
import time
from multiprocessing import get_context
from pixel2catch.interruption import end_with_parent

def wait():
    end_with_parent()
    print(1, flush=True)
    time.sleep(600)

child = get_context("fork").Process(target=wait)
child.start()
child.join()
"""


def test_a_child_ends_with_its_killed_parent():
    """As the process that draws, and those of pages."""
    parent = subprocess.Popen([sys.executable, "-c", PARENT], stdout=subprocess.PIPE)
    assert parent.stdout is not None
    assert parent.stdout.readline() == b"1\n"
    parent.kill()
    assert parent.stdout.read() == b""  # the pipe is closed when the child has ended, too
    parent.communicate()
