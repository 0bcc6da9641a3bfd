"""`pixel2catch deploy` as a process, over DDS and in real time; `test_faults` has faults in stepped time."""

import json
import multiprocessing
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from camera_lab import Arming, run_laboratory

from domains import PATIENCE, own_domain
from pixel2catch.ros2 import messages
from pixel2catch.ros2.profile import Profile
from pixel2catch.ros2.transport import LOOPBACK, RealClock, Transport, make_transport

PROFILE = Profile.load("ur5e_allegro_v4")
RATE = 0.05
"""Rate of the clock: a delay of half a second on a busy machine is not late by this one."""


class ProcessBench(Arming):
    """Receives the statuses and commands of `deploy`, and controls its laboratory."""

    def __init__(self, node: Transport, clock: RealClock, stack: ExitStack, folder: Path) -> None:
        self.clock = clock
        self._statuses = node.subscription(PROFILE.operator.status, 50)
        self._commands = node.subscription(PROFILE.robots[0].command_topic, 2000, only_watches=True)
        self.status: dict[str, Any] = {"mode": "", "found": []}
        self.commands: list[np.ndarray] = []
        self.log, self.record = folder / "deploy.txt", folder / "tape"
        command = [sys.executable, "-m", "pixel2catch", "deploy", "--clock", f"{RATE:g}"]
        command += ["--segmenter", "color", "--color", "340", "20", "--record", str(self.record)]
        file = stack.enter_context(self.log.open("wb"))
        self.deploy = subprocess.Popen(command, stdout=file, stderr=subprocess.STDOUT)
        stack.callback(self.deploy.wait)
        stack.callback(self.deploy.kill)
        context = multiprocessing.get_context("spawn")
        self._words, theirs = context.Pipe()
        self.laboratory = context.Process(target=run_laboratory, args=(theirs, RATE), daemon=True)
        self.laboratory.start()
        stack.callback(self.laboratory.join)
        stack.callback(self.laboratory.kill)

    def say(self, word: str) -> None:
        self._words.send(word)

    def until(self, holds: Callable[[], bool]) -> None:
        end = time.monotonic() + PATIENCE
        while not holds():
            assert time.monotonic() < end, (self.status, self.log.read_text(errors="replace")[-1500:])
            for message in self._statuses.take():
                self.status = json.loads(messages.read_text(message.data))
            self.commands += [messages.read_float_array(message.data) for message in self._commands.take()]
            time.sleep(0.002)


@pytest.fixture
def bench(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[ProcessBench]:
    monkeypatch.setenv("ROS_DOMAIN_ID", own_domain())
    with ExitStack() as stack:
        clock = RealClock(RATE)
        node = stack.enter_context(make_transport("bench", LOOPBACK, clock))
        yield ProcessBench(node, clock, stack, tmp_path)


def test_it_stops_without_its_laboratory_and_ends_without_its_servo(bench: ProcessBench):
    """Both are killed."""
    bench.arm()
    bench.until(lambda: len(bench.commands) > 10)
    bench.laboratory.kill()
    bench.until(lambda: bench.status["mode"] == "stopped")
    pid = bench.deploy.pid
    for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split():
        os.kill(int(child), signal.SIGKILL)
    assert bench.deploy.wait(PATIENCE) == 2
    log = bench.log.read_text(errors="replace")
    assert "press its stop" in log
    assert "arm: joints up to 2.79 rad/s; commands up to 10 rad/s, 1000 rad/s²" in log
    assert np.isfinite(bench.commands).all()
    assert (bench.record / "tape.mcap").stat().st_size > 0
