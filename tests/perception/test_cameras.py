"""A live camera, for which a video file stands: OpenCV reads both alike, and at its end a file stalls."""

import time
from itertools import islice
from pathlib import Path

import cv2
import numpy as np
import pytest
from filmed import HEIGHT, WIDTH, save_video, throw

from pixel2catch.errors import PerceptionError
from pixel2catch.perception.sources import CameraReader, is_camera, live_ticks, measure_camera, open_camera
from pixel2catch.robot.constants import CONTROL_DT


@pytest.fixture
def capture(tmp_path: Path) -> cv2.VideoCapture:
    return cv2.VideoCapture(str(save_video(tmp_path / "v.mp4", islice(throw(), 12))))


def test_names_of_cameras():
    assert all(is_camera(name) for name in ("0", "12", "/dev/video0", "/dev/video-by-id"))
    assert not any(is_camera(name) for name in ("throw.mp4", "0.mp4", "video0", "bags/one", "-1"))


def test_a_missing_camera_says_what_to_do(capfd: pytest.CaptureFixture[str]):
    with pytest.raises(PerceptionError, match=r"'99' cannot be opened; video devices here: .* group 'video'"):
        open_camera("99")
    assert capfd.readouterr().err == ""


def test_only_the_newest_image_waits(capture: cv2.VideoCapture):
    """The file is read at once, so the newest image is its last; red, green and blue are in order."""
    with CameraReader(capture) as reader:
        frames = [reader.first()]
        while time.monotonic() - frames[-1].stamp < 0.5:
            frames.append(reader.newest())
    last = list(islice(throw(), 12))[-1]
    assert np.abs(frames[-1].image.astype(float) - last).mean() < 4.0
    assert len({id(frame) for frame in frames}) <= 12


def test_a_camera_that_stalls_repeats_its_image_and_then_ends(capture: cv2.VideoCapture):
    notes: list[str] = []
    ticks = list(live_ticks(capture, notes, longest_stall=0.4))
    assert 2 <= len(ticks) <= (ticks[-1].now - ticks[0].now) / CONTROL_DT + 2
    assert ticks[-1].frame is ticks[-2].frame
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


def test_rate_and_size_are_measured(capture: cv2.VideoCapture):
    report = measure_camera(capture, seconds=0.4)
    assert (report.width, report.height) == (WIDTH, HEIGHT)
    assert report.rate <= 11 / 0.4
    assert report.pause > 0.05
