"""Images in bags, in every encoding that is read, and what makes a bag useless."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from filmed import EPOCH, compressed, joint_state, jpeg, raw, save_bag, stamp_of, throw
from rosbags.rosbag2 import StoragePlugin

from pixel2catch.camera.image import Image
from pixel2catch.errors import PerceptionError
from pixel2catch.perception.bag_images import bag_images
from pixel2catch.workcells.ur5e_allegro import UR5E_ALLEGRO

IMAGE = next(throw())
NAMES = [*UR5E_ALLEGRO.joint_names]


def read(path: Path, topic: str | None = None, notes: list[str] | None = None) -> list[Image]:
    return list(bag_images(path, topic, NAMES, [] if notes is None else notes))


@pytest.mark.parametrize(
    ("storage", "encoding", "padding"),
    [
        (StoragePlugin.MCAP, "rgb8", 0),
        (StoragePlugin.SQLITE3, "bgr8", 0),
        (StoragePlugin.MCAP, "rgb8", 24),
    ],
)
def test_raw_images_come_out_as_they_were(
    storage: StoragePlugin, encoding: str, padding: int, tmp_path: Path
):
    pixels = IMAGE if encoding == "rgb8" else IMAGE[..., ::-1]
    path = save_bag(tmp_path / "bag", [raw(step, pixels, encoding, padding) for step in range(3)], storage)
    frames = read(path)
    assert [frame.stamp for frame in frames] == pytest.approx([stamp_of(step) / 1e9 for step in range(3)])
    for frame in frames:
        np.testing.assert_array_equal(frame.pixels, IMAGE)
        assert frame.joint_pos is None


def test_the_time_of_reception_counts_where_a_stamp_is_missing(tmp_path: Path):
    topic, received, message = raw(0, IMAGE)
    message.header.stamp.sec = message.header.stamp.nanosec = 0
    (frame,) = read(save_bag(tmp_path / "bag", [(topic, received, message)]))
    assert frame.stamp == pytest.approx(EPOCH + 0.02)


def test_compressed_images_are_decoded_and_damaged_ones_passed_over(tmp_path: Path):
    good = jpeg(IMAGE)
    messages = [compressed(0, good, "jpeg"), compressed(1, good), compressed(2, good[:9]), compressed(3, b"")]
    notes: list[str] = []
    frames = read(save_bag(tmp_path / "bag", messages), notes=notes)
    assert len(frames) == 2
    assert np.abs(frames[1].pixels.astype(float) - IMAGE).mean() < 6.0
    assert len(notes) == 1
    assert notes[0].startswith("damaged images, passed over: 2; the last of 0 bytes at")


def test_one_of_several_topics_is_chosen_by_name(tmp_path: Path):
    path = save_bag(tmp_path / "bag", [raw(0, IMAGE), compressed(0, jpeg(IMAGE))])
    both = r"/camera/image_raw, /camera/image_raw/compressed"
    with pytest.raises(
        PerceptionError, match=rf"several topics have images; choose with --topic out of: {both}"
    ):
        read(path)
    with pytest.raises(PerceptionError, match=rf"no images on a topic /wrist; .*: {both}"):
        read(path, "/wrist")
    assert len(read(path, "/camera/image_raw")) == 1


def test_encodings_without_colour_are_refused(tmp_path: Path):
    grey = save_bag(tmp_path / "grey", [raw(0, IMAGE[..., :1], "mono8")])
    with pytest.raises(PerceptionError, match=r"'mono8' is not read; record rgb8 or bgr8"):
        read(grey)
    depth = save_bag(tmp_path / "depth", [compressed(0, b"x", "16UC1; compressedDepth png")])
    with pytest.raises(PerceptionError, match=r"compressedDepth.* is not read; record jpeg or png"):
        read(depth)


def test_a_bag_without_images_says_so(tmp_path: Path):
    path = save_bag(tmp_path / "bag", [joint_state(stamp_of(0), NAMES, np.zeros(len(NAMES)))])
    with pytest.raises(PerceptionError, match="no topic has images"):
        read(path)


def test_an_image_has_the_joint_positions_of_its_time(tmp_path: Path):
    """Arm and hand are published one after the other; an image arrives later than the states of its time."""
    arm, hand = NAMES[:6], NAMES[6:]

    def state(time: int, value: float) -> list[Any]:
        position = np.full(len(NAMES), value)
        return [joint_state(time, arm, position[:6]), joint_state(time, hand, position[6:])]

    messages = [raw(0, IMAGE), *state(stamp_of(1), 1.0), *state(stamp_of(1) + 10_000_000, 2.0), raw(1, IMAGE)]
    first, second = read(save_bag(tmp_path / "bag", messages))
    assert first.joint_pos is None
    np.testing.assert_array_equal(second.joint_pos, np.ones(len(NAMES)))
