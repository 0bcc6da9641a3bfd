"""A laboratory with a camera and an operator, and a deployment, in stepped time."""

import json
from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any

import numpy as np
from loop_lab import BOX, PROFILE, RED, EverythingRed, moved, new_pipeline, picture
from servo_rows import LIMITS
from wire_lab import WireLab

from pixel2catch.deployment.control_loop import ControlLoop, StepClock, SteppedServo
from pixel2catch.deployment.policy_pipeline import PolicyPipeline
from pixel2catch.deployment.recorder import BagRecorder, DeploymentRecorder
from pixel2catch.ros2 import messages
from pixel2catch.ros2.memory import Broker
from pixel2catch.ros2.profile import Profile
from pixel2catch.ros2.transport import Clock, Transport
from pixel2catch.scene.constants import CONTROL_DT, RGB_CAMERA
from pixel2catch.servo.limits import STOP_TIME
from pixel2catch.servo.process import ARM_PAUSE, ServoSetup

DT = 0.002
IMAGE_TICKS = round(CONTROL_DT / DT)
AGE = 0.02
"""Age of an image when it is sent [s]."""


class CameraLab(WireLab):
    """Sends images as well, except with "camera" in `silent`; the control loop is another object."""

    def __init__(self, transport: Transport, profile: Profile, clock: Clock) -> None:
        super().__init__(transport, None, profile, clock)
        self._images = transport.publisher(profile.camera.image)
        self._prompts = transport.publisher(profile.operator.prompt)
        self._num_steps, self._stamp, self.drift = 0, 0.0, 0.0
        self.mend()

    def mend(self) -> None:
        self.silent, self.is_held, self.is_object_there, self.jump = set(), True, True, 0.0
        self.frozen: np.ndarray | None = None
        self.send_status()

    def point(self) -> None:
        self._prompts.publish(messages.text(json.dumps({"box": BOX})))

    def step(self) -> None:
        super().step()
        if self._num_steps % IMAGE_TICKS == 0 and "camera" not in self.silent:
            self._stamp = max(self._stamp + 1e-3, self.clock.stamp() - AGE)
            pixels = self.picture() if self.frozen is None else self.frozen
            self._images.publish(messages.image(pixels, self._stamp))
        self._num_steps += 1

    def picture(self) -> np.ndarray:
        """Return the scene; a box that jumps is elsewhere in every second picture, one that drifts in all."""
        is_away = self._num_steps // IMAGE_TICKS % 2
        by = self.jump * is_away + self.drift * self._num_steps
        return picture(moved(by) if self.is_object_there else None)


class SteppedBench(AbstractContextManager["SteppedBench"]):
    """Deployment and laboratory: receives statuses and commands, and controls the laboratory."""

    def __init__(self, pipeline: PolicyPipeline | None = None, tape: BagRecorder | None = None) -> None:
        self.clock, self.broker = StepClock(self.wait_until), Broker()
        self.clock.time = 1000.0
        self.lab_node = self.broker.node(self.clock)
        self.lab = CameraLab(self.lab_node, PROFILE, self.clock)
        node = self.broker.node(self.clock)
        self._statuses = node.subscription(PROFILE.operator.status, 50)
        self._commands = node.subscription(PROFILE.robots[0].command_topic, 50, only_watches=True)
        self.status: dict[str, Any] = {"mode": "", "found": []}
        self.commands: list[tuple[float, np.ndarray]] = []
        nodes = self.broker.node(self.clock), self.broker.node(self.clock)
        recording = DeploymentRecorder(tape, nodes[1], PROFILE, self.clock, "raw") if tape else None
        setup = ServoSetup(profile=PROFILE, limits=LIMITS, is_dry_run=tape is not None)
        self.servo = SteppedServo(setup, nodes, self.clock, recording)
        connection, pipeline = self.servo.connection, pipeline or new_pipeline(EverythingRed(RED))
        self.loop = ControlLoop(pipeline, RGB_CAMERA, connection, PROFILE, perception_time=lambda: 0.01)

    def wait_until(self, moment: float) -> None:
        while self.clock.time < moment - 1e-9:
            self.clock.time += LIMITS.dt
            self.lab.step()
            self.servo.tick()
            self.loop.poll()
            for message in self._statuses.take():
                self.status = json.loads(messages.read_text(message.data))
            self.commands += [
                (each.arrival, messages.read_float_array(each.data)) for each in self._commands.take()
            ]

    def until(self, holds: Callable[[], bool], seconds: float = 3.0) -> None:
        end = self.clock.time + seconds
        while not holds():
            assert self.clock.time < end, self.status
            self.wait(LIMITS.dt)

    def wait(self, seconds: float) -> None:
        self.wait_until(self.clock.time + seconds)

    def arm(self) -> None:
        """End all faults, press the switch and arm."""
        self.lab.is_held = False
        self.until(lambda: "dead man" in self.status["found"])
        self.lab.mend()
        self.until(lambda: "dead man" not in self.status["found"])
        self.wait(STOP_TIME + ARM_PAUSE)
        self.lab.request_arm()
        self.until(lambda: self.status["mode"] in ("armed", "ramp", "run"))

    def run(self) -> None:
        """The operator arms and points, and the policy moves the arm."""
        self.arm()
        self.lab.point()
        self.until(lambda: self.status["mode"] == "run")

    def __exit__(self, *exception: object) -> None:
        self.servo.close()
