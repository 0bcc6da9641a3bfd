"""Videos, and sources that are none: every message says what to do."""

from itertools import islice
from pathlib import Path

import numpy as np
import pytest
from filmed import HEIGHT, WIDTH, raw, save_bag, save_video, throw

from pixel2catch.errors import PerceptionError
from pixel2catch.perception.sources import SourceCfg, ticks_of, video_frames


def test_video_keeps_pixels_and_stamps(tmp_path: Path):
    pictures = list(islice(throw(), 5))
    frames = list(video_frames(save_video(tmp_path / "v.mp4", pictures, fps=24), []))
    assert [frame.stamp for frame in frames] == pytest.approx([i / 24 for i in range(5)], abs=1e-4)
    difference = np.array([frame.image for frame in frames], dtype=float) - pictures
    assert np.abs(difference).mean() < 4.0


def test_every_kind_of_source_comes_on_the_control_clock(tmp_path: Path):
    pictures = list(islice(throw(), 4))
    video = save_video(tmp_path / "v.mp4", pictures)
    bag = save_bag(tmp_path / "bag", [raw(step, picture) for step, picture in enumerate(pictures)])
    (file,) = bag.glob("*.mcap")
    for source in (video, bag, file):
        ticks = list(ticks_of(SourceCfg(name=str(source)), []))
        assert len(ticks) == 4
        assert all(tick.frame.image.shape == (HEIGHT, WIDTH, 3) for tick in ticks)


def error_of(source: Path | str) -> str:
    with pytest.raises(PerceptionError) as caught:
        next(ticks_of(SourceCfg(name=str(source)), []))
    return str(caught.value)


def test_what_is_no_source_is_refused(tmp_path: Path):
    (tmp_path / "notes.txt").write_text("no video")
    (tmp_path / "folder").mkdir()
    assert "/dev/videoN" in error_of(tmp_path / "nothing.mp4")
    assert "cannot be read as a video" in error_of(tmp_path / "notes.txt")
    assert "not a readable rosbag2" in error_of(tmp_path / "folder")
    assert "video devices here" in error_of("99")
    assert "video devices here" in error_of("/dev/video99")


def test_an_unfinished_video_is_refused(tmp_path: Path):
    whole = save_video(tmp_path / "v.mp4", islice(throw(), 10)).read_bytes()
    (tmp_path / "half.mp4").write_bytes(whole[: len(whole) // 2])
    assert "cannot be read as a video" in error_of(tmp_path / "half.mp4")


def test_a_damaged_video_ends_where_the_damage_begins(tmp_path: Path):
    file = save_video(tmp_path / "v.mp4", islice(throw(), 30))
    content = bytearray(file.read_bytes())
    middle, length = len(content) // 2, len(content) // 5
    content[middle : middle + length] = bytes(length)
    file.write_bytes(content)
    notes: list[str] = []
    frames = list(video_frames(file, notes))
    assert 3 < len(frames) < 30
    assert notes[0].startswith(f"the video is damaged after {len(frames)} images: Invalid data")
