"""A servo process over DDS, with a laboratory in this process."""

import multiprocessing
import os
import re
import signal
import time
from collections.abc import Callable
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
from pixel2catch.servo.process import ServoSetup, start_servo

RATE = 0.25
"""Rate of the clock: the servo runs slower than real time on a busy machine."""

AGES = ("tick_age", "image_age", "target_age", "operator_age")
LIMITS = replace(
    LIMITS,
    joints=replace(LIMITS.joints, position_age=np.full(LIMITS.num_joints, PATIENCE)),
    **dict.fromkeys(AGES, PATIENCE),
)
"""Limits under which nothing is late; `test_servo_process` tests ages with a stepped clock."""


def join(name: str, clock: RealClock) -> Transport:
    return make_transport(name, LOOPBACK, clock)


def test_a_terminated_servo_stops_the_robot_first(monkeypatch: pytest.MonkeyPatch):
    """Ctrl-C and Ctrl-Z are ignored."""
    monkeypatch.setenv("ROS_DOMAIN_ID", own_domain())
    profile, clock = Profile.load("ur5e_allegro_v4"), RealClock(RATE)
    setup = ServoSetup(profile=profile, limits=LIMITS)
    with start_servo(setup, partial(join, "servo"), RATE) as servo, join("laboratory", clock) as transport:
        lab, asked = WireLab(transport, servo, profile, clock), [-1.0]
        (process,) = multiprocessing.active_children()
        lab.target = HOME + 0.1

        def until(holds: Callable[[], bool]) -> None:
            """Step the laboratory in real time until a condition holds, and arm a robot that is idle."""
            begun, due = time.monotonic(), clock.now()
            while not holds():
                last = [(each.mode, *flag_names(Fault, each.found)) for each in lab.ticks[-5:]]
                assert time.monotonic() - begun < PATIENCE, last
                lab.step()
                is_idle = bool(lab.ticks) and lab.ticks[-1].mode == Mode.IDLE
                if is_idle and clock.now() > asked[-1] + 2.0 * STOP_TIME:
                    lab.request_arm()  # again, if a status was not received in time
                    asked.append(clock.now())
                due = max(due + LIMITS.dt, clock.now())
                clock.sleep_until(due)

        until(lambda: lab.joint_pos[0] > HOME[0] + 0.03)
        assert process.pid is not None
        os.kill(process.pid, signal.SIGINT)
        ignored = re.search(r"SigIgn:\s*(\w+)", Path(f"/proc/{process.pid}/status").read_text())
        assert ignored
        assert int(ignored[1], 16) >> (signal.SIGTSTP - 1) & 1
        until(lambda: lab.joint_pos[0] > HOME[0] + 0.06)
        num_sent = len(lab.commands["arm"])
        process.terminate()
        until(lambda: not process.is_alive())
        assert process.exitcode == 0

        def steps() -> np.ndarray:
            return np.abs(np.diff(lab.commands["arm"], axis=0)).max(axis=-1)

        until(lambda: not steps()[-2:].any())  # what is still on its way is the stop
        assert steps()[:num_sent].max() > 1e-4
        assert len(lab.commands["arm"]) - num_sent < 2.0 * STOP_TIME / LIMITS.dt
