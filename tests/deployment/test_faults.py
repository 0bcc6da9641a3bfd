"""`pixel2catch deploy` as it is started, over DDS, in a laboratory in which things go wrong."""

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
from networks import own_domain
from servo_rows import LIMITS

from pixel2catch.ros2 import messages
from pixel2catch.ros2.profile import Profile
from pixel2catch.ros2.transport import RealClock, Topic, Transport, make_transport
from pixel2catch.servo.limits import STOP_TIME

RATE = 0.4
"""Rate of the clock: what is late on a machine that is busy with tests is not late by this one."""

PROFILE = Profile.load("ur5e_allegro_v4")
ARM = PROFILE.robots[0].command_topic


class Watcher:
    """Hears what `deploy` says and commands, and tells the laboratory what shall go wrong."""

    def __init__(self, node: Transport, clock: RealClock, stack: ExitStack, folder: Path) -> None:
        self.clock, self._stack = clock, stack
        self._statuses = node.subscription(PROFILE.operator.status, 50)
        self._commands = node.subscription(ARM, 2000)
        self.statuses: list[dict[str, Any]] = []
        self.commands: list[tuple[float, np.ndarray]] = []
        self.log = folder / "deploy.txt"
        self.deploy = self._start_deploy()
        self.start_laboratory()

    def _start_deploy(self) -> subprocess.Popen[bytes]:
        """Deploy, with eyes for red."""
        command = [sys.executable, "-m", "pixel2catch", "deploy", "--loopback", "--clock", str(RATE)]
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

    def until(self, holds: Callable[[], bool], seconds: float = 60.0) -> None:
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

    def run(self) -> None:
        """All is well, the operator arms and points, and the policy moves the arm.

        On a machine that is busy with tests the laboratory may itself be late: then it is armed anew.
        """
        self.say("none")
        self.until(lambda: self.status["mode"] in ("idle", "stopped", "run"))
        asked = [-1.0]

        def is_running() -> bool:
            if self.status["mode"] in ("idle", "stopped") and self.clock.now() > asked[-1] + 0.3:
                self.say("arm")
                asked.append(self.clock.now())
            return self.status["mode"] == "run"

        self.until(is_running)

    def stopped_by(self) -> list[str]:
        """Wait for the stop, and for the commands to stand still, which must not take too long."""
        self.until(lambda: self.status["mode"] == "stopped")
        reasons, begun = self.status["stopped_by"], self.clock.now()
        self.until(lambda: self.clock.now() > begun + 2.0 * STOP_TIME)
        late = [command for arrival, command in self.commands if arrival > begun + 1.3 * STOP_TIME]
        assert len(late) > 10
        assert not np.diff(late, axis=0).any()
        return reasons

    def other(self, topic: Topic) -> None:
        """Somebody else who publishes on a topic."""
        node = self._stack.enter_context(make_transport("dds", "somebody", True, self.clock))
        node.publisher(topic).publish(messages.float_array(self.commands[-1][1]))


@pytest.fixture(scope="module")
def watcher(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Watcher]:
    before, os.environ["ROS_DOMAIN_ID"] = os.environ.get("ROS_DOMAIN_ID"), own_domain()
    with ExitStack() as stack:
        clock = RealClock(RATE)
        node = stack.enter_context(make_transport("dds", "watcher", True, clock))
        yield Watcher(node, clock, stack, tmp_path_factory.mktemp("deploy"))
    if before is None:
        del os.environ["ROS_DOMAIN_ID"]
    else:
        os.environ["ROS_DOMAIN_ID"] = before


@pytest.mark.parametrize(
    ("fault", "reasons"),
    [
        ("camera killed", {"image stale"}),
        ("publisher frozen", {"joints stale"}),
        ("NaN joint", {"joints not finite"}),
        ("joint missing", {"joints stale"}),
        ("images late", {"image stale"}),
        ("wrong image size", {"image stale"}),
        ("protective stop", {"safety mode"}),
        ("slider", {"speed scaling"}),
        ("switch let go", {"dead man"}),
    ],
)
def test_a_fault_stops_the_robot(fault: str, reasons: set[str], watcher: Watcher):
    watcher.run()
    watcher.say(fault)
    assert reasons & set(watcher.stopped_by())


def test_a_stop_is_latched_until_somebody_arms(watcher: Watcher):
    watcher.say("none")
    watcher.until(lambda: not {"safety mode", "joints stale"} & set(watcher.status["found"]))
    num = len(watcher.statuses)
    watcher.until(lambda: len(watcher.statuses) > num + 20)
    assert {status["mode"] for status in watcher.statuses[num:]} == {"stopped"}


def test_joints_in_another_order_change_nothing(watcher: Watcher):
    watcher.run()
    watcher.say("joints shuffled")
    num = len(watcher.statuses)
    watcher.until(lambda: len(watcher.statuses) > num + 20)
    assert watcher.status["mode"] == "run"


def test_a_policy_that_hangs_stops_the_robot(watcher: Watcher):
    """The control loop sleeps; the servo does not."""
    watcher.run()
    watcher.deploy.send_signal(signal.SIGSTOP)
    begun = watcher.clock.now()
    watcher.until(lambda: watcher.clock.now() > begun + 0.067 + 2.0 * STOP_TIME)
    still = [command for arrival, command in watcher.commands if arrival > begun + 0.1 + 1.3 * STOP_TIME]
    watcher.deploy.send_signal(signal.SIGCONT)
    assert len(still) > 10
    assert not np.diff(still, axis=0).any()
    watcher.until(lambda: watcher.status["mode"] == "stopped")
    assert {"policy late", "image stale"} & set(watcher.status["stopped_by"])


def test_a_killed_laboratory_stops_everything_and_a_new_one_can_be_armed(watcher: Watcher):
    watcher.run()
    watcher.laboratory.kill()
    assert {"joints stale", "image stale"} & set(watcher.stopped_by())
    watcher.start_laboratory()
    watcher.run()


def test_somebody_else_who_commands_the_robot_stops_it(watcher: Watcher):
    watcher.run()
    watcher.other(ARM)
    assert "other publisher" in watcher.stopped_by()


def test_no_command_passed_a_limit(watcher: Watcher):
    """Over all that was commanded here."""
    arm = PROFILE.robots[0].ids
    commands = np.array([command for _, command in watcher.commands])
    assert len(commands) > 1000
    assert (commands >= LIMITS.joints.lower[arm] - 1e-9).all()
    assert (commands <= LIMITS.joints.upper[arm] + 1e-9).all()


def test_without_its_servo_the_brain_ends_with_an_error(watcher: Watcher):
    pid = watcher.deploy.pid
    for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split():
        os.kill(int(child), signal.SIGKILL)
    assert watcher.deploy.wait(20) == 2
    assert "press its stop" in watcher.log.read_text(errors="replace")
