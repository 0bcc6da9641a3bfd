"""The servo as a process of its own: 500 times a second it hears, decides and commands.

It ends on SIGTERM, or when the control loop is gone, whatever ended it: first it stops the robot. A message
that cannot be read counts as none: its sender falls silent, and that is what stops the robot.
"""

import gc
import multiprocessing
import os
import signal
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass, replace
from math import ceil
from multiprocessing.context import SpawnProcess
from time import perf_counter
from typing import TypeVar

import numpy as np

from pixel2catch.errors import DeploymentError
from pixel2catch.ros2 import messages
from pixel2catch.ros2.profile import OperatorTopics, Profile, RobotPart, StatusTopics
from pixel2catch.ros2.transport import Clock, RealClock, Subscription, Topic, Transport
from pixel2catch.servo.core import Mode, ServoCore, ServoState
from pixel2catch.servo.limits import STOP_TIME, ServoLimits
from pixel2catch.servo.link import LoopEnd, PolicyCommand, ServoEnd, ServoStatus, link
from pixel2catch.servo.watchdogs import ServoInputs

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
def as_others() -> Iterator[None]:
    """Let what is started here be no real-time process: it takes seconds to start."""
    policy, priority = os.sched_getscheduler(0), os.sched_getparam(0)
    with suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    try:
        yield
    finally:
        with suppress(OSError):
            os.sched_setscheduler(0, policy, priority)


PATIENCE = 10.0  #: Real time in which a servo process ends after its link is closed [s]. Source: ours.
DEPTH = 16  #: Messages kept from one tick to the next: several senders may share a topic. Source: ours.
ARM_PAUSE = 0.5
"""Time without a request to arm after which the next one counts [s]: not one of many. Source: ours."""

POLL_TIME = 0.2  #: Time between two counts of the other publishers [s]. Source: ours.
SCALING_DIGITS = 3  #: Digits of a share of the speed: the driver multiplies two fractions. Source: ours.

T = TypeVar("T")


class _JointStates:
    """The newest position of each joint, by name, from any number of senders.

    Positions are in joint order [rad]. Their stamps are of the first arrival [s]: a message that repeats its
    stamp is an old one.
    """

    def __init__(self, transport: Transport, profile: Profile, num_joints: int) -> None:
        self.joint_pos = np.full(num_joints, np.nan)
        self.joint_stamp = np.full(num_joints, -np.inf)
        self._sent = np.full(num_joints, np.nan)
        senders: dict[Topic, list[RobotPart]] = {}
        for part in profile.robots:
            senders.setdefault(part.state_topic, []).append(part)
        self._senders = [(transport.subscription(topic, DEPTH), parts) for topic, parts in senders.items()]

    def hear(self) -> None:
        for subscription, parts in self._senders:
            for (ids, stamp), arrival in _read(
                subscription, lambda data, parts=parts: self._merge(data, parts)
            ):
                self._sent[ids], self.joint_stamp[ids] = stamp, arrival

    def _merge(self, data: bytes, parts: list[RobotPart]) -> tuple[np.ndarray, float]:
        """Note the positions; return the joints of which they are new, and when they were measured."""
        reading = messages.read_joint_state(data)
        ids = np.concatenate([part.merge(reading, self.joint_pos) for part in parts])
        return ids[self._sent[ids] != reading.stamp], reading.stamp


class _DriverStatus:
    """What the arm's driver says of itself. What the profile names and nobody has said yet is not well."""

    def __init__(self, transport: Transport, topics: StatusTopics) -> None:
        watched: list[tuple[Topic | None, Callable[[bytes], bool]]] = [
            (topics.safety_mode, lambda data: messages.read_safety_mode(data) == messages.NORMAL_SAFETY_MODE),
            (topics.robot_mode, lambda data: messages.read_robot_mode(data) == messages.RUNNING_ROBOT_MODE),
            (topics.program_running, messages.read_boolean),
        ]
        self._modes = [(transport.subscription(topic, DEPTH), read) for topic, read in watched if topic]
        self._is_well = [False] * len(self._modes)
        self._scaling = transport.subscription(topics.speed_scaling) if topics.speed_scaling else None
        self.speed_scaling = 1.0 if self._scaling is None else np.nan

    @property
    def is_safe(self) -> bool:
        """Whether the driver's program runs in the robot's normal mode."""
        return all(self._is_well)

    def hear(self) -> None:
        for number, (subscription, read) in enumerate(self._modes):
            for is_well, _ in _read(subscription, read):
                self._is_well[number] = is_well
        if self._scaling is not None:
            for percent, _ in _read(self._scaling, messages.read_number):
                self.speed_scaling = round(percent / 100.0, SCALING_DIGITS)


class _OperatorRequests:
    """What the operator does: stamps of the dead-man's switch, none if it was let go, and of requests [s].

    A message that was under way for longer than the switch may be silent says nothing of now, nor does one of
    the future.
    """

    def __init__(self, transport: Transport, topics: OperatorTopics, operator_age: float) -> None:
        self._operator_age = operator_age
        self.dead_man_stamp = self.pressed_stamp = self.arm_stamp = self._last_arm = -np.inf
        self.is_stop_requested = False
        self._dead_man, self._arm, self._stop = (
            transport.subscription(topic, DEPTH) for topic in (topics.dead_man, topics.arm, topics.stop)
        )

    def hear(self) -> None:
        for is_held, arrival in _read(self._dead_man, messages.read_boolean, self._operator_age):
            if is_held and arrival - self.dead_man_stamp > self._operator_age:
                self.pressed_stamp = arrival
            self.dead_man_stamp = arrival if is_held else -np.inf
        for asks, arrival in _read(self._arm, messages.read_boolean, self._operator_age):
            if asks and arrival - self._last_arm > ARM_PAUSE:
                self.arm_stamp = arrival
            self._last_arm = arrival if asks else self._last_arm
        self.is_stop_requested = any(asks for asks, _ in _read(self._stop, messages.read_boolean))


class ServoSubscriptions:
    """All that the servo hears over the network."""

    def __init__(self, transport: Transport, profile: Profile, limits: ServoLimits) -> None:
        """Begin to listen to all that a profile names."""
        self._transport = transport
        self._joints = _JointStates(transport, profile, limits.num_joints)
        self._status = _DriverStatus(transport, profile.status)
        self._operator = _OperatorRequests(transport, profile.operator, limits.operator_age)
        self._commands = [part.command_topic for part in profile.robots]
        self._switches = (profile.operator.dead_man, profile.operator.arm)
        self._has_other_publisher = self._has_other_operator = True
        self._next_poll = -np.inf

    def hear(self, now: float) -> None:
        """Take what has arrived."""
        self._joints.hear()
        self._status.hear()
        self._operator.hear()
        if now >= self._next_poll:
            self._next_poll = now + POLL_TIME
            num_publishers = self._transport.num_other_publishers
            self._has_other_publisher = any(num_publishers(topic) for topic in self._commands)
            self._has_other_operator = any(num_publishers(topic) > 1 for topic in self._switches)

    def inputs(self, now: float, policy_command: PolicyCommand) -> ServoInputs:
        """What the servo is told in a tick, with what the control loop has ordered last."""
        joints, status, operator = self._joints, self._status, self._operator
        return ServoInputs(
            now=np.array([now]),
            joint_pos=joints.joint_pos[None].copy(),
            joint_stamp=joints.joint_stamp[None].copy(),
            joint_pos_target=policy_command.joint_pos_target[None],
            target_stamp=np.array([policy_command.target_stamp]),
            image_stamp=np.array([policy_command.image_stamp]),
            dead_man_stamp=np.array([operator.dead_man_stamp]),
            pressed_stamp=np.array([operator.pressed_stamp]),
            arm_stamp=np.array([operator.arm_stamp]),
            is_stop_requested=np.array([operator.is_stop_requested or policy_command.is_stop_requested]),
            is_safe=np.array([status.is_safe]),
            speed_scaling=np.array([status.speed_scaling]),
            has_other_publisher=np.array([self._has_other_publisher]),
            has_other_operator=np.array([self._has_other_operator]),
        )


def _read(
    subscription: Subscription, read: Callable[[bytes], T], longest: float = np.inf
) -> Iterator[tuple[T, float]]:
    """What has arrived and can be read, with its time of arrival [s], if it was not too long under way."""
    for message in subscription.take():
        if abs(message.age) > longest:
            continue
        try:
            yield read(message.data), message.arrival
        except DeploymentError:
            continue


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
        self._drivers = [(part, transport.publisher(part.command_topic)) for part in parts]
        self._periods = [max(round(1.0 / (part.rate_hz * setup.limits.dt)), 1) for part in parts]
        self._tick = 0
        for part in parts:
            part.command(np.zeros(setup.limits.num_joints))

    def send(self, command: np.ndarray) -> None:
        """Send the commands of a tick in joint order [rad]; nothing while they are no numbers."""
        if np.isnan(command).any():
            self._tick = 0
            return
        for (part, publisher), period in zip(self._drivers, self._periods, strict=True):
            if self._tick % period == 0:
                publisher.publish(part.command(command, self._clock.stamp()))
        self._tick += 1


class Servo:
    """The loop: `run` until it is asked to `end`, or nobody is left to command it; or call `tick`."""

    def __init__(self, end: ServoEnd, transport: Transport, setup: ServoSetup, clock: Clock) -> None:
        """Begin to listen; nothing is sent before the operator arms."""
        limits, num_joints = setup.limits, setup.limits.num_joints
        if setup.is_dry_run:
            anywhere = np.full(num_joints, np.inf)
            limits = replace(limits, joints=replace(limits.joints, tracking_error=anywhere))
        self._end, self._clock, self._core = end, clock, ServoCore(limits)
        self._subscriptions = ServoSubscriptions(transport, setup.profile, limits)
        self._commands = CommandPublisher(transport, setup, clock)
        self._state, self._policy_command = ServoState.idle(1, num_joints), PolicyCommand.none(num_joints)
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
        stands = self._state.is_in(Mode.STOPPED) & (self._state.ticks * self._core.limits.dt >= STOP_TIME)
        return self._is_ending and bool((stands | self._state.is_in(Mode.IDLE))[0])

    def tick(self) -> None:
        """Hear, decide, command and tell."""
        begun = perf_counter()
        self._guard(self._hear)
        now, policy_command = self._clock.now(), self._policy_command
        if self._is_ending:
            policy_command = replace(policy_command, is_stop_requested=True)
        inputs = self._subscriptions.inputs(now, policy_command)
        self._state, output = self._core.tick(self._state, inputs)
        self._guard(lambda: self._commands.send(output.command[0]))
        self._end.send(
            ServoStatus(
                time=now,
                mode=int(output.mode[0]),
                stopped_by=int(output.stopped_by[0]),
                found=int(output.found[0]),
                refused=int(output.refused[0]),
                clamped=int(output.clamped[0]),
                command=output.command[0],
                joint_pos=inputs.joint_pos[0],
                duration=perf_counter() - begun,
                target_stamp=policy_command.target_stamp,
                image_stamp=policy_command.image_stamp,
            )
        )

    def _hear(self) -> None:
        """Take what control loop, robot and operator have said."""
        for policy_command in self._end.receive():
            self._policy_command = policy_command
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
    """
    loop, servo = link()
    with closing(servo):
        process = multiprocessing.get_context("spawn").Process(
            target=run_servo, args=(servo, setup, make_transport, clock_rate), name="servo", daemon=True
        )
        with as_others():
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
    """Be the servo process, until the link is closed or on SIGTERM or SIGHUP."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
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
