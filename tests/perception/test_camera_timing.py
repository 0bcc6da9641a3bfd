"""The offset of a camera's stamps and its readout time, by a board that an arm moves."""

import numpy as np
import pytest
from calibration_views import (
    CORNERS,
    HOME,
    board_in_camera,
    lens,
    memory_network,
    pixels_of,
    poses,
    rendered,
)

from pixel2catch.cli.main import main
from pixel2catch.errors import PerceptionError
from pixel2catch.perception.calibration import timing
from pixel2catch.perception.calibration.lens import BoardView
from pixel2catch.perception.calibration.timing import BoardMotion, Timing
from pixel2catch.scene.constants import RGB_CAMERA

OFFSET, READOUT = 0.0123, 0.0171


def arm(time: float, way: float) -> np.ndarray:
    """Positions of an arm that a person leads up and down by hand [rad]."""
    swing = np.sin(2.0 * np.pi * 0.5 * time) + 0.3 * np.sin(2.0 * np.pi * 1.1 * time + 1.0)
    return HOME + way * swing * np.array((0.1, 0.3, 1.0, 0.3, 0.0, 0.2))


def recorded(offset: float, readout: float, way: float, seconds: float = 12.0) -> BoardMotion:
    """Views with a rolling shutter, corners found to 0.2 px; joint states at 125 Hz."""
    rng, motion = np.random.default_rng(0), BoardMotion()
    for time in np.arange(0.0, seconds, 1.0 / 30.0):
        pixels = pixels_of(board_in_camera(arm(time, way)), CORNERS, lens())
        before, after = (
            pixels_of(board_in_camera(arm(time + d, way)), CORNERS, lens()) for d in (-0.01, 0.01)
        )
        late = readout * (pixels[:, 1:] / RGB_CAMERA.height - 0.5)
        pixels = pixels + late * (after - before) / 0.02 + late**2 * (after - 2.0 * pixels + before) / 0.0002
        noisy = pixels + 0.2 * rng.standard_normal(pixels.shape)
        motion.views.append((time + offset, BoardView(points=CORNERS, pixels=noisy)))
    times = np.arange(-0.5, seconds + 0.5, 0.008) + 0.001 * rng.random(round((seconds + 1.0) / 0.008))
    motion.joints.extend((time, arm(time, way)) for time in times)
    return motion


@pytest.mark.parametrize(("offset", "readout"), [(OFFSET, READOUT), (-0.004, 0.0)])
def test_offset_and_readout_are_found_to_a_millisecond(offset: float, readout: float):
    found = recorded(offset, readout, way=0.35).timing(RGB_CAMERA.height)
    assert found.stamp_offset == pytest.approx(offset, abs=1e-3)
    assert found.readout_time == pytest.approx(readout, abs=1e-3)
    assert 0.0 < found.offset_std < 1e-3


@pytest.mark.parametrize(
    ("way", "seconds", "words"), [(0.35, 2.0, "found in 60 images"), (0.0, 8.0, "move"), (0.008, 8.0, "move")]
)
def test_too_little_motion_is_refused(way: float, seconds: float, words: str):
    with pytest.raises(PerceptionError, match=words):
        recorded(OFFSET, READOUT, way, seconds).timing(RGB_CAMERA.height)


def near(time: float) -> np.ndarray:
    """Positions of an arm that holds the board near to the camera [rad]."""
    return list(poses(4, seed=2))[3] + 0.05 * time


def test_the_command_prints_what_it_measured_on_the_network(monkeypatch, capsys):
    monkeypatch.setattr(timing, "SECONDS", 0.5)
    rng = np.random.default_rng(0)
    memory_network(monkeypatch, lambda time: (near(time), rendered(board_in_camera(near(time)), rng)), OFFSET)
    monkeypatch.setattr(BoardMotion, "timing", lambda motion, height: measured(motion, height))
    assert main(["calibrate", "--timing"]) == 0
    assert "  stamp_offset: 0.0123 # +- 0.0003 s" in capsys.readouterr().out


def measured(motion: BoardMotion, height: int) -> Timing:
    """Check what was collected; it is too short to be fitted."""
    assert height == RGB_CAMERA.height
    assert len(motion.joints) >= len(motion.views) > 4
    for stamp, view in motion.views:
        pixels = pixels_of(board_in_camera(near(stamp - OFFSET)), view.points, lens())
        assert np.abs(pixels - view.pixels).max() < 1.0
    return Timing(stamp_offset=OFFSET, readout_time=READOUT, offset_std=3e-4, readout_std=7e-4)
