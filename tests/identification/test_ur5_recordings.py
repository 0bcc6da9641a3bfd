"""The benchmark's reader of a real robot's log folders, run as a user runs it, on a folder made here."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from recorded import clean, position, rows, speed
from ur5_recordings import read_ur5

from pixel2catch.errors import RecordingError

SCRIPT = Path(__file__).parents[2] / "benchmarks" / "ur5_recordings.py"


def write_logs(folder: Path) -> Path:
    """Logs as the robot's: six digits, no line of names, fewer rows of speed than of position."""
    folder.mkdir()
    recording = clean()
    time = recording.t_meas
    logs = {
        "log_q_target.csv": np.column_stack([time, position(time)]),
        "log_q_actual.csv": rows(recording),
        "log_qd_actual.csv": np.column_stack([time, speed(time - 0.06)])[:-10],
    }
    for name, values in logs.items():
        np.savetxt(folder / name, values, delimiter=", ", fmt="%.6f")
    return folder


def check(*folders: Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(SCRIPT), *map(str, folders)]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def test_log_folders_are_checked(tmp_path: Path):
    result = check(write_logs(tmp_path / "first"), write_logs(tmp_path / "second"))
    assert result.returncode == 0, result.stderr
    for name in ("first", "second"):
        assert f"{name}: 0 of 25 checks failed" in result.stdout
    assert result.stdout.count("4000 times in 8.0 s, median step 2.0 ms") == 4


def test_error_names_the_log(tmp_path: Path):
    folder = write_logs(tmp_path / "run")
    lines = (folder / "log_q_actual.csv").read_text().splitlines()
    (folder / "log_q_actual.csv").write_text("\n".join([*lines[:7], lines[7][:-10], *lines[8:]]))
    with pytest.raises(RecordingError, match=r"log_q_actual\.csv, line 8: 6 columns instead of 7"):
        read_ur5(folder)
