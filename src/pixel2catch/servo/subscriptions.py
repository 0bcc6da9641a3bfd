"""What the servo hears over the network: joints, the drivers' status, the operator, and who else is there.

A message that cannot be read counts as none: its sender falls silent, and that is what stops the robot.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import lru_cache, partial
from typing import Generic, NamedTuple, TypeVar

import numpy as np

from pixel2catch.errors import DeploymentError
from pixel2catch.ros2 import messages
from pixel2catch.ros2.joint_states import JointStateReader
from pixel2catch.ros2.messages import JointReading
from pixel2catch.ros2.profile import Columns, OperatorTopics, Profile, RobotPart
from pixel2catch.ros2.transport import Message, Publisher, Topic, Transport
from pixel2catch.servo.core import ServoInputs
from pixel2catch.servo.limits import ServoLimits
from pixel2catch.servo.link import JointTargets

DEPTH = 16  #: Messages kept from one tick to the next: several senders may share a topic. Source: ours.
MOST_BYTES = 2**14
"""Bytes of a message that is read. Source: ours; robots' have up to 3,000, more would hold up ticks."""

ARM_PAUSE = 0.5
"""Time without a request to arm after which the next one counts [s]: not one of many. Source: ours."""

ORDER_TIME = 0.1
"""Time without new positions of a joint after which older ones count: of a clock that was set [s].

Source: ours; twice the age from which they stop the robot.
"""

POLL_TIME = 0.2  #: Time between two counts of publishers, subscribers or cameras [s]. Source: ours.
SCALING_DIGITS = 3  #: Digits of a share of the speed: the driver multiplies two fractions. Source: ours.

SCALING_AGE = 0.1
"""Age of the newest speed scaling up to which it holds [s]. Source: ours, ten periods of the UR driver."""

T = TypeVar("T")


class JointStates:
    """The newest position of each joint, by name, from any number of senders.

    Positions are in joint order [rad]. Their stamps are of the arrival [s]: a message that repeats its stamp,
    or has an older one, was there before, or is of a recording that is played beside the robot.
    """

    def __init__(self, transport: Transport, profile: Profile, num_joints: int) -> None:
        """Begin to listen."""
        self.joint_pos = np.full(num_joints, np.nan)
        self.joint_stamp = np.full(num_joints, -np.inf)
        #: Where the joints of each part are that are none of ours [rad]; NaN where that is not said.
        self.held = [np.full(len(part.held), np.nan) for part in profile.robots]
        self._sent = np.full(num_joints, -np.inf)
        numbers: dict[Topic, list[int]] = {}
        for number, part in enumerate(profile.robots):
            numbers.setdefault(part.state_topic, []).append(number)
        self._topics = [
            (transport.subscription(topic, DEPTH), _reader({n: profile.robots[n] for n in of_topic}))
            for topic, of_topic in numbers.items()
        ]

    def hear(self) -> None:
        """Take what has arrived."""
        for subscription, read in self._topics:
            for (reading, order), arrival in _read(subscription.take(), read):
                self._merge(reading, order, arrival)

    def _merge(self, reading: JointReading, order: "_JointOrder", arrival: float) -> None:
        """Note the positions that are new."""
        sent, is_old = self._sent[order.ids], arrival - self.joint_stamp[order.ids] > ORDER_TIME
        is_new = (reading.stamp > sent) | (is_old & (reading.stamp < sent))
        ids = order.ids[is_new]
        self.joint_pos[ids] = reading.position[order.columns[is_new]]
        self._sent[ids], self.joint_stamp[ids] = reading.stamp, arrival
        is_late = len(order.ids) > len(ids) == 0  # a message with none of our joints has no order to keep
        for number, columns, places in () if is_late else order.held:
            measured, held = reading.position[columns], self.held[number]
            held[places] = np.where(np.isfinite(measured), measured, held[places])


class _JointOrder(NamedTuple):
    """Where a joint state of some names has what is listened to."""

    columns: Columns  #: Columns of joints,
    ids: Columns  #: and which they are, in joint order.
    held: list[tuple[int, Columns, Columns]]  #: Number of a part, columns and places of joints that it holds.


def _reader(parts: Mapping[int, RobotPart]) -> Callable[[bytes], tuple[JointReading, _JointOrder]]:
    """What reads a joint state, and where it has the joints of parts, by their numbers."""
    read, order_of = JointStateReader().read, lru_cache(DEPTH)(partial(_joint_order, parts))

    def read_in_order(data: bytes) -> tuple[JointReading, _JointOrder]:
        reading = read(data)
        return reading, order_of(reading.names)

    return read_in_order


def _joint_order(parts: Mapping[int, RobotPart], names: tuple[str, ...]) -> _JointOrder:
    """The order of such names for parts, by their numbers; raises as `RobotPart.columns`."""
    columns, ids = np.concatenate([part.columns(names) for part in parts.values()], axis=1)
    held = [(number, *part.held_columns(names)) for number, part in parts.items()]
    return _JointOrder(columns, ids, [entry for entry in held if len(entry[1])])


class _Said(Generic[T]):
    """The newest that a driver says on a topic; None before the first, and when it holds no more."""

    def __init__(
        self, transport: Transport, topic: Topic, read: Callable[[bytes], T], longest: float = np.inf
    ) -> None:
        """Begin to listen; what is said holds for so long [s]."""
        self.value: T | None = None
        self._transport, self._topic, self._read, self._longest = transport, topic, read, longest
        self._subscription, self._stamp = transport.subscription(topic, DEPTH), -np.inf
        self._num_senders = 1

    @property
    def is_known(self) -> bool:
        """Whether one sender has said it, and it holds."""
        return self.value is not None and self._num_senders == 1

    def hear(self, now: float) -> None:
        """Take what has arrived up to now [s]."""
        for value, arrival in _read(self._subscription.take(), self._read):
            self.value, self._stamp = value, arrival
        if now - self._stamp > self._longest:
            self.value = None

    def count_senders(self) -> None:
        """Forget what was latched by somebody who is gone; believe nobody while there are several."""
        self._num_senders = self._transport.num_other_publishers(self._topic)
        if not self._num_senders:
            self.value = None


class DriverStatus:
    """What the drivers say of themselves. What the profile names is unknown until it is said.

    What is latched holds as long as its sender is there, the speed scaling for a short time.
    """

    def __init__(self, transport: Transport, profile: Profile) -> None:
        """Begin to listen to what the profile names."""
        topics = profile.status
        modes: list[tuple[Topic | None, Callable[[bytes], bool]]] = [
            (topics.safety_mode, lambda data: messages.read_safety_mode(data) == messages.NORMAL_SAFETY_MODE),
            (topics.robot_mode, lambda data: messages.read_robot_mode(data) == messages.RUNNING_ROBOT_MODE),
            (topics.program_running, messages.read_boolean),
        ]
        self._modes = [_Said(transport, topic, read) for topic, read in modes if topic]
        self._controllers = [
            _Said(transport, part.controller.activity, partial(_is_active, part.controller.name))
            for part in profile.robots
            if part.controller
        ]
        scaling = [topics.speed_scaling] if topics.speed_scaling else []
        self._scaling = [_Said(transport, topic, messages.read_number, SCALING_AGE) for topic in scaling]
        self._all = (*self._modes, *self._controllers, *self._scaling)

    @property
    def is_known(self) -> bool:
        """Whether all of it is known."""
        return all(said.is_known for said in self._all)

    @property
    def is_safe(self) -> bool:
        """Whether nothing that is known says that the robot is not in its normal mode, or does not run."""
        return not any(said.value is False for said in self._modes)

    @property
    def has_controller(self) -> bool:
        """Whether nothing that is known says that a controller which takes our commands is not active."""
        return not any(said.value is False for said in self._controllers)

    @property
    def speed_scaling(self) -> float:
        """Share of the full speed at which the robot runs; 1 while that is unknown."""
        percent = next((said.value for said in self._scaling if said.value is not None), 100.0)
        return round(percent / 100.0, SCALING_DIGITS)

    def hear(self, now: float) -> None:
        """Take what has arrived up to now [s]."""
        for said in self._all:
            said.hear(now)

    def count_senders(self) -> None:
        """Look who is there."""
        for said in self._all:
            said.count_senders()


def _is_active(controller: str, data: bytes) -> bool:
    return controller in messages.read_active_controllers(data)


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
        for is_held, arrival in _read(self._dead_man.take(), messages.read_boolean, self._operator_age):
            if is_held and arrival - self.dead_man_stamp > self._operator_age:
                self.pressed_stamp = arrival
            self.dead_man_stamp = arrival if is_held else -np.inf
        for asks, arrival in _read(self._arm.take(), messages.read_boolean, self._operator_age):
            if asks and arrival - self._last_arm > ARM_PAUSE:
                self.arm_stamp = arrival
            self._last_arm = arrival if asks else self._last_arm
        stops = self._stop.take()
        is_any_lost = len(stops) >= DEPTH  # and what is lost may have asked to
        self.is_stop_requested = is_any_lost or any(asks for asks, _ in _read(stops, messages.read_boolean))


class ServoSubscriptions:
    """All that the servo hears over the network."""

    def __init__(
        self, transport: Transport, profile: Profile, limits: ServoLimits, commands: Sequence[Publisher]
    ) -> None:
        """Begin to listen to all that a profile names, and see who takes our commands; none in a dry run."""
        self._transport, self._publishers = transport, commands
        self.joints = JointStates(transport, profile, limits.num_joints)
        self._status = DriverStatus(transport, profile)
        self._operator = _OperatorRequests(transport, profile.operator, limits.operator_age)
        self._commands = [part.command_topic for part in profile.robots]
        self._switches = (profile.operator.dead_man, profile.operator.arm)
        self._has_other_publisher = self._has_other_operator = True
        self._num_subscribers: list[int] = [0]
        self._next_poll = -np.inf

    def hear(self, now: float) -> None:
        """Take what has arrived."""
        self.joints.hear()
        self._status.hear(now)
        self._operator.hear()
        if now >= self._next_poll:
            self._next_poll = now + POLL_TIME
            num_publishers = self._transport.num_other_publishers
            self._has_other_publisher = any(num_publishers(topic) for topic in self._commands)
            self._has_other_operator = any(num_publishers(topic) > 1 for topic in self._switches)
            self._num_subscribers = [publisher.num_subscribers() for publisher in self._publishers]
            self._status.count_senders()

    def inputs(self, now: float, joint_targets: JointTargets) -> ServoInputs:
        """What the servo is told in a tick, with what the control loop has ordered last."""
        joints, status, operator = self.joints, self._status, self._operator
        return ServoInputs(
            joint_pos=joints.joint_pos[None].copy(),
            joint_stamp=joints.joint_stamp[None].copy(),
            joint_pos_target=joint_targets.joint_pos_target[None],
            **_rows(
                now=now,
                target_stamp=joint_targets.target_stamp,
                image_stamp=joint_targets.image_stamp,
                box_stamp=joint_targets.box_stamp,
                dead_man_stamp=operator.dead_man_stamp,
                pressed_stamp=operator.pressed_stamp,
                arm_stamp=operator.arm_stamp,
                speed_scaling=status.speed_scaling,
            ),
            **_rows(
                is_perception_sound=joint_targets.is_perception_sound,
                is_stop_requested=operator.is_stop_requested or joint_targets.is_stop_requested,
                is_safe=status.is_safe,
                is_status_known=status.is_known,
                has_controller=status.has_controller,
                has_other_publisher=self._has_other_publisher,
                has_other_operator=self._has_other_operator,
                has_subscriber=all(self._num_subscribers),
                has_other_subscriber=max(self._num_subscribers, default=0) > 1,
            ),
        )


def _rows(**values: float) -> dict[str, np.ndarray]:
    """One row of each value; all of them are numbers, or all are flags."""
    return dict(zip(values, np.array([*values.values()])[:, None], strict=True))


def _read(
    arrived: list[Message], read: Callable[[bytes], T], longest: float = np.inf
) -> Iterator[tuple[T, float]]:
    """What has arrived and can be read, with its time of arrival [s].

    Left out is what has more than `MOST_BYTES`, or was under way for longer than the longest time [s].
    """
    for message in arrived:
        if abs(message.age) > longest or len(message.data) > MOST_BYTES:
            continue
        try:
            yield read(message.data), message.arrival
        except DeploymentError:
            continue
