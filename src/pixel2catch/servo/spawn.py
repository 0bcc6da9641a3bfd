"""The servo's own process: it ends on SIGTERM, or with the control loop, after it has stopped the robot."""

import gc
import multiprocessing
import os
import signal
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from importlib.util import find_spec

from pixel2catch.errors import DeploymentError
from pixel2catch.installation import install_command
from pixel2catch.ros2.transport import RealClock, Transport
from pixel2catch.servo.link import (
    SERVO,
    SERVO_PRIORITY,
    LoopEnd,
    ServoEnd,
    link,
    scheduled,
    set_niceness,
    set_real_time,
)
from pixel2catch.servo.process import Servo, ServoSetup
from pixel2catch.servo.tick import ServoCore

PATIENCE = 10.0  #: Real time that a servo process has to end after its link was closed [s]. Source: ours.

MakeTransport = Callable[[RealClock], Transport]  #: Joins the network.


@contextmanager
def start_servo(
    setup: ServoSetup, make_transport: MakeTransport, clock_rate: float = 1.0
) -> Iterator[LoopEnd]:
    """Start a servo process, and yield the other end of its link.

    At the end of the context, it stops the robot and ends, or is killed.

    Raises:
        DeploymentError: numba is missing.
    """
    if not find_spec("numba"):  # importing it takes long, and only the servo process needs it
        raise DeploymentError(f"numba is not installed: {install_command('deployment')}.")
    loop, servo = link()
    with closing(servo):
        process = multiprocessing.get_context("spawn").Process(
            target=run_servo, args=(servo, setup, make_transport, clock_rate), name="servo", daemon=True
        )
        with scheduled(os.SCHED_OTHER, 0):  # starting takes seconds
            process.start()
    try:
        yield loop
    finally:
        loop.close()
        process.join(PATIENCE)
        if process.is_alive():
            process.kill()
            process.join()


def run_servo(end: ServoEnd, setup: ServoSetup, make_transport: MakeTransport, clock_rate: float) -> None:
    """Run the servo process until its link is closed, or SIGTERM or SIGHUP; Ctrl-C and Ctrl-Z are ignored."""
    for number in (signal.SIGINT, signal.SIGTSTP):
        signal.signal(number, signal.SIG_IGN)
    ServoCore(setup.limits)  # compile it before this is a real-time process
    set_niceness(SERVO)
    set_real_time(SERVO_PRIORITY)
    clock = RealClock(clock_rate)
    with make_transport(clock) as transport:
        servo = Servo(end, transport, setup, clock)
        for number in (signal.SIGTERM, signal.SIGHUP):
            signal.signal(number, lambda *_: servo.end())
        gc.collect()
        gc.freeze()
        gc.disable()
        servo.run()
