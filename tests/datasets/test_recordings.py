"""Recordings of deployments as data sets: a made-up one whose every number is known."""

import json
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
from pyarrow import parquet

from pixel2catch.cli.main import main
from pixel2catch.datasets.lerobot import ACTION, DONE, IMAGES, SEEN, STATE
from pixel2catch.deployment.recorder import SERVO, TARGETS, BagRecorder
from pixel2catch.ros2 import messages
from pixel2catch.ros2.profile import Profile
from pixel2catch.scene.constants import CONTROL_DT
from pixel2catch.servo.link import Command, JointTargets, Mode

PROFILE = Profile.load("ur5e_allegro_v4")
NUM_JOINTS, EPOCH, START = 19, 1_790_000_000.0, 500.0
NUM_STEPS, NUM_FIRST = 12, 5
"""Decisions, of which so many are made before the robot is stopped once."""


def mode_of(step: int) -> Mode:
    """Armed for a decision, then a run, a stop of two decisions, and a run again."""
    if step == 0:
        return Mode.ARMED
    return Mode.STOPPED if step in (NUM_FIRST + 1, NUM_FIRST + 2) else Mode.RAMP if step == 1 else Mode.RUN


def record(folder: Path, images: str, *, runs: bool = True) -> Path:
    """Decision k is made on joints at k, wants 100 + k, and sees a box and a grey image of its number."""
    with BagRecorder(folder) as recorder:
        for step in range(NUM_STEPS):
            now = START + step * CONTROL_DT
            bag = now - START + EPOCH
            mode = mode_of(step) if runs else Mode.IDLE
            picture = messages.image(np.full((48, 64, 3), 20 * step, np.uint8), bag)
            if images == "jpeg":  # one is damaged
                topic, size = messages.compressed_topic(PROFILE.camera.image), 60 if step == 3 else None
                recorder.record(topic, messages.compress(picture)[:size], bag)
            elif images == "raw":
                recorder.record(PROFILE.camera.image, picture, bag)
            for late, value in ((0.001, step), (0.004, -1.0)):
                row = status(now + late, int(mode), value).row
                recorder.record(SERVO, messages.float_array(row), bag + late)
            targets = np.full(NUM_JOINTS, 100.0 + step)
            order = JointTargets(
                target_stamp=now + 0.002, image_stamp=now, box_stamp=now, joint_pos_target=targets
            )
            recorder.record(TARGETS, messages.float_array(order.row), bag + 0.003)
            box = None if step == 4 else [10.0, 20.0, 30.0 + step, 40.0]
            recorder.record(PROFILE.operator.status, messages.text(json.dumps({"box": box})), bag + 0.003)
    return folder


def status(time: float, mode: int, value: float) -> Command:
    row = [time, 0.0, time, time, float(mode), 0.0, 0.0, 0.0, 0.0]
    return Command.of(np.array(row + [9.0] * NUM_JOINTS + [value] * NUM_JOINTS))


def exported(recording: Path, out: Path) -> dict[str, list[Any]]:
    assert main(["export", str(recording), "--format", "lerobot", "--out", str(out)]) == 0
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


def test_what_cannot_be_exported(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    idle = record(tmp_path / "idle", "none", runs=False)
    (tmp_path / "no.mcap").write_bytes(b"no bag")
    for path, message in ((idle, "the policy decided nothing there"), (tmp_path / "no.mcap", "rosbag2")):
        args = ["export", str(path), "--format", "lerobot", "--out", str(tmp_path / "out")]
        assert main(args) == 2
        assert message in capsys.readouterr().err
        assert not (tmp_path / "out").exists()
