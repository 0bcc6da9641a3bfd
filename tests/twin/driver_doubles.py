"""Doubles of the drivers, in memory and stepped time, with topics, rates, limits and quirks of their sources.

Topics and names are written here as the sources have them, and not taken from a profile.

Sources:
`UrArms`: ur_robot_driver 2.14 (Humble), 3.8 (Jazzy), 6.0 (Lyrical), Universal_Robots_ROS2_Tutorials.
`AllegroV4`: Wonikrobotics-git/allegro_hand_ros2, January 2026, v4_hardware_interface.cpp, dual_hand.
`AllegroV5`: Wonikrobotics-git/allegro_hand_ros2_v5, November 2024, allegro_node.cpp, allegro_node_grasp.cpp.
`AllegroClassic`: taewookim0812/allegro_hand_linux_v4, allegro_node.cpp, allegro_node_pd.cpp.
`Leap`: leap-hand/LEAP_Hand_API, ros2_module/scripts/leaphand_node.py.
`Fr3`: frankarobotics/franka_ros2, June 2026; libfranka, rate_limiting.h, joint_velocity_limits.h.
`RealSense`: IntelRealSense/realsense-ros 4.55.1, base_realsense_node.cpp, rs_node_setup.cpp, constants.h.
"""

from math import sqrt

import numpy as np

from pixel2catch.ros2 import messages
from pixel2catch.ros2.memory import Broker
from pixel2catch.ros2.transport import Clock, Publisher, Topic
from pixel2catch.scene.constants import RGB_CAMERA

UR_JOINTS = [
    f"{name}_joint" for name in ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")
]
Sides = tuple[str, ...]


class Double:
    """One process of drivers: joint states at a rate, and commands, followed with a lag of 50 ms."""

    rate, state, order_of_state = 500.0, "/joint_states", slice(None, None, -1)
    manager, controllers = "/controller_manager", Sides()  #: Active controllers beside those of commands.
    kind, depth = messages.FLOAT_ARRAY, 50

    def __init__(self, broker: Broker, clock: Clock, distribution: str, sides: Sides = ("",)) -> None:
        """Subscribe to topics, each with commands of the driver's joints in order."""
        self.node, self.clock = broker.node(clock), clock
        topics = {name: joints for side in sides for name, joints in self.commands(side).items()}
        self.names = [name for joints in topics.values() for name in joints]
        self.pos, self.goal = np.zeros(len(self.names)), np.full(len(self.names), np.nan)
        self.num_refused, self._due = 0, 0.0
        self._states = self.publisher(self.state, messages.JOINT_STATE)
        self._takes = [
            (self.node.subscription(Topic(name=name, type=self.kind), self.depth), joints)
            for name, joints in topics.items()
        ]
        if self.kind == messages.FLOAT_ARRAY and distribution != "humble":
            activity = self.publisher(f"{self.manager}/activity", messages.ACTIVITY, is_latched=True)
            active = ("joint_state_broadcaster", *(name.split("/")[1] for name in topics))
            activity.publish(messages.activity(dict.fromkeys(active, messages.ACTIVE), 0.0))

    def commands(self, side: str) -> dict[str, list[str]]:
        """The joints of a command by its topic."""
        raise NotImplementedError

    def publisher(self, name: str, kind: str, *, is_latched: bool = False) -> Publisher:
        return self.node.publisher(Topic(name=name, type=kind, is_latched=is_latched))

    def step(self) -> None:
        if self.clock.now() < self._due - 1e-9:
            return
        self._due = max(self._due, self.clock.now() - 1e-9) + 1.0 / self.rate
        for subscription, joints in self._takes:
            for message in subscription.take()[-1:]:  # a cycle has one command: the newest
                places = [self.names.index(joint) for joint in joints]
                given = messages.read_float_array(message.data, self.kind)
                is_taken = len(given) == len(places) and self.accepts(given, places)
                self.goal[places] = given if is_taken else self.goal[places]
                self.num_refused += not is_taken
        self.pos += np.nan_to_num((self.goal - self.pos) * min(1.0 / (0.05 * self.rate), 1.0))
        names, measured = self.names[self.order_of_state], self.measured()[self.order_of_state]
        self._states.publish(messages.joint_state(names, measured, self.clock.stamp()))

    def accepts(self, given: np.ndarray, places: list[int]) -> bool:
        return bool(np.isfinite(given).all())

    def measured(self) -> np.ndarray:
        return self.pos


class UrArms(Double):
    """Arms under one controller manager: 500 Hz; the program ignores steps above 0.04 rad."""

    def __init__(self, broker: Broker, clock: Clock, distribution: str, sides: Sides = ("",)) -> None:
        super().__init__(broker, clock, distribution, sides)
        self._scaling = []
        for side in sides:
            io = f"/{side}io_and_status_controller"
            for name, kind, data in (
                ("safety_mode", messages.SAFETY_MODE, messages.safety_mode(1)),
                ("robot_mode", messages.ROBOT_MODE, messages.robot_mode(7)),
                ("robot_program_running", messages.BOOLEAN, messages.boolean(True)),
            ):
                self.publisher(f"{io}/{name}", kind, is_latched=True).publish(data)
            topic = f"/{side}speed_scaling_state_broadcaster/speed_scaling"
            self._scaling.append(self.publisher(topic, messages.NUMBER))

    def commands(self, side: str) -> dict[str, list[str]]:
        return {f"/{side}forward_position_controller/commands": [f"{side}{joint}" for joint in UR_JOINTS]}

    def step(self) -> None:
        for publisher in self._scaling:
            publisher.publish(messages.number(100.0))
        super().step()

    def accepts(self, given: np.ndarray, places: list[int]) -> bool:
        last = np.where(np.isnan(self.goal), self.pos, self.goal)[places]
        return bool((np.abs(given - last) <= 0.04).all())


class AllegroV4(Double):
    """Hands under one controller manager in a namespace: 100 Hz, thumb first; they move at activation."""

    rate, manager = 100.0, "/allegro_hand/controller_manager"

    def __init__(self, broker: Broker, clock: Clock, distribution: str, sides: Sides = ("",)) -> None:
        super().__init__(broker, clock, distribution, tuple(side[:1] for side in sides))
        self.goal[:] = 0.0  # initial_positions, by on_activate

    def commands(self, side: str) -> dict[str, list[str]]:
        joints = [f"ah{side}_joint{finger}{joint}" for finger in range(4) for joint in range(4)]
        return {f"/allegro_hand_position_controller{side and f'_{side}'}/commands": joints}


class AllegroV5(Double):
    """333 Hz, index finger first; base node and derived node both subscribe; limp until the first command."""

    rate, state, order_of_state = 1e3 / 3.0, "/allegroHand_0/joint_states", slice(None)
    kind = messages.JOINT_STATE
    command, separator = "/allegroHand/joint_cmd", "_"

    def __init__(self, broker: Broker, clock: Clock, distribution: str, sides: Sides = ("",)) -> None:
        super().__init__(broker, clock, distribution, sides)
        self.node.subscription(Topic(name=self.command, type=self.kind), 3)

    def commands(self, side: str) -> dict[str, list[str]]:
        return {self.command: [f"joint_{number}{self.separator}0" for number in range(16)]}


class AllegroClassic(AllegroV5):
    """Other names; positions pass a filter whose factors add up to 0.996: they are 1 % low."""

    command, separator = "/allegroHand_0/joint_cmd", "."
    _filtered = _before = 0.0

    def measured(self) -> np.ndarray:
        self._filtered = 0.6 * self._filtered + 0.198 * (self._before + self.pos)
        self._before = self.pos.copy()
        return self._filtered


class Leap(Double):
    """The node takes commands only; a node of the laboratory publishes the positions, 80 times a second."""

    rate, state, order_of_state, kind = 80.0, "/leap_hand/joint_states", slice(None), messages.JOINT_STATE

    def commands(self, side: str) -> dict[str, list[str]]:
        return {"/cmd_allegro": [str(number) for number in range(16)]}


class Fr3(Double):
    """1 kHz; a command beyond a limit of the interface, or a missing one, ends the motion by a reflex."""

    rate, state, order_of_state = 1000.0, "/franka/joint_states", slice(None)
    #: Fastest speed [rad/s]; near the ends: offset [rad/s], slope [rad/s²]; ends of the travel [rad].
    LIMITS = (
        (2.62, 0.30, 12.0, -2.7501, 2.7501),
        (2.62, 0.20, 5.17, -1.7918, 1.7918),
        (2.62, 0.20, 7.00, -2.9065, 2.9065),
        (2.62, 0.30, 8.00, -3.0481, -0.1458),
        (5.26, 0.35, 34.0, -2.8101, 2.8101),
        (4.18, 0.35, 11.0, 0.54092, 4.5205),
        (5.26, 0.35, 34.0, -3.0196, 3.0196),
    )
    _last = (np.zeros(7),) * 3  #: Position, speed and acceleration of the last command.
    reached = np.zeros(3)  #: Largest speed, acceleration and jerk, in their limits.

    def commands(self, side: str) -> dict[str, list[str]]:
        return {"/forward_position_controller/commands": [f"fr3_joint{number}" for number in range(1, 8)]}

    def accepts(self, given: np.ndarray, places: list[int]) -> bool:
        speed = (given - (given if np.isnan(self.goal).any() else self._last[0])) * 1e3
        acceleration = (speed - self._last[1]) * 1e3
        jerk = (acceleration - self._last[2]) * 1e3
        most = [
            max(min(fastest, sqrt(slope * max(end - pos if v > 0.0 else pos - begin, 0.0)) - offset), 1e-9)
            for v, pos, (fastest, offset, slope, begin, end) in zip(speed, given, self.LIMITS, strict=True)
        ]
        shares = [np.abs(speed) / most, np.abs(acceleration) / 10.0, np.abs(jerk) / 5000.0]
        self.reached = np.maximum(self.reached, [share.max() for share in shares])
        self._last = (given, speed, acceleration)
        return bool((self.reached <= 1.0 + 1e-6).all())


class RealSense:
    """The colour stream: rgb8 at 30 Hz, reliable and volatile; image, then lens, with one stamp.

    Each topic is sent only to subscribers.
    """

    period, age = 1.0 / 30.0, 0.008  #: Time between images, and their age by their stamps [s].

    def __init__(self, broker: Broker, clock: Clock) -> None:
        node, self.clock = broker.node(clock), clock
        self._image, self._info = (
            node.publisher(Topic(name=f"/camera/camera/color/{name}", type=kind))
            for name, kind in (("image_raw", messages.IMAGE), ("camera_info", messages.CAMERA_INFO))
        )
        self._due = clock.now()
        self._rng, self._shape = np.random.default_rng(0), (RGB_CAMERA.height, RGB_CAMERA.width, 3)

    def step(self) -> None:
        if self.clock.now() < self._due - 1e-9:
            return
        self._due, stamp = self._due + self.period, self.clock.stamp() - self.age
        if self._image.num_subscribers():
            pixels = np.full(self._shape, self._rng.integers(256), dtype=np.uint8)
            self._image.publish(messages.image(pixels, stamp))
        if self._info.num_subscribers():
            self._info.publish(messages.camera_info(RGB_CAMERA, stamp))
