"""The servo as a process of its own: 500 times a second it hears, decides and commands.

It ends on SIGTERM, or when the control loop is gone, whatever ended it: first it stops the robot.
"""

import gc
import multiprocessing
import os
import signal
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass, replace
from importlib.util import find_spec
from math import ceil
from multiprocessing.context import SpawnProcess
from time import perf_counter

import numpy as np

from pixel2catch.errors import DeploymentError
from pixel2catch.installation import needs_extra
from pixel2catch.ros2.profile import Profile
from pixel2catch.ros2.transport import Clock, RealClock, Transport
from pixel2catch.servo.core import ServoCore, ServoState
from pixel2catch.servo.flags import Mode
from pixel2catch.servo.limits import STOP_TIME, ServoLimits
from pixel2catch.servo.link import Command, JointTargets, LoopEnd, ServoEnd, link
from pixel2catch.servo.subscriptions import ServoSubscriptions

SERVO, CONTROL_LOOP = -10, -8
"""Niceness of the servo, which is a real-time process where that is allowed, and of perception and policy.

Source: ours. Without it a busy machine takes the cores from the policy first: it works in one long piece.
"""

SERVO_PRIORITY, LOOP_PRIORITY, RECORDER_PRIORITY = 10, 5, 1
"""Priorities among real-time threads of the servo, of perception and policy, and of what is recorded of them.

Source: ours, below what drivers take. On two busy cores, images of 30 Hz: without it perception, which takes
7 ms of a core, is done 13 ms after an image in the median and 46 ms at p99, with it 10 and 13.
"""


def set_niceness(niceness: int) -> None:
    """Give this thread, and those that it starts, their place among all others."""
    with suppress(OSError):
        os.setpriority(os.PRIO_PROCESS, 0, niceness)


def set_real_time(priority: int) -> None:
    """Put this thread, and those that it starts, before all that are not real-time, where that is allowed."""
    with suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))


def give_way(priority: int) -> None:
    """Give this thread a lower priority among real-time ones, if it is one."""
    if os.sched_getscheduler(0) == os.SCHED_FIFO:
        set_real_time(priority)


@contextmanager
def scheduled(policy: int, priority: int) -> Iterator[bool]:
    """Another place for this thread among all others, for a while; say whether the system grants it."""
    before, is_granted = (os.sched_getscheduler(0), os.sched_getparam(0)), False
    with suppress(OSError):
        os.sched_setscheduler(0, policy, os.sched_param(priority))
        is_granted = True
    try:
        yield is_granted
    finally:
        with suppress(OSError):
            os.sched_setscheduler(0, *before)


PATIENCE = 10.0  #: Real time in which a servo process ends after its link is closed [s]. Source: ours.
HELD_SPEED = 0.5  #: Speed at which joints that are none of ours go where they are kept [rad/s]. Source: ours.


@dataclass(frozen=True, kw_only=True)
class ServoSetup:
    """What a servo is the servo of; all of it can be given to another process."""

    profile: Profile  #: The robot's drivers.
    limits: ServoLimits  #: What the servo keeps to.
    is_dry_run: bool = False  #: Whether nothing is sent; the robot is then not expected to follow.


class CommandPublisher:
    """What sends commands to the drivers, to each one as often as it takes them; to none in a dry run."""

    def __init__(self, transport: Transport, setup: ServoSetup, clock: Clock) -> None:
        """Announce the commands, and encode each once: the first time takes as long as eight ticks."""
        self._clock = clock
        parts = () if setup.is_dry_run else setup.profile.robots
        self.publishers = [transport.publisher(part.command_topic) for part in parts]
        periods = [max(round(1.0 / (part.rate_hz * setup.limits.dt)), 1) for part in parts]
        self._drivers = [*zip(parts, self.publishers, periods, strict=True)]
        self._tick, self._held_step = 0, HELD_SPEED * setup.limits.dt
        self._held = [part.held_angles for part in parts]
        self._is_kept = [True for _ in parts]
        for part in parts:
            part.command(np.zeros(setup.limits.num_joints))

    def send(self, command: np.ndarray, held: Sequence[np.ndarray]) -> None:
        """Send the commands of a tick in joint order [rad]; nothing while they are no numbers.

        Joints that are none of ours go from where they are measured, part by part [rad], to where they are
        kept.
        """
        if np.isnan(command).any():
            self._tick = 0
            return
        for number, (part, publisher, period) in enumerate(self._drivers):
            if self._tick == 0:
                self._held[number] = np.where(np.isfinite(held[number]), held[number], part.held_angles)
                self._is_kept[number] = False
            if not self._is_kept[number]:
                left = part.held_angles - self._held[number]
                self._held[number] = self._held[number] + left.clip(-self._held_step, self._held_step)
                self._is_kept[number] = not left.any()
            if self._tick % period == 0:
                publisher.publish(part.command(command, self._clock.stamp(), self._held[number]))
        self._tick += 1


class Servo:
    """The loop: `run` until it is asked to `end`, or nobody is left to command it; or call `tick`."""

    def __init__(self, end: ServoEnd, transport: Transport, setup: ServoSetup, clock: Clock) -> None:
        """Begin to listen; nothing is sent before the operator arms."""
        limits, num_joints = setup.limits, setup.limits.num_joints
        if setup.is_dry_run:
            anywhere = np.full(num_joints, np.inf)
            limits = replace(limits, joints=replace(limits.joints, tracking_error=anywhere, escape=anywhere))
        self._end, self._clock, self._core = end, clock, ServoCore(limits)
        self._commands = CommandPublisher(transport, setup, clock)
        publishers = self._commands.publishers
        self._subscriptions = ServoSubscriptions(transport, setup.profile, limits, publishers)
        self._state, self._joint_targets = ServoState.idle(1, limits), JointTargets.none(num_joints)
        self._is_ending = False
        #: What came up that nobody foresaw; the robot was stopped for it.
        self.unforeseen: Exception | None = None

    def end(self) -> None:
        """Stop the robot, and then return from `run`; any thread or signal may ask for it."""
        self._is_ending = True

    def run(self) -> None:
        """Tick at fixed moments; those that are missed are left out, not made up for.

        Raises:
            Exception: What nobody foresaw came up; the robot was stopped for it.
        """
        dt, due = self._core.limits.dt, self._clock.now()
        while not self._is_over:
            self.tick()
            due += dt * max(ceil((self._clock.now() - due) / dt), 1)
            self._clock.sleep_until(due)
        if self.unforeseen:
            raise self.unforeseen

    @property
    def _is_over(self) -> bool:
        """Whether it is to end, and nothing moves any more."""
        (robot,), dt = self._state.robots, self._core.limits.dt
        stands = robot["mode"] == Mode.STOPPED and robot["ticks"] * dt >= STOP_TIME
        return self._is_ending and bool(stands or robot["mode"] == Mode.IDLE)

    def tick(self) -> None:
        """Hear, decide, command and tell."""
        begun = perf_counter()
        self._guard(self._hear)
        now, joint_targets = self._clock.now(), self._joint_targets
        if self._is_ending:
            joint_targets = replace(joint_targets, is_stop_requested=True)
        inputs = self._subscriptions.inputs(now, joint_targets)
        self._state, output = self._core.tick(self._state, inputs)
        self._guard(lambda: self._commands.send(output.command[0], self._subscriptions.joints.held))
        self._end.send(
            Command(
                time=now,
                mode=int(output.mode[0]),
                stopped_by=int(output.stopped_by[0]),
                found=int(output.found[0]),
                refused=int(output.refused[0]),
                clamped=int(output.clamped[0]),
                joint_pos_command=output.command[0],
                joint_pos=inputs.joint_pos[0],
                duration=perf_counter() - begun,
                target_stamp=joint_targets.target_stamp,
                image_stamp=joint_targets.image_stamp,
            )
        )

    def _hear(self) -> None:
        """Take what control loop, robot and operator have said."""
        for joint_targets in self._end.receive():
            self._joint_targets = joint_targets
        if self._end.is_closed:
            self.end()
        self._subscriptions.hear(self._clock.now())

    def _guard(self, action: Callable[[], None]) -> None:
        """Do it; if something comes up, stop the robot first, and raise it then."""
        try:
            action()
        except Exception as error:
            self.unforeseen = self.unforeseen or error
            self.end()


@dataclass(frozen=True, kw_only=True)
class RunningServo:
    """A servo process that was started."""

    link: LoopEnd  #: The control loop's end of the link.
    process: SpawnProcess


MakeTransport = Callable[[RealClock], Transport]  #: Joins the network, on either side of a process's start.


@contextmanager
def start_servo(
    setup: ServoSetup, make_transport: MakeTransport, clock_rate: float = 1.0
) -> Iterator[RunningServo]:
    """Start a servo process; it is heard of over the link as soon as it ticks.

    At the end it stops the robot and is waited for; one that hangs is killed.

    Raises:
        DeploymentError: The compiler of its tick is missing.
    """
    with needs_extra("deployment", error=DeploymentError):
        if not find_spec("numba"):  # not imported here, beside perception
            raise ImportError("No module named 'numba'")
    loop, servo = link()
    with closing(servo):
        process = multiprocessing.get_context("spawn").Process(
            target=run_servo, args=(servo, setup, make_transport, clock_rate), name="servo", daemon=True
        )
        with scheduled(os.SCHED_OTHER, 0):  # it takes seconds to start
            process.start()
    try:
        yield RunningServo(link=loop, process=process)
    finally:
        loop.close()
        process.join(PATIENCE)
        if process.is_alive():
            process.kill()
            process.join()


def run_servo(end: ServoEnd, setup: ServoSetup, make_transport: MakeTransport, clock_rate: float) -> None:
    """Be the servo process, until the link is closed or on SIGTERM or SIGHUP, not by Ctrl-C or Ctrl-Z."""
    ServoCore(setup.limits)  # compiled before this is a real-time process
    for number in (signal.SIGINT, signal.SIGTSTP):
        signal.signal(number, signal.SIG_IGN)
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
