"""`pixel2catch deploy` as it is started, over DDS; `test_faults` has what goes wrong, in stepped time."""

import os
import signal
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest
from process_lab import Watcher

from domains import PATIENCE, own_domain
from pixel2catch.ros2.factory import make_transport
from pixel2catch.ros2.transport import LOOPBACK, RealClock

RATE = 0.05
"""Rate of the clock: what a busy machine makes wait for half a second is not late by this one."""


@pytest.fixture
def watcher(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Watcher]:
    monkeypatch.setenv("ROS_DOMAIN_ID", own_domain())
    with ExitStack() as stack:
        clock = RealClock(RATE)
        node = stack.enter_context(make_transport("dds", "watcher", LOOPBACK, clock))
        yield Watcher(node, clock, stack, tmp_path)


def test_it_stops_without_a_laboratory_goes_on_with_a_new_one_and_ends_without_its_servo(watcher: Watcher):
    watcher.arm()
    watcher.until(lambda: len(watcher.commands) > 10)
    watcher.laboratory.kill()
    watcher.until(lambda: watcher.status["mode"] == "stopped")
    watcher.start_laboratory()
    watcher.arm()
    pid = watcher.deploy.pid
    for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split():
        os.kill(int(child), signal.SIGKILL)
    assert watcher.deploy.wait(PATIENCE) == 2
    said = watcher.log.read_text(errors="replace")
    assert "press its stop" in said
    assert "arm: joints up to 2.79 rad/s; commands up to 10 rad/s, 1000 rad/s²" in said
    assert np.isfinite([command for _, command in watcher.commands]).all()
    assert (watcher.log.parent / "tape" / "tape.mcap").stat().st_size > 0


@pytest.mark.slow
def test_a_frozen_image_a_second_camera_and_a_lost_object_stop_it(watcher: Watcher):
    """It is said in words. A machine that is busy may stop it before: then once more."""
    for fault, words in (
        ("image frozen", "perception unsound"),
        ("object gone", "object lost"),
        ("another camera", "perception unsound"),
    ):
        while words not in watcher.status.get("stopped_by", ()):
            watcher.arm(("armed",))
            watcher.say("point")
            watcher.until(lambda: watcher.status["mode"] in ("ramp", "run", "stopped"))
            watcher.say(fault)
            watcher.until(lambda: watcher.status["mode"] == "stopped")
        watcher.say("switch let go")
