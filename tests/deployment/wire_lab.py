"""Drivers, operator and control loop as messages in memory, and a servo with a stepped clock."""

from collections.abc import Callable
from dataclasses import replace
from itertools import groupby
from typing import Any

import numpy as np
from servo_rows import HOME, LIMITS

from pixel2catch.deployment.control_loop import StepClock
from pixel2catch.ros2 import messages
from pixel2catch.ros2.memory import Broker
from pixel2catch.ros2.profile import Profile, RobotPart
from pixel2catch.ros2.transport import Clock, Topic, Transport
from pixel2catch.scene.constants import CONTROL_DT
from pixel2catch.servo.link import Command, Fault, JointTargets, LoopEnd, Mode, ServoEnd, flag_names
from pixel2catch.servo.process import Servo, ServoSetup


class WireLab:
    """Drivers, operator and control loop; `step` sends all messages of 2 ms, except of what is in `silent`.

    The joints follow the commands with the lag of their servos. `change` distorts an outgoing joint state.
    """

    def __init__(self, transport: Transport, loop: LoopEnd | None, profile: Profile, clock: Clock) -> None:
        self.transport, self.loop, self.profile, self.clock = transport, loop, profile, clock
        self.joint_pos, self.target = HOME.copy(), HOME.copy()
        self.silent: set[str] = set()
        self.change: Callable[[messages.JointReading], messages.JointReading] = lambda reading: reading
        self.commands: dict[str, list[np.ndarray]] = {part.name: [] for part in profile.robots}
        self.ticks: list[Command] = []
        self.image_age, self.speed, self.is_held = 0.03, 100.0, True
        self._tick = 0
        self._controllers = [part.controller for part in profile.robots if part.controller]
        operator = profile.operator
        self.topics = [*profile.driver_topics, operator.arm, operator.dead_man, operator.stop]
        self._publishers = {topic.name: transport.publisher(topic) for topic in self.topics}
        self._commanded = {
            each.name: transport.subscription(each.command_topic, 50) for each in profile.robots
        }

    def send(self, topic: Topic | None, data: bytes) -> None:
        """Publish a message of a topic, if the profile has it."""
        if topic is not None and topic.name not in self.silent:
            self._publishers[topic.name].publish(data)

    def request_arm(self) -> None:
        self.send(self.profile.operator.arm, messages.boolean(True))

    def send_status(self) -> None:
        status = self.profile.status
        self.send(status.safety_mode, messages.safety_mode(1))
        self.send(status.robot_mode, messages.robot_mode(7))
        self.send(status.program_running, messages.boolean(True))
        for each in self._controllers:
            self.send(each.activity, messages.activity({each.name: messages.ACTIVE, "other": 1}, 0.0))

    def step(self) -> None:
        self._move()
        if self._tick == 0:
            self.send_status()
        for part in self.profile.robots:
            if part.name not in self.silent:
                self._send_joints(part)
        self.send(self.profile.status.speed_scaling, messages.number(self.speed))
        if self._tick % 25 == 0:
            self.send(self.profile.operator.dead_man, messages.boolean(self.is_held))
        if self.loop:
            self._decide(self.loop)
        self._tick += 1

    def _decide(self, loop: LoopEnd) -> None:
        if self._tick % round(CONTROL_DT / LIMITS.dt) == 0 and "control loop" not in self.silent:
            now, seen = self.clock.now(), self.clock.now() - self.image_age
            stamps: Any = {"target_stamp": now, "image_stamp": seen, "box_stamp": seen}
            loop.send(JointTargets(joint_pos_target=self.target, **stamps))
        self.ticks += loop.receive()

    def _send_joints(self, part: RobotPart) -> None:
        names = tuple(theirs.name_in_state for theirs in part.joints.values())
        position, stamp = self.joint_pos[part.ids], self.clock.stamp()
        reading = self.change(messages.JointReading(names=names, position=position, stamp=stamp))
        self.send(part.state_topic, messages.joint_state(reading.names, reading.position, reading.stamp))

    def _move(self) -> None:
        """Move the joints towards the newest commands, which have the order of the driver."""
        for part in self.profile.robots:
            for message in self._commanded[part.name].take():
                command = messages.read_float_array(message.data, part.command_topic.type)
                self.commands[part.name].append(command)
            if self.commands[part.name]:
                places = [theirs.index_in_command for theirs in part.joints.values()]
                goal = self.commands[part.name][-1][places]
                follow = np.minimum(LIMITS.dt / LIMITS.joints.lag[part.ids], 1.0)
                self.joint_pos[part.ids] += follow * (goal - self.joint_pos[part.ids])


def taken(reading: messages.JointReading, places: list[int]) -> messages.JointReading:
    names = tuple(reading.names[place] for place in places)
    return replace(reading, names=names, position=reading.position[places])


class Stage:
    """A servo and a laboratory in memory and in stepped time; `each_tick` runs beside them."""

    def __init__(self, profile: Profile, ends: tuple[LoopEnd, ServoEnd], is_dry_run: bool = False) -> None:
        self.clock, self.broker = StepClock(self._sleep), Broker()
        self.clock.time = 1000.0
        self.loop, end = ends
        setup = ServoSetup(profile=profile, limits=LIMITS, is_dry_run=is_dry_run)
        self.node, self.laboratory = self.broker.node(self.clock), self.broker.node(self.clock)
        self.servo = Servo(end, self.node, setup, self.clock)
        self.lab = WireLab(self.laboratory, self.loop, profile, self.clock)
        self.each_tick: Callable[[], object] = lambda: None

    def _sleep(self, moment: float) -> None:
        self.clock.time = moment
        self.lab.step()
        self.each_tick()

    def wait(self, num_ticks: int) -> int:
        """Step servo and laboratory; return the servo's mode."""
        for _ in range(num_ticks):
            self.servo.tick()
            self.clock.sleep_until(self.clock.time + LIMITS.dt)
        assert self.servo.unforeseen is None
        return self.lab.ticks[-1].mode

    def arm(self, num_ticks: int = 5) -> None:
        self.wait(11)
        self.lab.request_arm()
        assert self.wait(num_ticks) in (Mode.ARMED, Mode.RAMP, Mode.RUN)

    def wait_until_stopped(self, most_ticks: int) -> None:
        while most_ticks and self.wait(1) != Mode.STOPPED:
            most_ticks -= 1

    @property
    def modes(self) -> list[int]:
        return [mode for mode, _ in groupby(command.mode for command in self.lab.ticks)]

    @property
    def stopped_by(self) -> tuple[str, ...]:
        """Return the faults of the first stop."""
        found = next(each.stopped_by for each in self.lab.ticks if each.mode == Mode.STOPPED)
        return tuple(flag_names(Fault, found))
