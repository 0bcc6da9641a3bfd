"""`pixel2catch deploy` as it is started, over DDS; `test_faults` has what goes wrong, in stepped time."""

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
from camera_lab import laboratory

from domains import PATIENCE, own_domain
from pixel2catch.ros2 import messages
from pixel2catch.ros2.profile import Profile
from pixel2catch.ros2.transport import LOOPBACK, RealClock, Transport, make_transport
from pixel2catch.servo.limits import STOP_TIME

RATE = 0.05
"""Rate of the clock: what a busy machine makes wait for half a second is not late by this one."""

PROFILE = Profile.load("ur5e_allegro_v4")
ARM = PROFILE.robots[0].command_topic


class Watcher:
    """Hears what `deploy` says and commands, and tells the laboratory what shall go wrong."""

    def __init__(self, node: Transport, clock: RealClock, stack: ExitStack, folder: Path) -> None:
        self.clock, self._stack = clock, stack
        self._statuses = node.subscription(PROFILE.operator.status, 50)
        self._commands = node.subscription(ARM, 2000, only_watches=True)
        self.statuses: list[dict[str, Any]] = []
        self.commands: list[tuple[float, np.ndarray]] = []
        self.log = folder / "deploy.txt"
        self.deploy = self._start_deploy()
        self.start_laboratory()

    def _start_deploy(self) -> subprocess.Popen[bytes]:
        """Deploy, with eyes for red."""
        command = [sys.executable, "-m", "pixel2catch", "deploy", "--clock", str(RATE)]
        command += ["--segmenter", "color", "--color", "340", "20", "--record", str(self.log.parent / "tape")]
        file = self._stack.enter_context(self.log.open("wb"))
        process = subprocess.Popen(command, stdout=file, stderr=subprocess.STDOUT)
        self._stack.callback(process.wait)
        self._stack.callback(process.kill)
        return process

    def start_laboratory(self) -> None:
        """A new laboratory, in a process of its own."""
        context = multiprocessing.get_context("spawn")
        self._words, theirs = context.Pipe()
        self.laboratory = context.Process(target=laboratory, args=(theirs, RATE), daemon=True)
        self.laboratory.start()
        self._stack.callback(self.laboratory.join)
        self._stack.callback(self.laboratory.kill)

    def say(self, word: str) -> None:
        """Tell the laboratory."""
        self._words.send(word)

    def until(self, holds: Callable[[], bool], seconds: float = PATIENCE) -> None:
        """Listen until something holds."""
        end = time.monotonic() + seconds
        while not holds():
            assert time.monotonic() < end, (self.statuses[-1:], self.log.read_text(errors="replace")[-1500:])
            self.listen()
            time.sleep(0.002)

    def listen(self) -> None:
        """Take what has arrived."""
        self.statuses += [json.loads(messages.read_text(message.data)) for message in self._statuses.take()]
        self.commands += [
            (message.arrival, messages.read_float_array(message.data)) for message in self._commands.take()
        ]

    @property
    def status(self) -> dict[str, Any]:
        return self.statuses[-1] if self.statuses else {"mode": "", "found": ["nothing yet"]}

    def run(self, modes: tuple[str, ...] = ("armed", "ramp", "run")) -> None:
        """All is well, the operator presses the switch and arms, and the robot is in one of the modes.

        On a machine that is busy with tests the laboratory may itself be late: then it is armed anew.
        """
        self.say("switch let go")
        self.until(lambda: "dead man" in self.status["found"])
        self.say("none")
        self.until(lambda: self.status["mode"] in ("idle", "stopped"))
        asked = [-1.0]

        def is_in_mode() -> bool:
            if self.status["mode"] in ("idle", "stopped") and self.clock.now() > asked[-1] + 2.0 * STOP_TIME:
                self.say("arm")
                asked.append(self.clock.now())
            return self.status["mode"] in modes

        self.until(is_in_mode)


@pytest.fixture
def watcher(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Watcher]:
    monkeypatch.setenv("ROS_DOMAIN_ID", own_domain())
    with ExitStack() as stack:
        clock = RealClock(RATE)
        node = stack.enter_context(make_transport("dds", "watcher", LOOPBACK, clock))
        yield Watcher(node, clock, stack, tmp_path)


def test_it_stops_without_a_laboratory_goes_on_with_a_new_one_and_ends_without_its_servo(watcher: Watcher):
    watcher.run()
    watcher.until(lambda: len(watcher.commands) > 10)
    watcher.laboratory.kill()
    watcher.until(lambda: watcher.status["mode"] == "stopped")
    watcher.start_laboratory()
    watcher.run()
    pid = watcher.deploy.pid
    for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split():
        os.kill(int(child), signal.SIGKILL)
    assert watcher.deploy.wait(PATIENCE) == 2
    said = watcher.log.read_text(errors="replace")
    assert "press its stop" in said
    assert "arm: joints up to 2.79 rad/s; commands up to 10 rad/s, 300 rad/s²" in said
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
            watcher.run(("armed",))
            watcher.say("point")
            watcher.until(lambda: watcher.status["mode"] in ("ramp", "run", "stopped"))
            watcher.say(fault)
            watcher.until(lambda: watcher.status["mode"] == "stopped")
        watcher.say("switch let go")
