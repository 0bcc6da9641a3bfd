"""The lab on the wire: topics of a robot profile, at the rates of the drivers."""

import json
from collections import deque
from dataclasses import replace
from typing import Any, final

import numpy as np
from jaxtyping import Float, Int

from pixel2catch.errors import DeploymentError
from pixel2catch.robots.workcell import WorkcellSpec
from pixel2catch.ros2 import messages
from pixel2catch.ros2.profile import DriverJoint, Profile, RobotPart
from pixel2catch.ros2.transport import Topic, Transport
from pixel2catch.twin.drivers import CYCLE, ArmDriver, ArmDrivers, Camera, Driver, HandDriver, Motion
from pixel2catch.twin.simulated_lab import Phase, SimulatedLab

COMMAND = Topic(name="/twin/command", type=messages.TEXT)  #: What the operator asks the twin for.

REQUESTS = '{"do": "prepare", "seed": 7}, {"do": "throw"}, {"do": "protective_stop"}, {"do": "resume"}'
"""What can be asked for; a protective stop is as after a collision, and `resume` ends every halt."""

STATE = Topic(name="/twin/state", type=messages.TEXT)  #: What is true in the twin, 30 times a second.
DEPTH = 64  #: Commands that wait while the twin is late.
ROUNDING = 1e-9  #: Difference of two times that is none [s].

Joints = Float[np.ndarray, " num_joints"]

PROFILE = "ur5e_allegro_v4"
"""Robot profile that the twin speaks, and whose drivers are the pattern of those of other robots."""

STATUS_CYCLES = 5  #: Cycles between two messages of the speed scaling: 100 Hz. Source: ours.


def twin_profile(workcell: WorkcellSpec) -> Profile:
    """The profile that the twin of a work cell speaks.

    Where joints are called otherwise than in `PROFILE`, each joint group has a driver like the one of its
    role there, with the spec's names and order.
    """
    profile = Profile.load(PROFILE)
    theirs = {joint for part in profile.robots for joint in part.joints}
    if theirs == {joint.name for joint in workcell.joints}:
        return replace(profile, workcell=workcell.name)
    likes = {part.name: part for part in profile.robots}
    parts = [
        replace(
            likes[group.role],
            name=group.name,
            joints={
                joint.name: DriverJoint(name_in_state=joint.name, index_in_command=place)
                for place, joint in enumerate(group.joints)
            },
            command_topic=Topic(name=f"/{group.name}_controller/commands", type=messages.FLOAT_ARRAY),
            command_size=len(group.joints),
            held={},
        )
        for group in workcell.groups
    ]
    name = f"twin_of_{workcell.name}"
    return replace(profile, name=name, workcell=workcell.name, robots=tuple(parts))


class PartTopics:
    """Joint states and commands of one part."""

    def __init__(self, part: RobotPart, driver: Driver, transport: Transport) -> None:
        """Announce and listen."""
        self._part, self.driver = part, driver
        self.ids: Int[np.ndarray, " part_joints"] = part.ids  #: Its joints, in the robot's joint order.
        self._states = transport.publisher(part.state_topic)
        self._commands = transport.subscription(part.command_topic, DEPTH)
        self._waiting: deque[bytes] = deque(maxlen=DEPTH)
        self._places = [theirs.index_in_command for theirs in part.joints.values()]
        self._cycles = max(round(1.0 / (part.rate_hz * CYCLE)), 1)
        names = [theirs.name_in_state for theirs in part.joints.values()]
        held = {joint.name_in_state: joint.angle for joint in part.held.values() if joint.name_in_state}
        self._order = np.argsort([*names, *held])  # a state's order is not a command's
        self._names = [[*names, *held][i] for i in self._order]
        self._held = np.array([*held.values()])
        self.num_refused = 0  #: Commands of a wrong length or type.

    def publish(self, number: int, encoders: Motion, stamp: float) -> None:
        """Send the joint states of a cycle, at the rate of the driver."""
        if number % self._cycles:
            return
        position = np.concatenate((encoders.position[self.ids], self._held))[self._order]
        velocity = np.concatenate((encoders.velocity[self.ids], np.zeros(len(self._held))))[self._order]
        self._states.publish(messages.joint_state(self._names, position, stamp, velocity))

    def cycle(self, joints: Motion, num_late: int) -> Float[np.ndarray, " part_joints"]:
        """What the servos of this part aim at until the next cycle [rad].

        So many cycles are overdue besides this one; as many commands are left to them.
        """
        self._waiting.extend(message.data for message in self._commands.take())
        newest = None
        while len(self._waiting) > num_late:
            newest = self._waiting.popleft()
        own = Motion(position=joints.position[self.ids], velocity=joints.velocity[self.ids])
        return self.driver.cycle(None if newest is None else self._read(newest), own)

    def _read(self, data: bytes) -> Float[np.ndarray, " part_joints"] | None:
        """The targets in a command; none if it is not one."""
        try:
            values = messages.read_float_array(data)
        except DeploymentError:
            values = np.empty(0)
        if len(values) != self._part.command_size:
            self.num_refused += 1
            return None
        return values[self._places]


class StatusPublisher:
    """What the drivers say of themselves; latched topics are sent when they change."""

    def __init__(self, profile: Profile, transport: Transport) -> None:
        """Announce those topics that the profile has, with all of its controllers active."""
        topics = vars(profile.status)
        self._publishers = {name: transport.publisher(topic) for name, topic in topics.items() if topic}
        controllers = [part.controller for part in profile.robots if part.controller]
        for topic in {each.activity for each in controllers}:
            active = {each.name: messages.ACTIVE for each in controllers if each.activity == topic}
            transport.publisher(topic).publish(messages.activity(active, 0.0))
        self._last: tuple[int, bool] | None = None

    def publish(self, number: int, arms: ArmDrivers) -> None:
        """Send the status of a cycle."""
        if number % STATUS_CYCLES == 0:
            self._send("speed_scaling", messages.number(100.0 if arms.is_running else 0.0))
        status = (arms.safety_mode, arms.is_running)
        if status != self._last:
            self._send("safety_mode", messages.safety_mode(arms.safety_mode))
            self._send("robot_mode", messages.robot_mode(messages.RUNNING_ROBOT_MODE))
            self._send("program_running", messages.boolean(arms.is_running))
        self._last = status

    def _send(self, name: str, data: bytes) -> None:
        """Send, if the profile has the topic."""
        if name in self._publishers:
            self._publishers[name].publish(data)


@final
class LabNode:
    """The whole lab, one cycle of its drivers after the other; nothing here waits."""

    def __init__(self, lab: SimulatedLab, profile: Profile, transport: Transport, camera: Camera) -> None:
        """Announce and listen.

        Raises:
            DeploymentError: The profile is not of this lab's drivers.
        """
        self.lab, self.camera, self._lens = lab, camera, lab.camera
        roles: dict[str, str] = {group.name: group.role for group in lab.workcell.groups}
        if any(part.command_topic.type != messages.FLOAT_ARRAY for part in profile.robots):
            raise DeploymentError(
                f"profile '{profile.name}' has commands of another type than {messages.FLOAT_ARRAY}, and the "
                f"twin takes no other: use its own profile, {PROFILE}."
            )
        position = lab.joints.position
        drivers = [
            ArmDriver(position[part.ids], lab.lag[part.ids])
            if roles[part.name] == "arm"
            else HandDriver(position[part.ids])
            for part in profile.robots
        ]
        self.arms = ArmDrivers(driver for driver in drivers if isinstance(driver, ArmDriver))
        self._parts = [
            PartTopics(part, driver, transport) for part, driver in zip(profile.robots, drivers, strict=True)
        ]
        self._status = StatusPublisher(profile, transport)
        self._image = transport.publisher(profile.camera.image)
        self._info = transport.publisher(profile.camera.info) if profile.camera.info else None
        self._requests = transport.subscription(COMMAND, DEPTH)
        self._state = transport.publisher(STATE)
        self._num_joints = len(position)
        self._refused = ""
        self.num_cycles = 0

    @property
    def time(self) -> float:
        """When the next cycle begins [s]."""
        return self.num_cycles * CYCLE

    def cycle(self, start: float, num_late: int = 0) -> None:
        """Publish, take commands, and simulate until the next cycle; so many are overdue besides this one.

        The start is the stamp of the beginning of the twin's time [s].
        """
        encoders = self.lab.encoders(self.time)
        for part in self._parts:
            part.publish(self.num_cycles, encoders, start + self.time)
        self._status.publish(self.num_cycles, self.arms)
        for image in self.camera.developed(self.time):
            self._image.publish(messages.image(image.pixels, start + image.stamp))
            if self._info:
                self._info.publish(messages.camera_info(self._lens, start + image.stamp))
        for message in self._requests.take():
            self._heed(message.data)
        joints, aim = self.lab.joints, np.empty(self._num_joints)
        for part in self._parts:
            aim[part.ids] = part.cycle(joints, num_late)
        self._simulate(aim)
        self.num_cycles += 1

    def _simulate(self, aim: Joints) -> None:
        """Simulate the physics steps that end in this cycle, with servos that aim here [rad]."""
        end = self.time + CYCLE
        while self.lab.time + self.lab.physics_dt <= end + ROUNDING:
            if self.lab.step(aim):
                self.camera.expose(self.lab.exposure())
                self._state.publish(messages.text(json.dumps(self.state())))

    def state(self) -> dict[str, Any]:
        """What is true of robot and throw, and what the operator asked for in vain."""
        return {
            **self.lab.truth(),
            "outcome": self.lab.outcome,
            "halted": not self.arms.is_running,
            "safety_mode": self.arms.safety_mode,
            "halts": sum(arm.num_halts for arm in self.arms),
            "ignored": sum(part.driver.num_ignored + part.num_refused for part in self._parts),
            "late_images": self.camera.num_late,
            "lost_images": self.camera.num_lost,
            "refused": self._refused,
        }

    def summary(self) -> str:
        """What changes when something happens, in a line."""
        lab, arms = self.lab, self.arms
        robot = "program runs" if arms.is_running else f"program halted, safety mode {arms.safety_mode}"
        thrown = "the room is empty" if lab.phase is Phase.EMPTY else f"{lab.object_name} {lab.outcome}"
        refused = f", refused: {self._refused}" if self._refused else ""
        return f"throw {lab.num_throws}: {thrown}; {robot}{refused}"

    def _heed(self, data: bytes) -> None:
        """Do what the operator asks for, or remember why not."""
        try:
            match messages.read_json(data):
                case {"do": "prepare", "seed": int(seed)} if 0 <= seed < 2**63:
                    self.lab.prepare(seed)
                    self._hold()
                case {"do": "throw"}:
                    self.lab.throw()
                case {"do": "protective_stop"}:
                    self.arms.protective_stop()
                case {"do": "resume"}:
                    self._hold()
                case other:
                    raise DeploymentError(f"{other} is none of {REQUESTS}")
            self._refused = ""
        except DeploymentError as error:
            self._refused = str(error)

    def _hold(self) -> None:
        """Let the drivers hold the robot where it is, and the program run again."""
        position = self.lab.joints.position
        for part in self._parts:
            part.driver.reset(position[part.ids])
