"""LeRobot itself loads what is exported: with LEROBOT_PYTHON=/path/to/python, a Python that has lerobot 0.4.

It needs an environment of its own, with FFmpeg:
`python3.11 -m venv lerobot && lerobot/bin/pip install lerobot==0.4.4`.
"""

import json
import os
import subprocess
from pathlib import Path

import pytest
from test_recordings import RUNNING, record

from pixel2catch.cli.main import main

PYTHON = os.environ.get("LEROBOT_PYTHON", "")
LOAD = """
import json, sys
from lerobot.datasets.lerobot_dataset import LeRobotDataset
data = LeRobotDataset("local/judged", root=sys.argv[1], delta_timestamps={"action": [0.0, 1.0 / 30.0]})
image = "observation.images.rgb"
rows = [
    (float(row["observation.state"][0]), row["action"][:, 0].tolist(), float(255 * row[image].mean()))
    for row in (data[i] for i in range(len(data)))
]
print(json.dumps([data.num_episodes, data.fps, list(data.meta.stats[image]["mean"].shape), rows]))
"""


@pytest.mark.slow
@pytest.mark.skipif(not PYTHON, reason="LEROBOT_PYTHON names no Python with lerobot")
def test_lerobot_loads_a_recording(tmp_path: Path) -> None:
    """Numbers and images of `test_recordings`, and the action of the step after."""
    recording, out = record(tmp_path / "bag", "raw"), tmp_path / "out"
    assert main(["export", str(recording), "--format", "lerobot", "--out", str(out)]) == 0
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    printed = subprocess.check_output([PYTHON, "-c", LOAD, str(out)], text=True, env=environment)
    episodes, fps, shape, rows = json.loads(printed.splitlines()[-1])
    assert (episodes, fps, shape) == (2, 30, [3, 1, 1])
    states, actions, brightness = zip(*rows, strict=True)
    assert list(states) == RUNNING
    assert [now for now, _ in actions] == [100.0 + step for step in RUNNING]
    assert [after for _, after in actions[:-1]] == [102, 103, 104, 105, 105, 109, 110, 111]
    assert brightness == pytest.approx([20 * step for step in RUNNING], abs=4)
