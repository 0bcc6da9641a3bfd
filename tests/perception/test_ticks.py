"""The control clock of recordings, with streams worked out by hand."""

import numpy as np
import pytest

from pixel2catch.perception.extractor import CameraFrame
from pixel2catch.perception.sources import LONGEST_PAUSE, on_control_clock
from pixel2catch.robot.constants import CONTROL_DT

IMAGE = np.zeros((2, 2, 3), dtype=np.uint8)


def images_got(stamps: list[float], notes: list[str] | None = None) -> list[int]:
    """Number of the image that each control step gets; ticks are whole control steps apart."""
    frames = [CameraFrame(image=IMAGE, stamp=stamp) for stamp in stamps]
    ticks = list(on_control_clock(frames, [] if notes is None else notes))
    assert all(tick.frame.stamp < tick.now for tick in ticks)
    steps = np.array([(tick.now - stamps[0]) / CONTROL_DT for tick in ticks])
    np.testing.assert_allclose(steps % 1.0, 0.5, atol=1e-4)
    assert (np.diff(steps) > 0.5).all()
    return [next(i for i, frame in enumerate(frames) if frame is tick.frame) for tick in ticks]


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


def test_a_lost_image_leaves_the_one_before():
    notes: list[str] = []
    assert images_got([0.0, 1 / 30, 4 / 30], notes) == [0, 1, 1, 1, 2]
    assert not notes


def test_a_long_pause_is_cut_and_said():
    notes: list[str] = []
    got = images_got([0.0, 1 / 30, 3600.0], notes)
    assert got == [0] + [1] * LONGEST_PAUSE + [2]
    assert notes == ["3600.0 s without an image after 0.0 s."]


def test_stamps_that_go_back_are_passed_over_and_said():
    notes: list[str] = []
    assert images_got([0.0, 1 / 30, 1 / 30, 0.01, 2 / 30], notes) == [0, 1, 4]
    assert notes == ["images no newer than those before them, passed over: 2."]


def test_nothing_makes_no_tick():
    assert images_got([]) == []
