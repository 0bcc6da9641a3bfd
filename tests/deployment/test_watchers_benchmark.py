"""The watchers on a recording that was made up: a joint with a lag of 30 ms, from which real ones differ."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from domains import PATIENCE

BENCHMARK = Path(__file__).parents[2] / "benchmarks" / "watchers_on_recordings.py"


@pytest.mark.slow
def test_a_joint_that_follows_is_not_stopped_and_its_lag_is_seen(tmp_path: Path):
    time = np.arange(0.0, 6.0, 0.002)
    target = 0.5 * np.sin(2.0 * time)
    position = np.zeros(len(time))
    for tick in range(1, len(time)):
        position[tick] = position[tick - 1] + 0.002 / 0.03 * (target[tick - 1] - position[tick - 1])
    rows = (f"{t},{q},{p}" for t, q, p in zip(time, target, position, strict=True))
    table = tmp_path / "joint.csv"
    table.write_text("time,q_des,q_act\n" + "\n".join(rows) + "\n")
    asked = [sys.executable, str(BENCHMARK), str(table), "--out", str(tmp_path / "figures.json")]
    said = subprocess.run(asked, check=True, capture_output=True, text=True, timeout=PATIENCE).stdout
    assert "[30" in said
    assert "joint" in said
    assert not any(word in said for word in ("tracking error", "joints frozen (", "implausible"))
    assert (tmp_path / "figures.json").exists()
