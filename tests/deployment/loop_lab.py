"""A control loop's surroundings in memory: network, camera, and the servo's end of the link."""

from dataclasses import dataclass
from functools import cached_property
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np
import torch

from paper_robot import JOINTS
from pixel2catch.camera.image import Edges, Pixels
from pixel2catch.deployment.control_loop import Connection
from pixel2catch.deployment.policy_pipeline import PolicyController, PolicyPipeline
from pixel2catch.evaluation.loading import load_policy
from pixel2catch.methods import find_method
from pixel2catch.perception.segmenter import ColorRange, ColorThreshold, Segmentation, Segmenter
from pixel2catch.perception.tracker import Prompter
from pixel2catch.policy import Policy, contract_of
from pixel2catch.ros2 import messages
from pixel2catch.ros2.memory import Broker
from pixel2catch.ros2.profile import Profile
from pixel2catch.ros2.transport import Clock, Publisher, Transport
from pixel2catch.servo.link import Command, Mode, ServoEnd
from pixel2catch.workcells import find_workcell

HOME = np.array([joint.home for joint in JOINTS])
PROFILE = Profile.load("ur5e_allegro_v4")
WORKCELL = find_workcell(PROFILE.workcell)
BOX: Edges = (300.0, 200.0, 330.0, 230.0)
ASKING = 1e-4
"""Time that passes with every call of `now` [s]."""

RED = ColorRange(hue=(340.0, 20.0))
NOISE = cycle(range(100, 140))


def picture(box: Edges | None = BOX) -> np.ndarray:
    """Grey, with a red rectangle; the first pixel is never that of the picture before."""
    image = np.full((480, 640, 3), 120, dtype=np.uint8)
    image[0, 0, 0] = next(NOISE)
    if box:
        xmin, ymin, xmax, ymax = map(int, box)
        image[ymin:ymax, xmin:xmax] = (200, 30, 20)
    return image


class EverythingRed(ColorThreshold):
    def find(
        self, image: Pixels, motion: Any = None, prompt: Any = None, interval: float = 1.0
    ) -> Segmentation:
        return Segmentation(mask=RED.mask(image), score=1.0)


def remembering(method: str = "shared_reward+boxes") -> PolicyController:
    """Return a policy that gets the ages of its boxes, with random networks."""
    torch.manual_seed(0)
    return PolicyController(Policy(contract_of(find_method(method), WORKCELL)).eval(), WORKCELL)


def forgetting() -> PolicyController:
    """Return the paper's policy, which gets no ages."""
    return PolicyController(load_policy(Path("proposed"))[0], WORKCELL)


def new_pipeline(
    segmenter: Segmenter | None = None, controller: PolicyController | None = None
) -> PolicyPipeline:
    """Return a pipeline: by default the paper's policy, and a segmenter for red."""
    return PolicyPipeline(controller or forgetting(), segmenter or ColorThreshold(RED), Prompter())


class PassingClock(Clock):
    """Time passes with every call of `now`, on any machine alike."""

    def __init__(self) -> None:
        self._time = 1000.0

    def now(self) -> float:
        self._time += ASKING
        return self._time

    def stamp(self) -> float:
        return 1.7e9 + self.now()

    def sleep_until(self, moment: float) -> None:
        self._time = max(self._time, moment)


@dataclass(frozen=True, kw_only=True)
class Surroundings:
    """The connection of a control loop, and its other ends."""

    connection: Connection
    servo: ServoEnd
    lab: Transport
    clock: Clock
    broker: Broker

    def tick(self, mode: Mode, **others: Any) -> None:
        """The servo sends the command of a tick at the start pose, without any target or fault."""
        command: dict[str, Any] = dict.fromkeys(("stopped_by", "found", "refused", "clamped"), 0)
        command |= dict.fromkeys(("joint_pos_command", "joint_pos"), HOME)
        command |= dict.fromkeys(("target_stamp", "image_stamp"), -np.inf)
        command |= {"time": self.clock.now(), "mode": int(mode), "duration": 4e-4}
        self.servo.send(Command(**command | others))

    def show(self, image: np.ndarray, age: float = 0.0) -> float:
        """Send an image of this age; return its exposure time, `Clock.now` [s]."""
        taken = self.clock.now() - age
        self.camera.publish(messages.image(image, self.clock.stamp() - age))
        return taken

    @cached_property
    def camera(self) -> Publisher:
        return self.lab.publisher(PROFILE.camera.image)


def moved(by: float) -> Edges:
    """Return the box, moved to the right and down [px]."""
    xmin, ymin, xmax, ymax = BOX
    return xmin + by, ymin + by, xmax + by, ymax + by
