"""Recordings of deployments as data sets: a made-up one whose every number is known."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
from pyarrow import parquet

import pixel2catch as p2c
from lerobot_format import ACTION, DONE, IMAGES, SEEN, STATE
from to_lerobot import main, write_recording

PROFILE = p2c.Profile.load("ur5e_allegro_v4")
NUM_JOINTS, EPOCH, START = 19, 1_790_000_000.0, 500.0
NUM_STEPS, NUM_FIRST = 12, 5
"""Decisions, of which so many are made before the robot is stopped once."""


def mode_of(step: int) -> p2c.link.Mode:
    """Armed for a decision, then a run, a stop of two decisions, and a run again."""
    if step == 0:
        return p2c.link.Mode.ARMED
    return (
        p2c.link.Mode.STOPPED
        if step in (NUM_FIRST + 1, NUM_FIRST + 2)
        else p2c.link.Mode.RAMP
        if step == 1
        else p2c.link.Mode.RUN
    )


def record(folder: Path, images: str, *, runs: bool = True) -> Path:
    """Decision k is made on joints at k, wants 100 + k, and sees a box and a grey image of its number."""
    with p2c.recorder.BagRecorder(folder) as recorder:
        for step in range(NUM_STEPS):
            now = START + step * p2c.constants.CONTROL_DT
            bag = now - START + EPOCH
            mode = mode_of(step) if runs else p2c.link.Mode.IDLE
            picture = p2c.messages.image(np.full((48, 64, 3), 20 * step, np.uint8), bag)
            if images == "jpeg":  # one is damaged
                topic, size = p2c.messages.compressed_topic(PROFILE.camera.image), 60 if step == 3 else None
                recorder.record(topic, p2c.messages.compress(picture)[:size], bag)
            elif images == "raw":
                recorder.record(PROFILE.camera.image, picture, bag)
            for late, value in ((0.001, step), (0.004, -1.0)):
                row = status(now + late, int(mode), value).row
                recorder.record(p2c.recorder.SERVO, p2c.messages.float_array(row), bag + late)
            targets = np.full(NUM_JOINTS, 100.0 + step)
            order = p2c.link.JointTargets(
                target_stamp=now + 0.002, image_stamp=now, box_stamp=now, joint_pos_target=targets
            )
            recorder.record(p2c.recorder.TARGETS, p2c.messages.float_array(order.row), bag + 0.003)
            box = None if step == 4 else [10.0, 20.0, 30.0 + step, 40.0]
            recorder.record(PROFILE.operator.status, p2c.messages.text(json.dumps({"box": box})), bag + 0.003)
    return folder


def status(time: float, mode: int, value: float) -> p2c.link.Command:
    row = [time, 0.0, time, time, float(mode), 0.0, 0.0, 0.0, 0.0]
    return p2c.link.Command.of(np.array(row + [9.0] * NUM_JOINTS + [value] * NUM_JOINTS))


def exported(recording: Path, out: Path) -> dict[str, list[Any]]:
    write_recording(out, recording, PROFILE)
    return parquet.read_table(out / "data/chunk-000/file-000.parquet").to_pydict()


RUNNING = [1, 2, 3, 4, 5, 8, 9, 10, 11]


def test_every_decision_of_the_runs(tmp_path: Path) -> None:
    columns = exported(record(tmp_path / "bag", "jpeg"), tmp_path / "out")
    assert [row[0] for row in columns[STATE]] == RUNNING
    assert [row[-1] for row in columns[ACTION]] == [100.0 + step for step in RUNNING]
    assert columns["episode_index"] == [0] * 5 + [1] * 4
    assert columns[DONE] == [step in (5, 11) for step in RUNNING]
    assert columns["timestamp"] == pytest.approx([k / 30 for k in (0, 1, 2, 3, 4, 0, 1, 2, 3)])


def test_a_box_that_was_not_seen_is_the_last_one(tmp_path: Path) -> None:
    """Widths of the boxes are 20 + k; the change of the centre is half the change of the width."""
    columns = exported(record(tmp_path / "bag", "none"), tmp_path / "out")
    seen = np.array(columns[SEEN])
    assert (seen[:, 2] - seen[:, 0]).tolist() == [21, 22, 23, 23, 25, 28, 29, 30, 31]
    assert seen[:, 8].tolist() == [0.0, 0.5, 0.5, 0.0, 1.0, 0.0, 0.5, 0.5, 0.5]
    assert not (tmp_path / "out/videos").exists()


@pytest.mark.parametrize(("images", "third"), [("raw", 60), ("jpeg", 40)])
def test_images_are_those_of_the_decisions(images: str, third: int, tmp_path: Path) -> None:
    """A damaged one is the one before it."""
    recording = record(tmp_path / "bag", images)
    exported(next(recording.glob("*.mcap")), tmp_path / "out")
    with av.open(str(tmp_path / "out/videos" / IMAGES / "chunk-000/file-000.mp4")) as video:
        greys = [frame.to_ndarray(format="rgb24").mean() for frame in video.decode(video=0)]
    assert greys == pytest.approx([third if step == 3 else 20 * step for step in RUNNING], abs=4)


def test_what_cannot_be_exported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    idle = record(tmp_path / "idle", "none", runs=False)
    (tmp_path / "no.mcap").write_bytes(b"no bag")
    for path, message in ((idle, "the policy decided nothing there"), (tmp_path / "no.mcap", "rosbag2")):
        monkeypatch.setattr(sys, "argv", ["to_lerobot.py", str(path), "--out", str(tmp_path / "out")])
        with pytest.raises(SystemExit, match=message):
            main()
        assert not (tmp_path / "out").exists()


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
    """LeRobot reads the numbers and images of the tests above, and the action of the step after."""
    exported(record(tmp_path / "bag", "raw"), tmp_path / "out")
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    command = [PYTHON, "-c", LOAD, str(tmp_path / "out")]
    printed = subprocess.check_output(command, text=True, env=environment)
    episodes, fps, shape, rows = json.loads(printed.splitlines()[-1])
    assert (episodes, fps, shape) == (2, 30, [3, 1, 1])
    states, actions, brightness = zip(*rows, strict=True)
    assert list(states) == RUNNING
    assert [now for now, _ in actions] == [100.0 + step for step in RUNNING]
    assert [after for _, after in actions[:-1]] == [102, 103, 104, 105, 105, 109, 110, 111]
    assert brightness == pytest.approx([20 * step for step in RUNNING], abs=4)
