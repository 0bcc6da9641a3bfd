"""Videos, bags and cameras on the control clock, and sources that are none.

A video file stands for a camera: OpenCV reads both alike, and at its end a file stalls.
"""

import time
from itertools import islice
from pathlib import Path

import cv2
import numpy as np
import pytest
from filmed import HEIGHT, WIDTH, raw, save_bag, save_video, throw

from pixel2catch.camera.image import Image
from pixel2catch.errors import PerceptionError
from pixel2catch.perception.sources import (
    LONGEST_PAUSE,
    CameraReader,
    SourceCfg,
    live_ticks,
    on_control_clock,
    ticks_of,
    video_images,
)
from pixel2catch.scene.constants import CONTROL_DT


def test_video_keeps_pixels_and_stamps(tmp_path: Path):
    pictures = list(islice(throw(), 5))
    frames = list(video_images(save_video(tmp_path / "v.mp4", pictures, fps=24), []))
    assert [frame.stamp for frame in frames] == pytest.approx([i / 24 for i in range(5)], abs=1e-4)
    difference = np.array([frame.pixels for frame in frames], dtype=float) - pictures
    assert np.abs(difference).mean() < 4.0


def test_every_kind_of_source_comes_on_the_control_clock(tmp_path: Path):
    pictures = list(islice(throw(), 4))
    video = save_video(tmp_path / "v.mp4", pictures)
    bag = save_bag(tmp_path / "bag", [raw(step, picture) for step, picture in enumerate(pictures)])
    (file,) = bag.glob("*.mcap")
    for source in (video, bag, file):
        ticks = list(ticks_of(SourceCfg(name=str(source)), []))
        assert len(ticks) == 4
        assert all(tick.image.pixels.shape == (HEIGHT, WIDTH, 3) for tick in ticks)


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


def test_a_damaged_video_ends_where_the_damage_begins(tmp_path: Path):
    file = save_video(tmp_path / "v.mp4", islice(throw(), 30))
    content = bytearray(file.read_bytes())
    middle, length = len(content) // 2, len(content) // 5
    content[middle : middle + length] = bytes(length)
    file.write_bytes(content)
    notes: list[str] = []
    frames = list(video_images(file, notes))
    assert 3 < len(frames) < 30
    assert notes[0].startswith(f"the video is damaged after {len(frames)} images: Invalid data")


IMAGE = np.zeros((2, 2, 3), dtype=np.uint8)


def images_got(stamps: list[float], notes: list[str] | None = None) -> list[int]:
    """Number of the image that each control step gets; ticks are whole control steps apart."""
    frames = [Image(pixels=IMAGE, stamp=stamp) for stamp in stamps]
    ticks = list(on_control_clock(frames, [] if notes is None else notes))
    assert all(tick.image.stamp < tick.now for tick in ticks)
    steps = np.array([(tick.now - stamps[0]) / CONTROL_DT for tick in ticks])
    np.testing.assert_allclose(steps % 1.0, 0.5, atol=1e-4)
    assert (np.diff(steps) > 0.5).all()
    return [next(i for i, frame in enumerate(frames) if frame is tick.image) for tick in ticks]


def test_no_jitter_of_a_camera_makes_a_tick_miss_its_image():
    jitter = np.random.default_rng(0).uniform(-0.4, 0.4, 300)
    jitter[0] = 0.0
    stamps = ((np.arange(300) + jitter) * CONTROL_DT + 1.79e9).tolist()
    assert images_got(stamps) == list(range(300))


@pytest.mark.parametrize(
    ("rate", "expected"),
    [(60, [0, 2, 4, 5]), (15, [0, 0, 1, 1, 2, 2, 3, 3, 4, 4, 5]), (30, [0, 1, 2, 3, 4, 5])],
)
def test_other_rates_skip_or_repeat_images(rate: int, expected: list[int]):
    assert images_got([i / rate for i in range(6)]) == expected


def test_a_long_pause_is_cut_and_said():
    notes: list[str] = []
    got = images_got([0.0, 1 / 30, 3600.0], notes)
    assert got == [0] + [1] * LONGEST_PAUSE + [2]
    assert notes == ["3600.0 s without an image after 0.0 s."]


def test_stamps_that_go_back_are_passed_over_and_said():
    notes: list[str] = []
    assert images_got([0.0, 1 / 30, 1 / 30, 0.01, 2 / 30], notes) == [0, 1, 4]
    assert notes == ["images no newer than those before them, passed over: 2."]


@pytest.fixture
def capture(tmp_path: Path) -> cv2.VideoCapture:
    return cv2.VideoCapture(str(save_video(tmp_path / "v.mp4", islice(throw(), 12))))


def test_only_the_newest_image_waits(capture: cv2.VideoCapture):
    """The file is read at once, so the newest image is its last; red, green and blue are in order."""
    with CameraReader(capture) as reader:
        frames = [reader.first()]
        while time.monotonic() - frames[-1].stamp < 0.5:
            frames.append(reader.newest())
    last = list(islice(throw(), 12))[-1]
    assert np.abs(frames[-1].pixels.astype(float) - last).mean() < 4.0
    assert len({id(frame) for frame in frames}) <= 12


def test_a_camera_that_stalls_repeats_its_image_and_then_ends(capture: cv2.VideoCapture):
    notes: list[str] = []
    ticks = list(live_ticks(capture, notes, longest_stall=0.4))
    assert 2 <= len(ticks) <= (ticks[-1].now - ticks[0].now) / CONTROL_DT + 2
    assert ticks[-1].image is ticks[-2].image
    assert notes == ["the camera gave no image for 0.4 s: ended. Is it unplugged?"]


def test_steps_that_are_late_are_left_out(capture: cv2.VideoCapture):
    """A consumer that takes 2.5 steps gets every third tick, on the same clock."""
    times = []
    for tick in live_ticks(capture, [], longest_stall=0.8):
        times.append(tick.now)
        time.sleep(2.5 * CONTROL_DT)
    assert np.diff(times).min() > 2.4 * CONTROL_DT


def test_a_camera_without_any_image_is_refused(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("pixel2catch.perception.sources.FIRST_IMAGE_TIMEOUT", 0.05)
    nothing = cv2.VideoCapture()
    with pytest.raises(PerceptionError, match=r"open but gave no image in 0\.05 s: plug it in again"):
        next(live_ticks(nothing, []))
