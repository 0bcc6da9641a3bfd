"""A deployment in its simplest form, which drives the twin step by step: no perception, no servo's limits."""

import json
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any

import numpy as np
import torch

from pixel2catch.deployment import messages
from pixel2catch.deployment.clock import RealClock
from pixel2catch.deployment.controller import Controller
from pixel2catch.deployment.memory import Broker
from pixel2catch.deployment.profile import Profile
from pixel2catch.envs.cfg import CatchEnvCfg
from pixel2catch.robot.constants import CONTROL_DT, JOINTS
from pixel2catch.twin.camera import Camera
from pixel2catch.twin.drivers import CYCLE
from pixel2catch.twin.lab import Lab
from pixel2catch.twin.view import Exposure, Image
from pixel2catch.twin.wires import COMMAND, STATE, Wires

PROFILE = Profile.load("ur5e_allegro_v4")
BLACK = np.zeros((480, 640, 3), dtype=np.uint8)
START = 1000.0


def draw_black(_: Exposure) -> "Future[Image]":
    future: Future[Image] = Future()
    future.set_result(BLACK)
    return future


class Bench:
    """The twin and a node that listens to all of it, in memory and without real time."""

    def __init__(self, task: CatchEnvCfg, draw: Callable[[Exposure], "Future[Image]"] = draw_black) -> None:
        self.broker, clock = Broker(), RealClock()
        self.lab, self.node = Lab(task, seed=0), self.broker.node(clock)
        self.camera = Camera(draw)
        topics = {
            "joints": PROFILE.robots[0].state_topic,
            "image": PROFILE.camera.image,
            "state": STATE,
            **{name: topic for name, topic in vars(PROFILE.status).items() if topic},
        }
        self.inbox = {name: self.node.subscription(topic, depth=1000) for name, topic in topics.items()}
        self.wires = Wires(self.lab, PROFILE, self.broker.node(clock), self.camera)
        self._arm, self._hand = (self.node.publisher(part.command_topic) for part in PROFILE.robots)
        self._requests = self.node.publisher(COMMAND)
        self.joint_pos = np.zeros(len(JOINTS))

    def ask(self, **request: Any) -> None:
        self._requests.publish(messages.text(json.dumps(request)))

    def command(self, joint_pos: np.ndarray) -> None:
        for part, publisher in zip(PROFILE.robots, (self._arm, self._hand), strict=True):
            publisher.publish(part.command(joint_pos))

    def cycle(self, num: int = 1) -> None:
        for _ in range(num):
            self.wires.cycle(START)

    def read_joints(self) -> np.ndarray:
        for packet in self.inbox["joints"].take():
            reading = messages.read_joint_state(packet.data)
            for part in PROFILE.robots:
                part.merge(reading, self.joint_pos)
        return self.joint_pos

    def states(self) -> list[dict[str, Any]]:
        return [json.loads(messages.read_text(packet.data)) for packet in self.inbox["state"].take()]

    def run_until(self, phase: str, most: int = 3000) -> dict[str, Any]:
        for _ in range(most):
            self.cycle()
            for state in self.states():
                if state["phase"] == phase:
                    return state
        raise AssertionError(f"the throw was never {phase}")


class Pilot:
    """Acts on every state of the twin with boxes of `num_late` states ago."""

    def __init__(self, bench: Bench, controller: Controller, num_late: int = 1) -> None:
        self._bench, self._controller, self._num_late = bench, controller, num_late

    def catch(self, seed: int, num_waiting: int = 8) -> dict[str, Any]:
        """Throw and catch; return how it ended."""
        bench, controller = self._bench, self._controller
        bench.ask(do="prepare", seed=seed)
        bench.cycle()
        state = bench.run_until("held")
        boxes = deque([state["box"]] * (self._num_late + 1), maxlen=self._num_late + 1)
        start = target = bench.read_joints().copy()
        controller.reset()
        num_cycles = round(CONTROL_DT / CYCLE)
        share, num_steps = 1.0, 0
        while state["phase"] != "over":
            for state in bench.states():
                boxes.append(state["box"] or boxes[-1])
                start = start + min(share, 1.0) * (target - start)
                joint_pos = torch.tensor(bench.read_joints(), dtype=torch.float32)[None]
                target = controller.step(joint_pos, torch.tensor([boxes[0]]))[0].double().numpy()
                share, num_steps = 0.0, num_steps + 1
                if num_steps == num_waiting:
                    bench.ask(do="throw")
            share += 1.0 / num_cycles
            bench.command(start + min(share, 1.0) * (target - start))
            bench.cycle()
        return state
