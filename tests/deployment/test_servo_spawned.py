"""A servo process over DDS, with a laboratory in this process."""

import multiprocessing
import os
import re
import resource
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from servo_rows import HOME, LIMITS
from wire_lab import WireLab

from domains import PATIENCE, own_domain
from pixel2catch.ros2.profile import Profile
from pixel2catch.ros2.transport import LOOPBACK, RealClock, Transport, make_transport
from pixel2catch.servo.limits import STOP_TIME, ServoLimits
from pixel2catch.servo.link import Fault, LoopEnd, Mode, flag_names
from pixel2catch.servo.process import ServoSetup, start_servo

RATE = 0.25
"""Rate of the clock: the servo runs slower than real time on a busy machine."""

AGES = ("tick_age", "image_age", "target_age", "operator_age")
PROFILE = Profile.load("ur5e_allegro_v4")


def limits_of(age: float) -> ServoLimits:
    """Return limits under which everything may be so old [s]."""
    joints = replace(LIMITS.joints, position_age=np.full(LIMITS.num_joints, age))
    return replace(LIMITS, joints=joints, **dict.fromkeys(AGES, age))


def join(name: str, clock: RealClock) -> Transport:
    return make_transport(name, LOOPBACK, clock)


@dataclass
class Running:
    lab: WireLab
    loop: LoopEnd
    clock: RealClock
    process: Any
    asked: float = -1.0

    @property
    def mode(self) -> int | None:
        return self.lab.ticks[-1].mode if self.lab.ticks else None

    def until(self, holds: Callable[[], bool]) -> None:
        """Step the laboratory in real time until a condition holds; arm a robot that is idle or stopped."""
        begun, due = time.monotonic(), self.clock.now()
        while not holds():
            last = [(each.mode, *flag_names(Fault, each.found)) for each in self.lab.ticks[-5:]]
            assert time.monotonic() - begun < PATIENCE, last
            self.lab.step()
            is_at_rest = self.mode in (Mode.IDLE, Mode.STOPPED)
            if is_at_rest and self.clock.now() > self.asked + 2.0 * STOP_TIME:
                self.lab.request_arm()  # again, if a status was not received in time
                self.asked = self.clock.now()
            due = max(due + LIMITS.dt, self.clock.now())
            self.clock.sleep_until(due)


@contextmanager
def running(limits: ServoLimits, monkeypatch: pytest.MonkeyPatch) -> Iterator[Running]:
    monkeypatch.setenv("ROS_DOMAIN_ID", own_domain())
    clock, setup = RealClock(RATE), ServoSetup(profile=PROFILE, limits=limits)
    with start_servo(setup, partial(join, "servo"), RATE) as loop, join("laboratory", clock) as transport:
        (process,) = multiprocessing.active_children()
        yield Running(WireLab(transport, loop, PROFILE, clock), loop, clock, process)


def test_a_terminated_servo_stops_the_robot_first(monkeypatch: pytest.MonkeyPatch):
    """Ctrl-C and Ctrl-Z are ignored."""
    with running(limits_of(PATIENCE), monkeypatch) as run:
        lab, process = run.lab, run.process
        lab.target = HOME + 0.1
        run.until(lambda: lab.joint_pos[0] > HOME[0] + 0.03)
        os.kill(process.pid, signal.SIGINT)
        ignored = re.search(r"SigIgn:\s*(\w+)", Path(f"/proc/{process.pid}/status").read_text())
        assert ignored
        assert int(ignored[1], 16) >> (signal.SIGTSTP - 1) & 1
        run.until(lambda: lab.joint_pos[0] > HOME[0] + 0.06)
        num_sent = len(lab.commands["arm"])
        process.terminate()
        run.until(lambda: not process.is_alive())
        assert process.exitcode == 0

        def steps() -> np.ndarray:
            return np.abs(np.diff(lab.commands["arm"], axis=0)).max(axis=-1)

        run.until(lambda: not steps()[-2:].any())  # what is still on its way is the stop
        assert steps()[:num_sent].max() > 1e-4
        assert len(lab.commands["arm"]) - num_sent < 2.0 * STOP_TIME / LIMITS.dt


AGE = 0.5  #: Age at which something is too old here [s]: 2 s of real time.


@pytest.mark.slow
def test_faults_of_processes_stop_the_robot_until_it_is_armed_again(monkeypatch: pytest.MonkeyPatch):
    """Without new memory it goes on. A control loop that is killed closes its end of the link."""
    with running(limits_of(AGE), monkeypatch) as run:
        pid = run.process.pid
        run.until(lambda: run.mode == Mode.RUN)
        os.kill(pid, signal.SIGSTOP)  # no processor time
        end = run.clock.now() + 2.0 * AGE
        run.until(lambda: run.clock.now() > end)
        os.kill(pid, signal.SIGCONT)
        run.until(lambda: run.mode == Mode.STOPPED)
        assert "clock" in flag_names(Fault, run.lab.ticks[-1].stopped_by)
        run.until(lambda: run.mode == Mode.RUN)
        resource.prlimit(pid, resource.RLIMIT_AS, (1, 1))
        end = run.clock.now() + 1.0
        run.until(lambda: run.clock.now() > end)
        assert run.mode == Mode.RUN
        run.loop.close()
        run.lab.loop = None
        run.until(lambda: not run.process.is_alive())
        assert not np.diff(run.lab.commands["arm"][-3:], axis=0).any()


@pytest.mark.slow
def test_a_killed_servo_is_noticed_at_the_end_of_its_link(monkeypatch: pytest.MonkeyPatch):
    with running(limits_of(2.0), monkeypatch) as run:
        run.until(lambda: run.mode == Mode.RUN)
        run.process.kill()
        run.until(lambda: run.loop.is_closed)
