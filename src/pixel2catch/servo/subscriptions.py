"""What the servo hears: joint states, the robot's status, the operator, and who else commands the robot.

A message that cannot be read counts as none: its sender falls silent, and that is what stops the robot.
"""

from collections.abc import Callable, Iterator
from typing import TypeVar

import numpy as np

from pixel2catch.errors import DeploymentError
from pixel2catch.ros2 import messages
from pixel2catch.ros2.profile import OperatorTopics, Profile, RobotPart, StatusTopics
from pixel2catch.ros2.transport import Subscription, Topic, Transport
from pixel2catch.scene.constants import JOINTS
from pixel2catch.servo.link import PolicyCommand
from pixel2catch.servo.watchdogs import ServoInputs

DEPTH = 16
"""Messages that are kept from one tick to the next: several senders may share a topic. Source: ours."""

POLL_TIME = 0.2
"""Time between two counts of the other publishers [s]. Source: ours."""

SCALING_DIGITS = 3
"""Digits to which a share of the speed counts: the driver multiplies two fractions. Source: ours."""

T = TypeVar("T")


class JointStateSubscriber:
    """The newest position of each joint, by name, from any number of senders.

    Attributes:
        joint_pos: Positions in joint order [rad].
        joint_stamp: When each arrived first [s]; a message that repeats its stamp is an old one.
    """

    def __init__(self, transport: Transport, profile: Profile) -> None:
        """Begin to listen."""
        self.joint_pos = np.full(len(JOINTS), np.nan)
        self.joint_stamp = np.full(len(JOINTS), -np.inf)
        self._sent = np.full(len(JOINTS), np.nan)
        topics = {part.state_topic.name: part.state_topic for part in profile.robots}
        self._senders = [
            (
                transport.subscription(topic, DEPTH),
                [part for part in profile.robots if part.state_topic.name == name],
            )
            for name, topic in topics.items()
        ]

    def hear(self) -> None:
        """Take what has arrived."""
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


class DriverStatusSubscriber:
    """What the arm's driver says of itself. What the profile names and nobody has said yet is not well."""

    def __init__(self, transport: Transport, topics: StatusTopics) -> None:
        """Begin to listen."""
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
        """Take what has arrived."""
        for number, (subscription, read) in enumerate(self._modes):
            for is_well, _ in _read(subscription, read):
                self._is_well[number] = is_well
        if self._scaling is not None:
            for percent, _ in _read(self._scaling, messages.read_number):
                self.speed_scaling = round(percent / 100.0, SCALING_DIGITS)


class OperatorSubscriber:
    """What the operator does.

    Attributes:
        dead_man_stamp: When the dead-man's switch was last held [s]; none if it was let go since.
        arm_stamp: When the operator last asked to arm [s].
        is_stop_requested: Whether the operator has asked to stop since the tick before.
    """

    def __init__(self, transport: Transport, topics: OperatorTopics) -> None:
        """Begin to listen."""
        self.dead_man_stamp = self.arm_stamp = -np.inf
        self.is_stop_requested = False
        self._dead_man, self._arm, self._stop = (
            transport.subscription(topic, DEPTH) for topic in (topics.dead_man, topics.arm, topics.stop)
        )

    def hear(self) -> None:
        """Take what has arrived."""
        for is_held, arrival in _read(self._dead_man, messages.read_boolean):
            self.dead_man_stamp = arrival if is_held else -np.inf
        for asks, arrival in _read(self._arm, messages.read_boolean):
            self.arm_stamp = arrival if asks else self.arm_stamp
        self.is_stop_requested = any(asks for asks, _ in _read(self._stop, messages.read_boolean))


class ServoSubscriptions:
    """All that the servo hears over the network."""

    def __init__(self, transport: Transport, profile: Profile) -> None:
        """Begin to listen to all that a profile names."""
        self._transport = transport
        self.joints = JointStateSubscriber(transport, profile)
        self._status = DriverStatusSubscriber(transport, profile.status)
        self._operator = OperatorSubscriber(transport, profile.operator)
        self._commands = [part.command_topic for part in profile.robots]
        self._has_other_publisher, self._next_poll = True, -np.inf

    def hear(self, now: float) -> None:
        """Take what has arrived."""
        self.joints.hear()
        self._status.hear()
        self._operator.hear()
        if now >= self._next_poll:
            self._next_poll = now + POLL_TIME
            others = (self._transport.num_other_publishers(topic) for topic in self._commands)
            self._has_other_publisher = any(others)

    def inputs(self, now: float, policy_command: PolicyCommand) -> ServoInputs:
        """What the servo is told in a tick, with what the control loop has ordered last."""
        joints, status, operator = self.joints, self._status, self._operator
        return ServoInputs(
            now=np.array([now]),
            joint_pos=joints.joint_pos[None].copy(),
            joint_stamp=joints.joint_stamp[None].copy(),
            joint_pos_target=policy_command.joint_pos_target[None],
            target_stamp=np.array([policy_command.target_stamp]),
            image_stamp=np.array([policy_command.image_stamp]),
            dead_man_stamp=np.array([operator.dead_man_stamp]),
            arm_stamp=np.array([operator.arm_stamp]),
            is_stop_requested=np.array([operator.is_stop_requested or policy_command.is_stop_requested]),
            is_safe=np.array([status.is_safe]),
            speed_scaling=np.array([status.speed_scaling]),
            has_other_publisher=np.array([self._has_other_publisher]),
        )


def _read(subscription: Subscription, read: Callable[[bytes], T]) -> Iterator[tuple[T, float]]:
    """What has arrived and can be read, with its time of arrival [s]."""
    for message in subscription.take():
        try:
            yield read(message.data), message.arrival
        except DeploymentError:
            continue
