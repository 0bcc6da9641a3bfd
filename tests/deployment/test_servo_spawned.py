"""A servo process over DDS, with a laboratory in this process."""

import os
import re
import signal
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from servo_rows import HOME, LIMITS
from wire_lab import WireLab

from domains import PATIENCE, own_domain
from pixel2catch.ros2.profile import Profile
from pixel2catch.ros2.transport import LOOPBACK, RealClock, Transport, make_transport
from pixel2catch.servo.limits import STOP_TIME
from pixel2catch.servo.link import Fault, Mode, flag_names
from pixel2catch.servo.process import RunningServo, ServoSetup, start_servo

RATE = 0.25
"""Rate of the clock: the servo runs slower than real time on a busy machine."""

AGES = ("tick_age", "image_age", "target_age", "operator_age")
LIMITS = replace(
    LIMITS,
    joints=replace(LIMITS.joints, position_age=np.full(LIMITS.num_joints, PATIENCE)),
    **dict.fromkeys(AGES, PATIENCE),
)
"""Limits under which nothing is late; `test_servo_process` tests ages with a stepped clock."""


class RealTimeLab:
    """A servo process and a laboratory that steps in real time."""

    def __init__(self, servo: RunningServo, lab: WireLab) -> None:
        self.servo, self.lab = servo, lab

    def until(self, holds: Callable[[], bool], seconds: float = PATIENCE) -> None:
        """Step the laboratory in real time until a condition holds."""
        begun, due = time.monotonic(), self.lab.clock.now()
        while not holds():
            assert time.monotonic() - begun < seconds, self.last_ticks
            self.lab.step()
            due = max(due + LIMITS.dt, self.lab.clock.now())
            self.lab.clock.sleep_until(due)

    def is_in(self, mode: Mode) -> bool:
        commands = self.lab.ticks
        return bool(commands) and commands[-1].mode == mode

    def run(self, holds: Callable[[], bool]) -> None:
        """Arm, and move the arm until a condition holds."""
        self.until(lambda: bool(self.lab.ticks))
        self.lab.target, asked = HOME + 0.1, [-1.0]

        def has_come() -> bool:
            if self.is_in(Mode.IDLE) and self.lab.clock.now() > asked[-1] + 2.0 * STOP_TIME:
                self.lab.request_arm()  # again, if a status was not received in time
                asked.append(self.lab.clock.now())
            return holds()

        self.until(has_come)

    @property
    def last_ticks(self) -> list[str]:
        """Modes and faults of the last ticks, for the message of a failing test."""
        return [
            str((each.mode, *tuple(flag_names(Fault, each.found | each.stopped_by))))
            for each in self.lab.ticks[-5:]
        ]


@pytest.fixture
def real_time_lab(monkeypatch: pytest.MonkeyPatch) -> Iterator[RealTimeLab]:
    monkeypatch.setenv("ROS_DOMAIN_ID", own_domain())
    profile, clock = Profile.load("ur5e_allegro_v4"), RealClock(RATE)
    setup = ServoSetup(profile=profile, limits=LIMITS)
    with start_servo(setup, partial(join, "servo"), RATE) as servo, join("laboratory", clock) as transport:
        yield RealTimeLab(servo, WireLab(transport, servo.link, profile, clock))


def join(name: str, clock: RealClock) -> Transport:
    return make_transport(name, LOOPBACK, clock)


def test_a_terminated_servo_stops_the_robot_first(real_time_lab: RealTimeLab):
    """Ctrl-C and Ctrl-Z are ignored."""
    process, lab = real_time_lab.servo.process, real_time_lab.lab
    real_time_lab.run(lambda: lab.joint_pos[0] > HOME[0] + 0.03)
    assert process.pid is not None
    os.kill(process.pid, signal.SIGINT)
    ignored = re.search(r"SigIgn:\s*(\w+)", Path(f"/proc/{process.pid}/status").read_text())
    assert ignored
    assert int(ignored[1], 16) >> (signal.SIGTSTP - 1) & 1
    real_time_lab.run(lambda: lab.joint_pos[0] > HOME[0] + 0.06)
    num_sent = len(lab.commands["arm"])
    process.terminate()
    real_time_lab.until(lambda: not process.is_alive())
    assert process.exitcode == 0

    def steps() -> np.ndarray:
        return np.abs(np.diff(lab.commands["arm"], axis=0)).max(axis=-1)

    real_time_lab.until(lambda: not steps()[-2:].any())  # what is still on its way is the stop
    assert steps()[:num_sent].max() > 1e-4
    assert len(lab.commands["arm"]) - num_sent < 2.0 * STOP_TIME / LIMITS.dt
