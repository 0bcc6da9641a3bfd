"""The loop of the servo: 500 times a second it reads its inputs, ticks, and sends commands.

It is a process of its own, which ends on request, on SIGTERM, or with the control loop, after it has stopped
the robot. Messages that cannot be read are ignored: their sender counts as silent, which stops the robot.
"""

import gc
import multiprocessing
import os
import signal
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from importlib.util import find_spec
from math import ceil
from time import perf_counter
from typing import Any, Generic, TypeVar

import numpy as np

from pixel2catch.errors import DeploymentError
from pixel2catch.installation import install_command
from pixel2catch.interruption import without_interrupts
from pixel2catch.ros2 import messages
from pixel2catch.ros2.profile import Columns, Profile
from pixel2catch.ros2.transport import POLL_TIME, Clock, Message, Publisher, RealClock, Topic, Transport
from pixel2catch.servo import link
from pixel2catch.servo.limits import STOP_TIME, ServoLimits
from pixel2catch.servo.link import Command, JointTargets, LoopEnd, Mode, ServoEnd
from pixel2catch.servo.state import ServoInputs
from pixel2catch.servo.tick import ServoCore, ServoState

HELD_SPEED = 0.5  #: Speed at which held joints move to their angle [rad/s]. Source: ours.
DEPTH = 16  #: Messages kept from one tick to the next; several senders may share a topic. Source: ours.
MOST_BYTES = 2**14  #: Largest message that is read [bytes]. Source: ours; robots' have up to 3,000.
ARM_PAUSE = 0.5  #: Pause after which a request to arm counts, and not as a repetition [s]. Source: ours.
ORDER_TIME = 0.1  #: Silence of a joint after which older stamps count: a clock was set [s]. Source: ours.
SCALING_DIGITS = 3  #: Digits of the speed scaling: the driver multiplies two fractions. Source: ours.
PATIENCE = 10.0  #: Real time that a servo process has to end after its link was closed [s]. Source: ours.
SCALING_AGE = 0.1  #: Age up to which a speed scaling holds [s]. Source: ours, ten periods of the UR driver.

T = TypeVar("T")


def _decoded(
    received: list[Message], read: Callable[[bytes], T], longest: float = np.inf
) -> Iterator[tuple[T, float]]:
    """Yield the messages that can be read and were sent at most so long ago [s], with their arrival [s]."""
    for message in received:
        if abs(message.age) <= longest and len(message.data) <= MOST_BYTES:
            with suppress(DeploymentError):
                yield read(message.data), message.arrival


#: Columns of a joint state, their joints in joint order; part, columns and places of the held joints.
_Order = tuple[Columns, Columns, list[tuple[int, Columns, Columns]]]


class JointStates:
    """The newest position of each joint, by name, from any number of senders.

    Messages with a repeated or older stamp are ignored: repetitions, or a recording that is being played.
    """

    def __init__(self, transport: Transport, profile: Profile, num_joints: int) -> None:
        self.joint_pos = np.full(num_joints, np.nan)  #: In joint order [rad].
        self.joint_stamp = np.full(num_joints, -np.inf)  #: [s].
        #: Positions of the held joints of each part [rad]; NaN if not measured.
        self.held = [np.full(len(part.held), np.nan) for part in profile.robots]
        self._parts, self._sent = profile.robots, np.full(num_joints, -np.inf)
        self._order = lru_cache(DEPTH)(self._find_order)
        topics = dict.fromkeys(part.state_topic for part in profile.robots)
        self._subscriptions = {topic: transport.subscription(topic, DEPTH) for topic in topics}

    def read(self) -> None:
        for topic, subscription in self._subscriptions.items():
            for reading, arrival in _decoded(subscription.take(), messages.read_joint_state):
                with suppress(DeploymentError):
                    self._merge(reading, self._order(topic, reading.names), arrival)

    def _merge(self, reading: messages.JointReading, order: _Order, arrival: float) -> None:
        columns, known, of_held = order
        sent, is_old = self._sent[known], arrival - self.joint_stamp[known] > ORDER_TIME
        is_new = (reading.stamp > sent) | (is_old & (reading.stamp < sent))
        ids = known[is_new]
        self.joint_pos[ids] = reading.position[columns[is_new]]
        self._sent[ids], self.joint_stamp[ids] = reading.stamp, arrival
        is_repetition = len(known) > len(ids) == 0
        for number, columns, places in () if is_repetition else of_held:
            measured, held = reading.position[columns], self.held[number]
            held[places] = np.where(np.isfinite(measured), measured, held[places])

    def _find_order(self, topic: Topic, names: tuple[str, ...]) -> _Order:
        parts = {number: part for number, part in enumerate(self._parts) if part.state_topic == topic}
        columns, ids = np.concatenate([part.columns(names) for part in parts.values()], axis=1)
        return columns, ids, [(n, *part.held_columns(names)) for n, part in parts.items()]


class _Latest(Generic[T]):
    """The latest value of a driver's topic; None before the first, and when it no longer holds."""

    def __init__(
        self, transport: Transport, topic: Topic, read: Callable[[bytes], T], longest: float = np.inf
    ) -> None:
        self.value: T | None = None
        self._transport, self._topic, self._read, self._longest = transport, topic, read, longest
        self._subscription, self._stamp = transport.subscription(topic, DEPTH), -np.inf
        self.num_senders = 1

    def update(self, now: float) -> None:
        for value, arrival in _decoded(self._subscription.take(), self._read):
            self.value, self._stamp = value, arrival
        if now - self._stamp > self._longest:
            self.value = None

    def count_senders(self) -> None:
        """Discard a latched value whose sender is gone."""
        self.num_senders = self._transport.num_other_publishers(self._topic)
        self.value = self.value if self.num_senders else None


class ServoSubscriptions:
    """Inputs of the servo from the network: joints, status of the drivers, operator."""

    def __init__(
        self, transport: Transport, profile: Profile, limits: ServoLimits, commands: Sequence[Publisher]
    ) -> None:
        self._transport, self._publishers, self._profile = transport, commands, profile
        self.joints = JointStates(transport, profile, limits.num_joints)
        latest = partial(_Latest[Any], transport)
        modes: dict[str, Callable[[bytes], bool]] = {
            "safety_mode": lambda data: messages.read_safety_mode(data) == messages.NORMAL_SAFETY_MODE,
            "robot_mode": lambda data: messages.read_robot_mode(data) == messages.RUNNING_ROBOT_MODE,
            "program_running": messages.read_boolean,
        }
        controllers = [part.controller for part in profile.robots if part.controller]
        status = [each for arm in profile.all_status for each in arm.items()]
        self._modes = [latest(topic, modes[name]) for name, topic in status if name in modes]
        self._controllers = [
            latest(each.activity, lambda data, name=each.name: name in messages.read_active_controllers(data))
            for each in controllers
        ]
        scaling = partial(latest, read=messages.read_number, longest=SCALING_AGE)
        self._scaling = [scaling(topic) for name, topic in status if name not in modes]
        self._status = (*self._modes, *self._controllers, *self._scaling)
        topics, self._operator_age = profile.operator, limits.operator_age
        self._dead_man, self._arm, self._stop = (
            transport.subscription(topic, DEPTH) for topic in (topics.dead_man, topics.arm, topics.stop)
        )
        self._dead_man_stamp = self._pressed_stamp = self._arm_stamp = self._last_arm = -np.inf
        self._is_stop_requested, self._next_poll = False, -np.inf
        self._has_other_publisher = self._has_other_operator = True
        self._num_subscribers: list[int] = [0]

    def read(self, now: float) -> None:
        """Read new messages; from time to time, count publishers and subscribers."""
        self.joints.read()
        for latest in self._status:
            latest.update(now)
        self._read_operator()
        if now >= self._next_poll:
            self._next_poll, count = now + POLL_TIME, self._transport.num_other_publishers
            topics = self._profile.operator
            self._has_other_publisher = any(count(part.command_topic) for part in self._profile.robots)
            self._has_other_operator = any(count(topic) > 1 for topic in (topics.dead_man, topics.arm))
            self._num_subscribers = [publisher.num_subscribers() for publisher in self._publishers]
            for latest in self._status:
                latest.count_senders()

    def _read_operator(self) -> None:  # a message that is older than the switch may be silent does not count
        for is_held, arrival in _decoded(self._dead_man.take(), messages.read_boolean, self._operator_age):
            if is_held and arrival - self._dead_man_stamp > self._operator_age:
                self._pressed_stamp = arrival
            self._dead_man_stamp = arrival if is_held else -np.inf
        for is_request, arrival in _decoded(self._arm.take(), messages.read_boolean, self._operator_age):
            if is_request and arrival - self._last_arm > ARM_PAUSE:
                self._arm_stamp = arrival
            self._last_arm = arrival if is_request else self._last_arm
        stops = self._stop.take()  # if messages were lost, one of them may have been a request
        self._is_stop_requested = len(stops) >= DEPTH or any(
            each for each, _ in _decoded(stops, messages.read_boolean)
        )

    def inputs(self, now: float, targets: JointTargets) -> ServoInputs:
        percents = [each.value for each in self._scaling if each.value is not None]
        shares = [round(percent / 100.0, SCALING_DIGITS) for percent in percents]
        passed_on = ("target_stamp", "image_stamp", "box_stamp", "is_perception_sound", "is_planned")
        values = {name: getattr(targets, name) for name in passed_on} | {
            "now": now,
            "dead_man_stamp": self._dead_man_stamp,
            "pressed_stamp": self._pressed_stamp,
            "arm_stamp": self._arm_stamp,
            "is_stop_requested": self._is_stop_requested or targets.is_stop_requested,
            "speed_scaling": next((share for share in shares if share != 1.0), 1.0),
            "is_safe": all(each.value is not False for each in self._modes),
            "is_status_known": all(each.value is not None and each.num_senders == 1 for each in self._status),
            "has_controller": all(each.value is not False for each in self._controllers),
            "has_other_publisher": self._has_other_publisher,
            "has_other_operator": self._has_other_operator,
            "has_subscriber": all(self._num_subscribers),
            "has_other_subscriber": max(self._num_subscribers, default=0) > 1,
        }
        return ServoInputs(
            joint_pos=self.joints.joint_pos[None].copy(),
            joint_stamp=self.joints.joint_stamp[None].copy(),
            joint_pos_target=targets.joint_pos_target[None],
            **{name: np.array([value]) for name, value in values.items()},
        )


@dataclass(frozen=True, kw_only=True)
class ServoSetup:
    """Drivers and limits of a servo; it can be passed to another process."""

    profile: Profile  #: The robot's drivers.
    limits: ServoLimits
    is_dry_run: bool = False  #: Whether nothing is sent; the robot is then not expected to follow.


class CommandPublisher:
    """Sends commands to each driver at its rate; in a dry run to none."""

    def __init__(self, transport: Transport, setup: ServoSetup, clock: Clock) -> None:
        """Announce the topics, and encode a command for each: the first time is slow."""
        self._clock = clock
        parts = () if setup.is_dry_run else setup.profile.robots
        self.publishers = [transport.publisher(part.command_topic) for part in parts]
        periods = [max(round(1.0 / (part.rate_hz * setup.limits.dt)), 1) for part in parts]
        self._drivers = [*zip(parts, self.publishers, periods, strict=True)]
        self._tick, self._held_step = 0, HELD_SPEED * setup.limits.dt
        self._held = [part.held_angles for part in parts]
        for part in parts:
            part.command(np.zeros(setup.limits.num_joints), part.held_angles)

    def send(self, command: Command, held: Sequence[np.ndarray]) -> None:
        """Send a command, if it has positions. Held joints go from their positions [rad] to their angles."""
        if np.isnan(command.joint_pos_command).any():
            self._tick = 0
            return
        for number, (part, publisher, period) in enumerate(self._drivers):
            if self._tick == 0:
                self._held[number] = np.where(np.isfinite(held[number]), held[number], part.held_angles)
            left = part.held_angles - self._held[number]
            self._held[number] = self._held[number] + left.clip(-self._held_step, self._held_step)
            if self._tick % period == 0:
                positions, stamp = command.joint_pos_command, self._clock.stamp()
                publisher.publish(part.command(positions, self._held[number], stamp))
        self._tick += 1


class Servo:
    """The servo's loop: `run` until `end` is called or the control loop has ended, or call `tick`."""

    def __init__(self, end: ServoEnd, transport: Transport, setup: ServoSetup, clock: Clock) -> None:
        limits = setup.limits
        if setup.is_dry_run:
            anywhere = np.full(limits.num_joints, np.inf)
            limits = replace(limits, joints=replace(limits.joints, tracking_error=anywhere, escape=anywhere))
        self._end, self._clock, self._core, self._dt = end, clock, ServoCore(limits), limits.dt
        self._commands = CommandPublisher(transport, setup, clock)
        publishers = self._commands.publishers
        self._subscriptions = ServoSubscriptions(transport, setup.profile, limits, publishers)
        self._state, self._targets = ServoState.idle(1, limits), JointTargets.none(limits.num_joints)
        self._is_ending = False
        self.unforeseen: Exception | None = None  #: An unexpected error; the robot was stopped first.

    def end(self) -> None:
        """Stop the robot and return from `run`; any thread or signal handler may call this."""
        self._is_ending = True

    def run(self) -> None:
        """Tick at a fixed rate, without missed ticks; raise unexpected errors after the robot was stopped."""
        due = self._clock.now()
        while not (self._is_ending and self._is_at_rest):
            self.tick()
            due += self._dt * max(ceil((self._clock.now() - due) / self._dt), 1)
            self._clock.sleep_until(due)
        if self.unforeseen:
            raise self.unforeseen

    @property
    def _is_at_rest(self) -> bool:
        mode, seconds = self._state["mode"][0], self._state["ticks"][0] * self._dt
        return bool(mode == Mode.IDLE or (mode == Mode.STOPPED and seconds >= STOP_TIME))

    def tick(self) -> None:
        """Read the inputs, tick, and send the command to drivers and control loop."""
        begun = perf_counter()
        self._guard(self._read)
        now, targets = self._clock.now(), self._targets
        if self._is_ending:
            targets = replace(targets, is_stop_requested=True)
        inputs = self._subscriptions.inputs(now, targets)
        self._state = state = self._core.tick(self._state, inputs)
        command = Command(
            time=now,
            duration=0.0,
            target_stamp=targets.target_stamp,
            image_stamp=targets.image_stamp,
            joint_pos_command=state["sent"][0],
            joint_pos=inputs.joint_pos[0],
            **{name: int(state[name][0]) for name in ("mode", "stopped_by", "found", "refused", "clamped")},
        )
        self._guard(lambda: self._commands.send(command, self._subscriptions.joints.held))
        self._end.send(replace(command, duration=perf_counter() - begun))

    def _read(self) -> None:
        for targets in self._end.receive():
            self._targets = targets
        if self._end.is_closed:
            self.end()
        self._subscriptions.read(self._clock.now())

    def _guard(self, action: Callable[[], None]) -> None:
        try:
            action()
        except Exception as error:
            self.unforeseen = self.unforeseen or error
            self.end()


@contextmanager
def start_servo(
    setup: ServoSetup, make_transport: Callable[[RealClock], Transport], clock_rate: float = 1.0
) -> Iterator[LoopEnd]:
    """Start a servo process, which joins a network, and yield the other end of its link.

    At the end of the context, it stops the robot and ends, or is killed. Raises as `ServoCore` does.
    """
    if not find_spec("numba"):  # importing it takes long, and only the servo process needs it
        raise DeploymentError(f"numba is not installed: {install_command('deployment')}.")
    loop, servo = link.link()
    with closing(servo):
        process = multiprocessing.get_context("spawn").Process(
            target=run_servo, args=(servo, setup, make_transport, clock_rate), name="servo", daemon=True
        )
        with link.scheduled(os.SCHED_OTHER, 0), without_interrupts():  # starting takes seconds
            process.start()
    try:
        yield loop
    finally:
        loop.close()
        process.join(PATIENCE)
        if process.is_alive():
            process.kill()
            process.join()


def run_servo(
    end: ServoEnd, setup: ServoSetup, make_transport: Callable[[RealClock], Transport], clock_rate: float
) -> None:
    """Run the servo process until its link is closed, or SIGTERM or SIGHUP; Ctrl-C and Ctrl-Z are ignored."""
    for number in (signal.SIGINT, signal.SIGTSTP):
        signal.signal(number, signal.SIG_IGN)
    ServoCore(setup.limits)  # compile it before this is a real-time process
    link.set_niceness(link.SERVO)
    link.set_real_time(link.SERVO_PRIORITY)
    clock = RealClock(clock_rate)
    with make_transport(clock) as transport:
        servo = Servo(end, transport, setup, clock)
        for number in (signal.SIGTERM, signal.SIGHUP):
            signal.signal(number, lambda *_: servo.end())
        gc.collect()
        gc.freeze()
        gc.disable()
        servo.run()
