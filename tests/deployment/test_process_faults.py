"""A deployment, a camera and a laboratory, each a process: what happens to them stops the robot."""

import json
import os
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from loop_lab import BOX, PROFILE, RED, EverythingRed, new_pipeline, picture
from servo_rows import LIMITS
from test_servo_spawned import RATE, join, limits_of
from wire_lab import WireLab

from domains import PATIENCE, own_domain
from pixel2catch.deployment.control_loop import Connection, ControlLoop
from pixel2catch.deployment.operator import newest
from pixel2catch.ros2 import messages
from pixel2catch.ros2.transport import RealClock
from pixel2catch.scene.constants import CONTROL_DT, RGB_CAMERA
from pixel2catch.servo.limits import STOP_TIME
from pixel2catch.servo.process import ServoSetup, start_servo

AGE = 0.5  #: Age at which something is too old here [s]: 2 s of real time.
CLOCK = RealClock(RATE)


def deploy() -> None:
    """Control loop and servo, as `pixel2catch deploy` has them."""
    setup = ServoSetup(profile=PROFILE, limits=limits_of(AGE))
    with (
        ThreadPoolExecutor(1) as executor,
        join("deployment", CLOCK) as transport,
        start_servo(setup, partial(join, "servo"), RATE) as servo,
    ):
        connection = Connection(transport=transport, servo=servo, clock=CLOCK, recording=None)
        pipeline = new_pipeline(EverythingRed(RED))
        ControlLoop(pipeline, RGB_CAMERA, connection, PROFILE, executor).run(lambda: False, lambda _: None)


def film() -> None:
    """A camera, whose stamps are those of its images' arrival."""
    with join("camera", CLOCK) as transport:
        images = transport.publisher(PROFILE.camera.image)
        while True:
            images.publish(messages.image(picture(), CLOCK.stamp()))
            CLOCK.sleep_until(CLOCK.now() + CONTROL_DT)


class Site:
    """A laboratory in this process, with the processes around it."""

    def __init__(self, transport: Any) -> None:
        self.lab = WireLab(transport, None, PROFILE, CLOCK)
        self._prompts = transport.publisher(PROFILE.operator.prompt)
        self._statuses = transport.subscription(PROFILE.operator.status, 16)
        self.status: dict[str, Any] = {}
        self.processes: dict[Callable[[], None], Any] = {}
        self._asked, self._turn = 0.0, 0

    def start(self, work: Callable[[], None]) -> None:
        self.processes[work] = process = get_context("spawn").Process(target=work)
        process.start()
        self.status = {"mode": "", "stopped_by": []}

    def kill(self, work: Callable[[], None]) -> None:
        self.processes[work].kill()
        self.processes.pop(work).join()

    @property
    def deployment(self) -> tuple[int, int]:
        """Processes of control loop and servo."""
        loop = self.processes[deploy].pid
        return loop, int(Path(f"/proc/{loop}/task/{loop}/children").read_text())

    def until(self, holds: Callable[[], bool]) -> None:
        begun = time.monotonic()
        while not holds():
            assert time.monotonic() - begun < PATIENCE, self.status
            self.lab.step()
            self.status = newest(self._statuses.take(), self.status)
            CLOCK.sleep_until(CLOCK.now() + LIMITS.dt)

    def wait(self, seconds: float) -> None:
        end = CLOCK.now() + seconds
        self.until(lambda: CLOCK.now() > end)

    def run(self) -> None:
        """Release and press the switch, arm, and point, until the policy runs."""
        self.until(self._is_running)

    def _is_running(self) -> bool:
        mode, now = self.status["mode"], CLOCK.now()
        if now > self._asked + 2.0 * STOP_TIME and mode not in ("ramp", "run"):
            self._asked, self._turn = now, (self._turn + 1) % 3
            if mode == "armed":
                self._prompts.publish(messages.text(json.dumps({"box": BOX})))
            elif self._turn:
                self.lab.is_held = self._turn == 2
            else:
                self.lab.request_arm()
        return mode == "run"

    def schedule(self, cores: set[int], policy: int) -> None:
        """Set cores and scheduling of all threads of the deployment."""
        for process in self.deployment:
            for thread in map(int, os.listdir(f"/proc/{process}/task")):
                os.sched_setaffinity(thread, cores)
                os.sched_setscheduler(thread, policy, os.sched_param(0))


@contextmanager
def starved(site: Site) -> Iterator[None]:
    """Deployment and servo share a core with busy programs, and have the least priority."""
    cores = os.sched_getaffinity(0)
    site.schedule({min(cores)}, os.SCHED_IDLE)
    command = ["taskset", "-c", str(min(cores)), sys.executable, "-c", "while True: pass"]
    with ExitStack() as stack:
        stack.callback(site.schedule, cores, os.SCHED_OTHER)
        for _ in range(3):
            stack.callback(stack.enter_context(subprocess.Popen(command)).kill)
        yield


@contextmanager
def suspended(site: Site) -> Iterator[None]:
    """The control loop gets no processor time for a while, and sends no status; the servo does."""
    os.kill(site.deployment[0], signal.SIGSTOP)
    site.wait(2.0 * AGE)
    os.kill(site.deployment[0], signal.SIGCONT)
    yield


@contextmanager
def without_camera(site: Site) -> Iterator[None]:
    site.kill(film)
    yield
    site.start(film)


FAULTS = {
    without_camera: {"image stale"},
    suspended: {"policy late", "image stale"},
    starved: {"clock", "joints stale", "policy late", "image stale", "dead man"},
}
"""Faults, and the reasons for which the robot may be stopped; several come at the same time."""


@pytest.mark.slow
def test_faults_of_processes_stop_the_robot_until_it_is_armed_again(monkeypatch: pytest.MonkeyPatch):
    """Without new memory it goes on; a deployment that is killed for memory is stopped by its servo."""
    monkeypatch.setenv("ROS_DOMAIN_ID", own_domain())
    with ExitStack() as stack:
        at = Site(stack.enter_context(join("laboratory", CLOCK)))
        stack.callback(lambda: [at.kill(work) for work in [*at.processes]])
        for work in (deploy, film):
            at.start(work)
        for fault, reasons in FAULTS.items():
            at.run()
            with fault(at):
                at.until(lambda: bool(at.status["stopped_by"]))
                assert reasons & {*at.status["stopped_by"]}
        at.run()
        servo = at.deployment[1]
        for process in at.deployment:
            resource.prlimit(process, resource.RLIMIT_AS, (1, 1))
        at.wait(2.0)
        assert at.status["mode"] == "run"
        at.kill(deploy)
        at.until(lambda: not Path(f"/proc/{servo}").exists())
        assert not np.diff(at.lab.commands["arm"][-3:], axis=0).any()
        at.start(deploy)
        at.run()
