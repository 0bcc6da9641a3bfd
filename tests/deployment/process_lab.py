"""`pixel2catch deploy` and a laboratory as processes over DDS, and who watches both."""

import json
import multiprocessing
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
from arming import Arming
from camera_lab import Fault, laboratory

from domains import PATIENCE
from pixel2catch.ros2 import messages
from pixel2catch.ros2.profile import Profile
from pixel2catch.ros2.transport import RealClock, Transport

PROFILE = Profile.load("ur5e_allegro_v4")
ARM = PROFILE.robots[0].command_topic


class Watcher(Arming):
    """Hears what `deploy` says and commands, and tells the laboratory what shall go wrong."""

    def __init__(self, node: Transport, clock: RealClock, stack: ExitStack, folder: Path) -> None:
        self.clock, self._stack = clock, stack
        self.guests = stack.enter_context(ExitStack())  # who else is on the network, until it is closed
        self._statuses = node.subscription(PROFILE.operator.status, 50)
        self._commands = node.subscription(ARM, 2000, only_watches=True)
        self.statuses: list[dict[str, Any]] = []
        self.commands: list[tuple[float, np.ndarray]] = []
        self.log = folder / "deploy.txt"
        self.deploy = self._start_deploy()
        self.start_laboratory()

    def _start_deploy(self) -> subprocess.Popen[bytes]:
        """Deploy, with eyes for red."""
        command = [sys.executable, "-m", "pixel2catch", "deploy", "--clock", f"{self.clock.rate:g}"]
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
        self.laboratory = context.Process(target=laboratory, args=(theirs, self.clock.rate), daemon=True)
        self.laboratory.start()
        self._stack.callback(self.laboratory.join)
        self._stack.callback(self.laboratory.kill)

    def say(self, word: str | Fault) -> None:
        """Tell the laboratory one of its words, or what it shall do."""
        self._words.send(word)

    def until(self, holds: Callable[[], bool], seconds: float = PATIENCE) -> None:
        """Listen until something holds."""
        end = time.monotonic() + seconds
        while not holds():
            assert time.monotonic() < end, (self.statuses[-1:], self.log.read_text(errors="replace")[-1500:])
            self.listen()
            time.sleep(0.002)

    def rest(self, seconds: float) -> None:
        """Listen for a while of the clock [s]."""
        end = self.clock.now() + seconds
        self.until(lambda: self.clock.now() >= end)

    def listen(self) -> None:
        """Take what has arrived."""
        self.statuses += [json.loads(messages.read_text(message.data)) for message in self._statuses.take()]
        self.commands += [
            (message.arrival, messages.read_float_array(message.data)) for message in self._commands.take()
        ]

    @property
    def time(self) -> float:
        return self.clock.now()

    @property
    def status(self) -> dict[str, Any]:
        return self.statuses[-1] if self.statuses else {"mode": "", "found": ["nothing yet"]}
