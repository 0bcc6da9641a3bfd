"""A replay decides what the recorded deployment decided."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from camera_lab import SteppedBench
from loop_lab import HOME, PROFILE, new_pipeline, remembering

from paper_robot import JOINTS
from pixel2catch.deployment.policy_pipeline import PolicyPipeline
from pixel2catch.deployment.recorder import BagRecorder
from pixel2catch.deployment.replay import compare, played, recorded_targets, replay
from pixel2catch.errors import DeploymentError
from pixel2catch.ros2 import messages
from pixel2catch.ros2.messages import compress, compressed_topic
from pixel2catch.scene.constants import RGB_CAMERA
from pixel2catch.servo.link import JointTargets
from pixel2catch.workcells.ur5e_allegro import UR5E_ALLEGRO

EPOCH = 1_790_000_000.0


def record(folder: Path, pipeline: PolicyPipeline) -> None:
    """A second of a robot that stands still, and an object that moves through the image."""
    with BagRecorder(folder) as tape, SteppedBench(pipeline, tape) as bench:
        bench.lab.drift = 0.1
        bench.run()
        bench.wait(0.8)


def replayed(recording: Path, out: Path, pipeline: PolicyPipeline) -> dict[str, Any]:
    replay(recording, out, PROFILE, RGB_CAMERA, pipeline)
    return compare(recorded_targets(recording), recorded_targets(out), UR5E_ALLEGRO)


@pytest.mark.parametrize(("method", "most"), [(None, 1e-5), ("shared_reward+age", 1e-3)])
def test_a_replay_decides_as_it_was_decided(tmp_path: Path, method: str | None, most: float):
    """Policies with ages decide at times that differ by less than a tick."""
    first, second = (new_pipeline(controller=remembering(method) if method else None) for _ in range(2))
    record(tmp_path / "then", first)
    report = replayed(tmp_path / "then", tmp_path / "now", second)
    assert report["num_then"] >= 20
    assert report["num_both"] >= report["num_then"] - 1
    assert report["arm"]["max"] < most
    assert report["hand"]["max"] < most


def test_jpeg_images_are_played_as_raw_ones_in_order_and_time(tmp_path: Path):
    """A damaged one is left out, and so are other topics."""
    image, pixels = PROFILE.camera.image, np.full((48, 64, 3), (200, 30, 20), dtype=np.uint8)
    with BagRecorder(tmp_path / "throw") as bag:
        for number in range(3):
            data = messages.image(pixels, EPOCH + number)
            bag.record(compressed_topic(image), data, EPOCH + 0.1 * number, compress)
        bag.record(compressed_topic(image), b"\x00\x01\x00\x00", EPOCH, compress)
        bag.record(compressed_topic(image), b"\x00\x01\x00\x00nonsense", EPOCH)
        bag.record(PROFILE.operator.arm, messages.boolean(True), EPOCH)
    assert bag.num_dropped == {f"{image.name}/compressed": 1}
    times, topics, contents = zip(*played(tmp_path / "throw", {image}), strict=True)
    assert times == pytest.approx([EPOCH, EPOCH + 0.1, EPOCH + 0.2], abs=1e-6)
    assert {*topics} == {image}
    readings = [messages.read_image(content) for content in contents]
    assert [reading.stamp for reading in readings] == [EPOCH, EPOCH + 1.0, EPOCH + 2.0]
    assert np.abs(readings[0].pixels.astype(int) - pixels).max() < 8


def test_a_recording_without_images_is_refused(tmp_path: Path):
    with BagRecorder(tmp_path / "then") as recorder:
        recorder.record(PROFILE.operator.arm, messages.boolean(True), EPOCH)
    with pytest.raises(DeploymentError, match="no images on"):
        replayed(tmp_path / "then", tmp_path / "now", new_pipeline())
    assert not (tmp_path / "now").exists()


def targets(stamps: list[float], positions: np.ndarray) -> list[JointTargets]:
    return [
        JointTargets(joint_pos_target=position, target_stamp=0.0, image_stamp=stamp, box_stamp=0.0)
        for stamp, position in zip(stamps, positions, strict=True)
    ]


def test_differences_are_of_the_worst_joint_for_images_of_both():
    then = targets([1.0, 1.033, 1.067], np.tile(HOME, (3, 1)))
    other = np.tile(HOME, (2, 1))
    other[0, 1] += 0.25
    other[1, len(JOINTS) - 1] += 0.5
    report = compare(then, targets([1.001, 1.034], other), UR5E_ALLEGRO)
    assert (report["num_then"], report["num_now"], report["num_both"]) == (3, 2, 2)
    assert report["arm"] == pytest.approx({"median": 0.125, "max": 0.25})
    assert report["hand"] == pytest.approx({"median": 0.25, "max": 0.5})
    late = targets([11.0, 11.033], other)
    assert compare(then, late, UR5E_ALLEGRO) == {"num_then": 3, "num_now": 2, "num_both": 0}
