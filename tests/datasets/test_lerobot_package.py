"""LeRobot itself loads what is exported: with LEROBOT_PYTHON=/path/to/python, a Python that has lerobot 0.4.

It has requirements that are not those of this package, so it has an environment of its own:
`python3.11 -m venv lerobot && lerobot/bin/pip install lerobot==0.4.4`, with FFmpeg for its torchcodec.
"""

import json
import os
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from test_recordings import NUM_JOINTS, RUNNING, record

from pixel2catch.cli.main import main

PYTHON = os.environ.get("LEROBOT_PYTHON", "")
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not PYTHON, reason="LEROBOT_PYTHON names no Python with lerobot"),
]


def judged(folder: Path) -> dict[str, Any]:
    command = [PYTHON, str(Path(__file__).with_name("judge.py")), str(folder)]
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    done = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


def test_a_recording(tmp_path: Path) -> None:
    """Every number of `test_recordings`, images included, and the action of the step after."""
    recording, out = record(tmp_path / "bag", "raw"), tmp_path / "out"
    assert main(["export", str(recording), "--format", "lerobot", "--out", str(out)]) == 0
    found = judged(out)
    assert (found["num_episodes"], found["num_steps"], found["fps"]) == (2, len(RUNNING), 30)
    assert [row[0] for row in found["state"]] == RUNNING
    assert [now[0] for now, _ in found["actions"]] == [100.0 + step for step in RUNNING]
    assert [after[0] for _, after in found["actions"][:-1]] == [102, 103, 104, 105, 105, 109, 110, 111]
    assert [after for _, after in found["is_pad"]] == found["done"]
    assert found["brightness"] == pytest.approx([20 * step for step in RUNNING], abs=4)
    assert found["image_shape"] == [3, 48, 64]
    assert found["batch"] == [len(RUNNING), 3, 48, 64]
    assert found["mean"] == pytest.approx([100.0 + np.mean(RUNNING)] * NUM_JOINTS)
    assert found["image_mean"] == [3, 1, 1]
    assert set(found["tasks"]) == {"Catch the thrown object."}
