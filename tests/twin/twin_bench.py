"""The twin with its topics in memory, cycle by cycle, with black images."""

import json
from concurrent.futures import Future
from functools import cached_property
from typing import Any

import numpy as np

from paper_robot import JOINTS
from pixel2catch.camera.image import Pixels
from pixel2catch.envs.cfg import CatchEnvCfg
from pixel2catch.rendering.camera import Exposure
from pixel2catch.ros2 import messages
from pixel2catch.ros2.memory import Broker
from pixel2catch.ros2.profile import Profile
from pixel2catch.ros2.transport import Publisher, RealClock
from pixel2catch.twin.drivers import CameraDriver
from pixel2catch.twin.lab_node import COMMAND, STATE, LabNode
from pixel2catch.twin.simulated_lab import SimulatedLab

PROFILE = Profile.load("ur5e_allegro_v4")
BLACK = np.zeros((480, 640, 3), dtype=np.uint8)
START = 1000.0


def draw_black(_: Exposure) -> "Future[Pixels]":
    future: Future[Pixels] = Future()
    future.set_result(BLACK)
    return future


class Bench:
    """The twin and a node that listens to all of it, in memory and without real time."""

    def __init__(self, task: CatchEnvCfg) -> None:
        self.broker, clock = Broker(), RealClock()
        self.lab, self.node = SimulatedLab(task, seed=0), self.broker.node(clock)
        self.camera = CameraDriver(draw_black)
        topics = {
            "joints": PROFILE.robots[0].state_topic,
            "image": PROFILE.camera.image,
            "state": STATE,
            **{name: topic for name, topic in vars(PROFILE.status).items() if topic},
        }
        self.queue = {name: self.node.subscription(topic, depth=1000) for name, topic in topics.items()}
        self.lab_node = LabNode(self.lab, PROFILE, self.broker.node(clock), self.camera)
        self._requests = self.node.publisher(COMMAND)
        self.joint_pos = np.zeros(len(JOINTS))

    def ask(self, **request: Any) -> None:
        self._requests.publish(messages.text(json.dumps(request)))

    @cached_property
    def _drivers(self) -> list[Publisher]:
        return [self.node.publisher(part.command_topic) for part in PROFILE.robots]

    def command(self, joint_pos: np.ndarray) -> None:
        for part, publisher in zip(PROFILE.robots, self._drivers, strict=True):
            publisher.publish(part.command(joint_pos, part.held_angles))

    def cycle(self, num: int = 1) -> None:
        for _ in range(num):
            self.lab_node.cycle(START)

    def read_joints(self) -> np.ndarray:
        for message in self.queue["joints"].take():
            reading = messages.read_joint_state(message.data)
            for part in PROFILE.robots:
                part.merge(reading, self.joint_pos)
        return self.joint_pos

    def states(self) -> list[dict[str, Any]]:
        return [json.loads(messages.read_text(message.data)) for message in self.queue["state"].take()]

    def run_until(self, phase: str, most: int = 3000) -> dict[str, Any]:
        for _ in range(most):
            self.cycle()
            for state in self.states():
                if state["phase"] == phase:
                    return state
        raise AssertionError(f"the throw was never {phase}")
