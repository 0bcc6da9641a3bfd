"""A laboratory on the wire, with a servo that runs against it in time that does not pass by itself."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from servo_rows import HOME, LIMITS

from pixel2catch.ros2 import messages
from pixel2catch.ros2.messages import decode
from pixel2catch.ros2.profile import Profile, RobotPart
from pixel2catch.ros2.transport import Clock, Topic, Transport
from pixel2catch.scene.constants import CONTROL_DT
from pixel2catch.servo.link import Command, JointTargets, LoopEnd


class WireLab:
    """Drivers, operator and control loop; `step` lets them all speak once. What is in `silent` says nothing.

    The joints follow the commands with the lag of their servos. `change` distorts an outgoing joint state.
    """

    def __init__(self, transport: Transport, loop: LoopEnd, profile: Profile, clock: Clock) -> None:
        self.transport, self.loop, self.profile, self.clock = transport, loop, profile, clock
        self.joint_pos, self.target = HOME.copy(), HOME.copy()
        self.silent: set[str] = set()
        self.change: Callable[[messages.JointReading], messages.JointReading] = lambda reading: reading
        self.commands: dict[str, list[np.ndarray]] = {part.name: [] for part in profile.robots}
        self.ticks: list[Command] = []
        self.image_age, self.speed, self.is_held = 0.03, 100.0, True
        self._tick = 0
        self._controllers = [part.controller for part in profile.robots if part.controller]
        self.topics = [*self._topics()]
        self._publishers = {topic.name: transport.publisher(topic) for topic in self.topics}
        self._heard = {part.name: transport.subscription(part.command_topic, 50) for part in profile.robots}

    def _topics(self) -> Iterator[Topic]:
        status, operator = self.profile.status, self.profile.operator
        watched = (status.safety_mode, status.robot_mode, status.program_running, status.speed_scaling)
        yield from {each.activity.name: each.activity for each in self._controllers}.values()
        yield from {part.state_topic.name: part.state_topic for part in self.profile.robots}.values()
        yield from (topic for topic in watched if topic)
        yield from (operator.arm, operator.dead_man, operator.stop)

    def say(self, topic: Topic | None, data: bytes) -> None:
        """Publish a message of a topic, if the profile has it."""
        if topic is not None and topic.name not in self.silent:
            self._publishers[topic.name].publish(data)

    def ask_to_arm(self) -> None:
        self.say(self.profile.operator.arm, messages.boolean(True))

    def _say_status(self) -> None:
        status = self.profile.status
        self.say(status.safety_mode, messages.safety_mode(1))
        self.say(status.robot_mode, messages.robot_mode(7))
        self.say(status.program_running, messages.boolean(True))
        for each in self._controllers:
            self.say(each.activity, messages.activity({each.name: messages.ACTIVE, "other": 1}, 0.0))

    def step(self) -> None:
        """Let 2 ms pass in the laboratory."""
        self._move()
        if self._tick == 0:
            self._say_status()
        for part in self.profile.robots:
            if part.name not in self.silent:
                self._say_joints(part)
        self.say(self.profile.status.speed_scaling, messages.number(self.speed))
        if self._tick % 25 == 0:
            self.say(self.profile.operator.dead_man, messages.boolean(self.is_held))
        if self._tick % round(CONTROL_DT / LIMITS.dt) == 0 and "brain" not in self.silent:
            now = self.clock.now()
            image_stamp = now - self.image_age
            self.loop.send(
                JointTargets(
                    joint_pos_target=self.target,
                    target_stamp=now,
                    image_stamp=image_stamp,
                    box_stamp=image_stamp,
                )
            )
        self.ticks += self.loop.receive()
        self._tick += 1

    def _say_joints(self, part: RobotPart) -> None:
        names = [theirs.name_in_state for theirs in part.joints.values()]
        reading = messages.JointReading(
            names=tuple(names), position=self.joint_pos[part.ids], stamp=self.clock.stamp()
        )
        reading = self.change(reading)
        self.say(part.state_topic, messages.joint_state(reading.names, reading.position, reading.stamp))

    def _move(self) -> None:
        """The drivers follow the newest commands, which they have in an order of their own."""
        for part in self.profile.robots:
            for message in self._heard[part.name].take():
                is_array = part.command_topic.type == messages.FLOAT_ARRAY
                read = messages.read_float_array if is_array else _positions
                self.commands[part.name].append(read(message.data))
            if self.commands[part.name]:
                places = [theirs.index_in_command for theirs in part.joints.values()]
                goal = self.commands[part.name][-1][places]
                follow = np.minimum(LIMITS.dt / LIMITS.joints.lag[part.ids], 1.0)
                self.joint_pos[part.ids] += follow * (goal - self.joint_pos[part.ids])


def _positions(data: bytes) -> np.ndarray:
    message: Any = decode(data, messages.JOINT_STATE)
    return np.array(message.position)


def shuffled(reading: messages.JointReading) -> messages.JointReading:
    """The same in another order, with a joint that nobody knows in front."""
    order = np.random.default_rng(len(reading.names)).permutation(len(reading.names))
    return replace(
        reading,
        names=("gripper", *(reading.names[place] for place in order)),
        position=np.concatenate(([9.0], reading.position[order])),
    )


def without_elbow(reading: messages.JointReading) -> messages.JointReading:
    """The same without the elbow, if it has one."""
    places = [place for place, name in enumerate(reading.names) if name != "elbow_joint"]
    return replace(
        reading, names=tuple(reading.names[place] for place in places), position=reading.position[places]
    )


def twice(reading: messages.JointReading) -> messages.JointReading:
    """The same with its first joint once more."""
    return replace(
        reading,
        names=(*reading.names, reading.names[0]),
        position=np.append(reading.position, reading.position[0]),
    )


def frozen(reading: messages.JointReading) -> messages.JointReading:
    """The same with a stamp that stands still."""
    return replace(reading, stamp=5.0)
