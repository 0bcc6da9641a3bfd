"""The benchmark's reader of a real robot's log folders, on a folder made here."""

from pathlib import Path

import numpy as np
import pytest
from recorded import clean, position
from ur5_recordings import read_ur5

from pixel2catch.errors import RecordingError
from pixel2catch.identification.checks import check_recording


def test_log_folders_are_read_and_a_bad_line_is_named(tmp_path: Path):
    """Logs as the robot's: six digits, no line of names."""
    recording = clean()
    time = recording.t_meas
    logs = {
        "log_q_target.csv": np.column_stack([time, position(time)]),
        "log_q_actual.csv": np.column_stack([time, recording.q]),
    }
    for name, values in logs.items():
        np.savetxt(tmp_path / name, values, delimiter=", ", fmt="%.6f")
    checks = check_recording(read_ur5(tmp_path))
    assert not [check for check in checks if check.is_good is False]
    assert checks[0].detail.startswith("4000 times in 8.0 s, median step 2.0 ms")
    lines = (tmp_path / "log_q_actual.csv").read_text().splitlines()
    (tmp_path / "log_q_actual.csv").write_text("\n".join([*lines[:7], lines[7][:-10], *lines[8:]]))
    with pytest.raises(RecordingError, match=r"log_q_actual\.csv.*line 8: 6 columns instead of 7"):
        read_ur5(tmp_path)
