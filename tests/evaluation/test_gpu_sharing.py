"""The MPS daemon is ours from beginning to end; without one nothing is promised."""

import os
from pathlib import Path

import pytest

from pixel2catch.evaluation.comparison.jobs import MPS_CONTROL, shared_gpus

RECORDER = """#!/bin/sh
echo "$CUDA_MPS_PIPE_DIRECTORY [$*] $(if [ "$1" != -d ]; then cat; fi)" >> "$RECORD"
exit "${STATUS:-0}"
"""


@pytest.fixture
def record(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A control program that writes down how it was called; the real one needs a GPU."""
    program = tmp_path / MPS_CONTROL
    program.write_text(RECORDER)
    program.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    monkeypatch.setenv("RECORD", str(tmp_path / "record"))
    monkeypatch.delenv("CUDA_MPS_PIPE_DIRECTORY", raising=False)
    return tmp_path / "record"


def test_a_daemon_starts_and_quits_in_a_folder_of_its_own(record):
    with shared_gpus() as variables:
        folder = variables["CUDA_MPS_PIPE_DIRECTORY"]
        assert Path(folder).is_dir()
    assert record.read_text().splitlines() == [f"{folder} [-d] ", f"{folder} [] quit"]
    assert not Path(folder).exists()


def test_a_daemon_that_does_not_start_is_not_promised(record, monkeypatch):
    monkeypatch.setenv("STATUS", "1")
    with shared_gpus() as variables:
        assert variables == {}
    assert len(record.read_text().splitlines()) == 1


def test_the_callers_daemon_is_left_alone(record, monkeypatch):
    monkeypatch.setenv("CUDA_MPS_PIPE_DIRECTORY", "/elsewhere")
    with shared_gpus() as variables:
        assert variables == {}
    assert not record.exists()
