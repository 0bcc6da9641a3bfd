"""The simulated laboratory on the topics of a robot profile; `serve` runs it in real time on DDS."""

import gc
import json
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from contextlib import closing, contextmanager, suppress
from dataclasses import replace
from multiprocessing import get_context
from typing import Any, final

import numpy as np
import torch
from jaxtyping import Float, Int

from pixel2catch.camera.image import Pixels
from pixel2catch.envs.cfg import CatchEnvCfg
from pixel2catch.errors import DeploymentError
from pixel2catch.interruption import end_with_parent, without_interrupts
from pixel2catch.rendering.camera import Exposure, RoomCamera
from pixel2catch.rendering.renderer import find_gl_backend
from pixel2catch.robots.workcell import WorkcellSpec
from pixel2catch.ros2 import messages
from pixel2catch.ros2.profile import PROFILES, DriverJoint, Profile, RobotPart
from pixel2catch.ros2.transport import LOOPBACK, RealClock, Topic, Transport, make_transport
from pixel2catch.scene.scene import SceneCfg
from pixel2catch.servo.link import set_niceness
from pixel2catch.twin.drivers import CYCLE, ArmDriver, CameraDriver, Driver, HandDriver
from pixel2catch.twin.simulated_lab import JointState, Phase, SimulatedLab
from pixel2catch.workcells import find_workcell

COMMAND = Topic(name="/twin/command", type=messages.TEXT)  #: Requests of the operator.

REQUESTS = '{"do": NAME}: prepare or next with a "seed", throw, protective_stop, resume'
"""Valid requests. `prepare` puts the robot into its start pose, `next` leaves it where it is. A protective
stop is as after a collision, and `resume` ends every halt."""

STATE = Topic(name="/twin/state", type=messages.TEXT)  #: True state of robot and throw, 30 times a second.
DEPTH = 64  #: Length of the queue of commands while the twin is late.
ROUNDING = 1e-9  #: Times that differ by less are equal [s].

PROFILE = "ur5e_allegro_v4"  #: Robot profile of the twin; drivers of other robots are like its drivers.
STATUS_CYCLES = 5  #: Cycles between two messages of the speed scaling: 100 Hz. Source: ours.
FIRST, SECOND = -10, -5  #: Niceness of the physics with its topics, and of the camera. Source: ours.
LATE = 0.01  #: Lateness from which a cycle counts as late [s]. Source: ours, half the servo's `position_age`.


def twin_profile(workcell: WorkcellSpec) -> Profile:
    """Return the profile of the twin of a work cell: `PROFILE` if the joints have its names, else its own.

    If none is shipped, each joint group has a driver like that of its role in `PROFILE`, with the names and
    the order of the work cell.
    """
    profile = Profile.load(PROFILE)
    names = {joint for part in profile.robots for joint in part.joints}
    if names == {joint.name for joint in workcell.joints}:
        return replace(profile, workcell=workcell.name)
    if (PROFILES / f"{workcell.name}.yaml").exists():
        return Profile.load(workcell.name)
    by_role, parts = {part.name: part for part in profile.robots}, list[RobotPart]()
    for group in workcell.groups:
        places = {joint.name: place for place, joint in enumerate(group.joints)}
        joints = {n: DriverJoint(name_in_state=n, index_in_command=place) for n, place in places.items()}
        topic = Topic(name=f"/{group.name}_controller/commands", type=messages.FLOAT_ARRAY)
        own = {"name": group.name, "joints": joints, "command_topic": topic, "command_size": len(joints)}
        parts.append(replace(by_role[group.role], **own, held={}))
    name = f"twin_of_{workcell.name}"
    return replace(profile, name=name, workcell=workcell.name, robots=tuple(parts), places={})


class PartTopics:
    """Joint states and commands of one part of the robot."""

    def __init__(self, part: RobotPart, driver: Driver, transport: Transport) -> None:
        self._part, self.driver = part, driver
        self.ids: Int[np.ndarray, " part_joints"] = part.ids  #: Its joints, in the robot's joint order.
        self._states = transport.publisher(part.state_topic)
        self._commands = transport.subscription(part.command_topic, DEPTH)
        self._waiting: deque[bytes] = deque(maxlen=DEPTH)
        self._places = [joint.index_in_command for joint in part.joints.values()]
        self._cycles = max(round(1.0 / (part.rate_hz * CYCLE)), 1)
        held = {joint.name_in_state: joint.angle for joint in part.held.values() if joint.name_in_state}
        names = [*(joint.name_in_state for joint in part.joints.values()), *held]
        self._order = np.argsort(names)  # a state's order is not a command's
        self._names, self._held = [names[i] for i in self._order], np.array([*held.values()])

    def publish(self, number: int, encoders: JointState, stamp: float) -> None:
        """Publish the joint states of a cycle, at the rate of the driver."""
        if number % self._cycles == 0:
            position = np.concatenate((encoders.position[self.ids], self._held))[self._order]
            velocity = np.concatenate((encoders.velocity[self.ids], 0.0 * self._held))[self._order]
            self._states.publish(messages.joint_state(self._names, position, stamp, velocity))

    def cycle(self, joints: JointState, num_late: int) -> Float[np.ndarray, " part_joints"]:
        """Return the servo targets until the next cycle [rad]; leave a command for each overdue cycle."""
        self._waiting.extend(message.data for message in self._commands.take())
        newest = None
        while len(self._waiting) > num_late:
            newest = self._waiting.popleft()
        own = JointState(position=joints.position[self.ids], velocity=joints.velocity[self.ids])
        return self.driver.cycle(None if newest is None else self._read(newest), own)

    def _read(self, data: bytes) -> Float[np.ndarray, " part_joints"] | None:
        with suppress(DeploymentError):
            values = messages.read_float_array(data, self._part.command_topic.type)
            if len(values) == self._part.command_size:
                return values[self._places]
        self.driver.num_ignored += 1
        return None


class StatusPublisher:
    """Publishes the status of the drivers; latched topics when they change."""

    def __init__(self, profile: Profile, transport: Transport) -> None:
        topics = [each for status in profile.all_status for each in status.items()]
        self._publishers = [(name, transport.publisher(topic)) for name, topic in topics]
        controllers = [part.controller for part in profile.robots if part.controller]
        for topic in {each.activity for each in controllers}:
            active = {each.name: messages.ACTIVE for each in controllers if each.activity == topic}
            transport.publisher(topic).publish(messages.activity(active, 0.0))
        self._last: tuple[int, bool] | None = None

    def publish(self, number: int, safety_mode: int, is_running: bool) -> None:
        status = {"speed_scaling": messages.number(100.0 * is_running)} if number % STATUS_CYCLES == 0 else {}
        if (safety_mode, is_running) != self._last:
            status["safety_mode"] = messages.safety_mode(safety_mode)
            status["robot_mode"] = messages.robot_mode(messages.RUNNING_ROBOT_MODE)
            status["program_running"] = messages.boolean(is_running)
        for name, publisher in self._publishers:
            if name in status:
                publisher.publish(status[name])
        self._last = (safety_mode, is_running)


@final
class LabNode:
    """The laboratory as a node, one cycle of its drivers after the other, without waiting."""

    def __init__(
        self, lab: SimulatedLab, profile: Profile, transport: Transport, camera: CameraDriver
    ) -> None:
        self.lab, self.camera = lab, camera
        roles: dict[str, str] = {group.name: group.role for group in lab.workcell.groups}
        #: Drivers of all arms, which stop together, as behind one safety circuit.
        self.arms: list[ArmDriver] = []
        self._parts: list[PartTopics] = []
        for part in profile.robots:
            driver: Driver = HandDriver(lab.joints.position[part.ids])
            if roles[part.name] == "arm":
                driver = ArmDriver(lab.joints.position[part.ids], lab.lag[part.ids])
                self.arms.append(driver)
            self._parts.append(PartTopics(part, driver, transport))
        self._status = StatusPublisher(profile, transport)
        self._image, self._state = transport.publisher(profile.camera.image), transport.publisher(STATE)
        self._info = transport.publisher(profile.camera.info) if profile.camera.info else None
        self._requests = transport.subscription(COMMAND, DEPTH)
        self._refused, self.num_cycles = "", 0

    @property
    def time(self) -> float:
        """Start of the next cycle [s]."""
        return self.num_cycles * CYCLE

    @property
    def _is_running(self) -> bool:
        return all(arm.is_running for arm in self.arms)

    def cycle(self, start: float, num_late: int = 0) -> None:
        """Publish with stamps from a start [s] and simulate a cycle; `num_late` further ones are overdue."""
        encoders = self.lab.encoders(self.time)
        for part in self._parts:
            part.publish(self.num_cycles, encoders, start + self.time)
        self._status.publish(self.num_cycles, self.arms[0].safety_mode, self._is_running)
        for image in self.camera.take(self.time):
            self._image.publish(messages.image(image.pixels, start + image.stamp))
            if self._info:
                self._info.publish(messages.camera_info(self.lab.camera, start + image.stamp))
        for message in self._requests.take():
            self._handle(message.data)
        joints = self.lab.joints
        targets = np.empty_like(joints.position)
        for part in self._parts:
            targets[part.ids] = part.cycle(joints, num_late)
        end = self.time + CYCLE
        while self.lab.time + self.lab.physics_dt <= end + ROUNDING:
            if self.lab.step(targets):
                self.camera.expose(self.lab.exposure())
                self._state.publish(messages.text(json.dumps(self.state())))
        self.num_cycles += 1

    def state(self) -> dict[str, Any]:
        """Return the true state of robot and throw, and why the last request was refused."""
        return {
            **self.lab.truth(),
            "outcome": self.lab.outcome,
            "summary": self.summary(),
            "halted": not self._is_running,
            "safety_mode": self.arms[0].safety_mode,
            "halts": sum(arm.num_halts for arm in self.arms),
            "ignored": sum(part.driver.num_ignored for part in self._parts),
            "late_images": self.camera.num_late,
            "lost_images": self.camera.num_lost,
            "refused": self._refused,
        }

    def summary(self) -> str:
        """Return one line that changes with every event."""
        lab, halted = self.lab, f"program halted, safety mode {self.arms[0].safety_mode}"
        thrown = "the room is empty" if lab.phase is Phase.EMPTY else f"{lab.object_name} {lab.outcome}"
        refused = f", refused: {self._refused}" if self._refused else ""
        return f"throw {lab.num_throws}: {thrown}; {'program runs' if self._is_running else halted}{refused}"

    def _handle(self, data: bytes) -> None:
        try:
            match messages.read_json(data):
                case {"do": "prepare" | "next" as action, "seed": int(seed)} if 0 <= seed < 2**63:
                    self.lab.prepare(seed, keeps_robot=action == "next")
                    if action == "prepare":
                        self._hold_still()
                case {"do": "throw"}:
                    self.lab.throw()
                case {"do": "protective_stop"}:
                    for arm in self.arms:
                        arm.protective_stop()
                case {"do": "resume"}:
                    self._hold_still()
                case other:
                    raise DeploymentError(f"{other} is no request; valid: {REQUESTS}")
            self._refused = ""
        except DeploymentError as error:
            self._refused = str(error)

    def _hold_still(self) -> None:
        position = self.lab.joints.position
        for part in self._parts:
            part.driver.reset(position[part.ids])


_CAMERAS: list[RoomCamera] = []  #: The camera of a drawing process.


@contextmanager
def drawing_process(scene: SceneCfg, seed: int) -> Iterator[Callable[[Exposure], "Future[Pixels]"]]:
    """Yield a function that begins to draw an image of a room, by its seed, in another process."""
    find_gl_backend()
    with ProcessPoolExecutor(1, get_context("spawn"), _open_camera, (scene, seed)) as process:
        with without_interrupts():
            process.submit(bool).result()  # the camera is open
        yield lambda exposure: process.submit(_draw, exposure)


def _open_camera(scene: SceneCfg, seed: int) -> None:
    set_niceness(SECOND)
    end_with_parent()
    torch.set_num_threads(1)
    _CAMERAS.append(RoomCamera(scene, seed))


def _draw(exposure: Exposure) -> Pixels:
    return _CAMERAS[0].image(exposure)


def serve(task: CatchEnvCfg, seed: int, rate: float, on_cycle: Callable[[LabNode], bool]) -> str:
    """Run the laboratory of a task on this machine's DDS network until `on_cycle` returns false.

    Late cycles are made up for. The seed is of room and noise; the rate is that of the clock, at most 1.
    Returns a sentence about the cycles that began more than `LATE` after their time.
    """
    clock, num_late, worst, is_over = RealClock(rate), 0, 0.0, False
    profile = twin_profile(find_workcell(task.scene.workcell))
    set_niceness(FIRST)
    with (
        drawing_process(task.scene, seed) as draw,
        make_transport("pixel2catch_twin", LOOPBACK, clock) as transport,
        closing(SimulatedLab(task, seed)) as lab,
    ):
        node = LabNode(lab, profile, transport, CameraDriver(draw))
        gc.collect()
        gc.freeze()  # objects that exist now are not collected later
        begin, start = clock.now(), clock.stamp()
        while not is_over:
            clock.sleep_until(begin + node.time)
            lateness = clock.now() - begin - node.time
            node.cycle(start, int(lateness / CYCLE))
            num_late, worst = num_late + (lateness > LATE), max(worst, lateness)
            is_over = not on_cycle(node)
    return f"{node.num_cycles:,} cycles, {num_late:,} of them late, the worst by {1000 * worst:.0f} ms"
