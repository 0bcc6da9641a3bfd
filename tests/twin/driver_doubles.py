"""Doubles of the drivers, in memory and stepped time, with topics, rates, limits and quirks of their sources.

Topics and names are written here as the sources have them, and not taken from a profile.

Sources:
`UrArms`: ur_robot_driver 2.14 (Humble), 3.8 (Jazzy), 6.0 (Lyrical), Universal_Robots_ROS2_Tutorials.
`AllegroV4`: Wonikrobotics-git/allegro_hand_ros2, January 2026, v4_hardware_interface.cpp, dual_hand.
`AllegroV5`: Wonikrobotics-git/allegro_hand_ros2_v5, November 2024, allegro_node.cpp, allegro_node_grasp.cpp.
`AllegroClassic`: taewookim0812/allegro_hand_linux_v4, allegro_node.cpp, allegro_node_pd.cpp.
`Leap`: leap-hand/LEAP_Hand_API, ros2_module/scripts/leaphand_node.py.
`Fr3`: frankarobotics/franka_ros2, June 2026; libfranka, rate_limiting.h, joint_velocity_limits.h.
"""

from collections.abc import Sequence
from math import sqrt

import numpy as np

from pixel2catch.ros2 import messages
from pixel2catch.ros2.memory import Broker
from pixel2catch.ros2.transport import Clock, Publisher, Topic

UR_JOINTS = [
    f"{name}_joint" for name in ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")
]


class Double:
    """One process of drivers: joint states at a rate, and commands, followed with a lag of 50 ms."""

    rate, state, order_of_state = 500.0, "/joint_states", slice(None, None, -1)

    def __init__(self, broker: Broker, clock: Clock, commands: dict[str, list[str]], kind: str) -> None:
        """Subscribe to topics, each with commands of the driver's joints in order."""
        self.node, self.clock = broker.node(clock), clock
        self.names = [name for joints in commands.values() for name in joints]
        self.pos, self.goal = np.zeros(len(self.names)), np.full(len(self.names), np.nan)
        self.num_commands = self.num_refused = 0
        self._states = self.node.publisher(Topic(name=self.state, type=messages.JOINT_STATE))
        self._kind, self._due, self._first = kind, 0.0, True
        self._takes = [
            (
                self.node.subscription(Topic(name=name, type=kind), 50),
                [self.names.index(each) for each in joints],
            )
            for name, joints in commands.items()
        ]

    def latched(self, name: str, kind: str, data: bytes) -> Publisher:
        publisher = self.node.publisher(Topic(name=name, type=kind, is_latched=True))
        publisher.publish(data)
        return publisher

    def announce(self, manager: str, active: Sequence[str]) -> None:
        """Publish the active controllers of a controller manager."""
        states = messages.activity(dict.fromkeys(active, messages.ACTIVE), 0.0)
        self._activity = self.latched(f"{manager}/activity", messages.ACTIVITY, states)

    def set_activity(self, active: Sequence[str]) -> None:
        self._activity.publish(messages.activity(dict.fromkeys(active, messages.ACTIVE), 0.0))

    def step(self) -> None:
        """Run a cycle, if one is due."""
        if self.clock.now() < self._due - 1e-9:
            return
        self._due = max(self._due, self.clock.now() - 1e-9) + 1.0 / self.rate
        for subscription, places in self._takes:
            for message in subscription.take()[-1:]:  # a cycle has one command: the newest
                is_array = self._kind == messages.FLOAT_ARRAY
                values = messages.decode(message.data, self._kind)
                given = np.array(values.data if is_array else values.position)
                self.num_commands += 1
                if len(given) == len(places) and self.accepts(given, places):
                    self.goal[places] = given
                else:
                    self.num_refused += 1
        self.pos += np.nan_to_num((self.goal - self.pos) * min(1.0 / (0.05 * self.rate), 1.0))
        names, measured = self.names[self.order_of_state], self.measured()[self.order_of_state]
        self._states.publish(messages.joint_state(names, measured, self.clock.stamp()))

    def accepts(self, given: np.ndarray, places: list[int]) -> bool:
        return bool(np.isfinite(given).all())

    def measured(self) -> np.ndarray:
        return self.pos


class UrArms(Double):
    """Arms under one controller manager: 500 Hz; the program ignores steps above 0.04 rad."""

    def __init__(
        self, broker: Broker, clock: Clock, distribution: str, prefixes: Sequence[str] = ("",)
    ) -> None:
        topics = {
            f"/{prefix}forward_position_controller/commands": [f"{prefix}{joint}" for joint in UR_JOINTS]
            for prefix in prefixes
        }
        super().__init__(broker, clock, topics, messages.FLOAT_ARRAY)
        self._scaling = []
        for prefix in prefixes:
            status = f"/{prefix}io_and_status_controller"
            self.latched(f"{status}/safety_mode", messages.SAFETY_MODE, messages.safety_mode(1))
            self.latched(f"{status}/robot_mode", messages.ROBOT_MODE, messages.robot_mode(7))
            self.latched(f"{status}/robot_program_running", messages.BOOLEAN, messages.boolean(True))
            topic = f"/{prefix}speed_scaling_state_broadcaster/speed_scaling"
            self._scaling.append(self.node.publisher(Topic(name=topic, type=messages.NUMBER)))
        if distribution != "humble":
            controllers = [topic.split("/")[1] for topic in topics]
            self.announce("/controller_manager", ["joint_state_broadcaster", *controllers])

    def step(self) -> None:
        for publisher in self._scaling:
            publisher.publish(messages.number(100.0))
        super().step()

    def accepts(self, given: np.ndarray, places: list[int]) -> bool:
        last = np.where(np.isnan(self.goal), self.pos, self.goal)[places]
        return bool((np.abs(given - last) <= 0.04).all())


class AllegroV4(Double):
    """Hands under one controller manager in a namespace: 100 Hz, thumb first; they move at activation."""

    rate = 100.0

    def __init__(self, broker: Broker, clock: Clock, distribution: str, hands: Sequence[str] = ("",)) -> None:
        topics = {
            f"/allegro_hand_position_controller{hand and f'_{hand}'}/commands": [
                f"ah{hand}_joint{finger}{joint}" for finger in range(4) for joint in range(4)
            ]
            for hand in hands
        }
        super().__init__(broker, clock, topics, messages.FLOAT_ARRAY)
        self.goal[:] = 0.0  # initial_positions, by on_activate
        if distribution != "humble":
            self.announce("/allegro_hand/controller_manager", [topic.split("/")[1] for topic in topics])


class AllegroV5(Double):
    """333 Hz, index finger first; base node and derived node both subscribe; limp until the first command."""

    rate, state, command, separator = (
        1000.0 / 3.0,
        "/allegroHand_0/joint_states",
        "/allegroHand/joint_cmd",
        "_",
    )
    order_of_state = slice(None)

    def __init__(self, broker: Broker, clock: Clock) -> None:
        names = [f"joint_{number}{self.separator}0" for number in range(16)]
        super().__init__(broker, clock, {self.command: names}, messages.JOINT_STATE)
        self.node.subscription(Topic(name=self.command, type=messages.JOINT_STATE), 3)


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

    rate, state, order_of_state = 80.0, "/leap_hand/joint_states", slice(None)

    def __init__(self, broker: Broker, clock: Clock) -> None:
        super().__init__(
            broker, clock, {"/cmd_allegro": [str(number) for number in range(16)]}, messages.JOINT_STATE
        )


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
        (4.18, 0.35, 11.0, 0.5401, 4.5205),
        (5.26, 0.35, 34.0, -3.0196, 3.0196),
    )

    def __init__(self, broker: Broker, clock: Clock) -> None:
        names = [f"fr3_joint{number}" for number in range(1, 8)]
        super().__init__(
            broker, clock, {"/forward_position_controller/commands": names}, messages.FLOAT_ARRAY
        )
        self.announce("/controller_manager", ["joint_state_broadcaster", "forward_position_controller"])
        self._last = [np.zeros(7)] * 3  #: Position, speed and acceleration of the last command.
        self.reached = np.zeros(3)  #: Largest speed, acceleration and jerk, in their limits.

    def accepts(self, given: np.ndarray, places: list[int]) -> bool:
        if np.isnan(self.goal).any():
            self._last[0] = given
        speed = (given - self._last[0]) * 1e3
        acceleration = (speed - self._last[1]) * 1e3
        jerk = (acceleration - self._last[2]) * 1e3
        most = np.array(
            [
                min(fastest, sqrt(slope * max(end - pos if v > 0.0 else pos - begin, 0.0)) - offset)
                for v, pos, (fastest, offset, slope, begin, end) in zip(
                    speed, given, self.LIMITS, strict=True
                )
            ]
        )
        shares = [np.abs(speed) / most, np.abs(acceleration) / 10.0, np.abs(jerk) / 5000.0]
        self.reached = np.maximum(self.reached, [share.max() for share in shares])
        self._last = [given, speed, acceleration]
        return bool((self.reached <= 1.0 + 1e-6).all())
