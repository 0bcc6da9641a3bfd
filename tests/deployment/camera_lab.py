"""A laboratory with a camera as a process of its own, over DDS; what goes wrong in it is said by a word."""

import json
from collections.abc import Callable
from dataclasses import replace
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
from loop_lab import BOX, moved, picture
from wire_lab import WireLab, frozen, shuffled, with_nan, without_elbow

from pixel2catch.ros2 import messages
from pixel2catch.ros2.factory import make_transport
from pixel2catch.ros2.profile import Profile
from pixel2catch.ros2.transport import LOOPBACK, Clock, Publisher, RealClock, Transport
from pixel2catch.scene.constants import CONTROL_DT
from pixel2catch.servo.link import Command, JointTargets, set_niceness

DT = 0.002
IMAGE_TICKS = round(CONTROL_DT / DT)
AGE = 0.02
"""Age of an image when it is sent [s]."""


Fault = Callable[["CameraLab"], Any]  # what somebody does in it, a function that can be sent to its process


class NoControlLoop:
    """The control loop is a process of its own here."""

    def send(self, words: JointTargets) -> None:
        """There is nobody to send to."""

    def receive(self) -> list[Command]:
        return []


class CameraLab(WireLab):
    """Sends images, too; `faults` are what can go wrong."""

    def __init__(self, transport: Transport, profile: Profile, clock: Clock) -> None:
        super().__init__(transport, NoControlLoop(), profile, clock)  # type: ignore[arg-type]
        self._images = transport.publisher(profile.camera.image)
        self._prompts = transport.publisher(profile.operator.prompt)
        self._stage, self._num_steps = transport, 0
        self.age, self.jump, self._stamp = AGE, 0.0, 0.0
        self.is_object_there = True
        self.pixels: np.ndarray | None = None
        self._others: list[Publisher] = []
        self.faults: dict[str, Callable[[], Any]] = {
            "none": self.mend,
            "arm": self.ask_to_arm,
            "point": lambda: self._prompts.publish(messages.text(json.dumps({"box": BOX}))),
            "camera killed": lambda: self.silent.add("camera"),
            "publisher frozen": lambda: setattr(self, "change", frozen),
            "NaN joint": lambda: setattr(self, "change", with_nan),
            "joint missing": lambda: setattr(self, "change", without_elbow),
            "joints shuffled": lambda: setattr(self, "change", shuffled),
            "joints repeated": self.repeat,
            "images late": lambda: setattr(self, "age", 0.15),
            "wrong image size": lambda: setattr(self, "pixels", np.zeros((240, 320, 3), dtype=np.uint8)),
            "image frozen": lambda: setattr(self, "pixels", self._picture()),
            "object gone": lambda: setattr(self, "is_object_there", False),
            "stamps go back": self._go_back,
            "another camera": lambda: self._others.append(transport.publisher(profile.camera.image)),
            "box jumps": lambda: setattr(self, "jump", 180.0),
            "protective stop": lambda: self.say(profile.status.safety_mode, messages.safety_mode(3)),
            "slider": lambda: setattr(self, "speed", 50.0),
            "switch let go": lambda: setattr(self, "is_held", False),
        }

    def mend(self) -> None:
        """All is well again."""
        self.silent, self.change, self.age = set(), lambda reading: reading, AGE
        self.is_object_there, self.pixels, self.jump, self.speed, self.is_held = True, None, 0.0, 100.0, True
        self._say_status()

    def repeat(self) -> None:
        """All joints are measured where they were, with stamps that go on; the object moves."""
        stays: dict[tuple[str, ...], np.ndarray] = {}
        self.change = lambda reading: replace(
            reading, position=stays.setdefault(reading.names, reading.position.copy())
        )
        self.jump = 15.0

    def step(self) -> None:
        """See `WireLab.step`."""
        super().step()
        if self._num_steps % IMAGE_TICKS == 0 and "camera" not in self.silent:
            self._show()
        self._num_steps += 1

    def _go_back(self) -> None:
        """Send an image that is older than the last, once."""
        self._images.publish(messages.image(self._picture(), self._stamp - 0.05))

    def _show(self) -> None:
        """Send an image, with a stamp after the last one's."""
        self._stamp = max(self._stamp + 1e-3, self.clock.stamp() - self.age)
        pixels = self._picture() if self.pixels is None else self.pixels
        self._images.publish(messages.image(pixels, self._stamp))

    def _picture(self) -> np.ndarray:
        """What there is to see; a box that jumps is elsewhere in every second picture."""
        is_away = self._num_steps // IMAGE_TICKS % 2
        return picture(moved(self.jump * is_away) if self.is_object_there else None)


def laboratory(words: Connection, rate: float) -> None:
    """Be the laboratory until the other end of the pipe is closed; answer each word."""
    set_niceness(-10)
    clock = RealClock(rate)
    with make_transport("dds", "laboratory", LOOPBACK, clock) as transport:
        lab, due = CameraLab(transport, Profile.load("ur5e_allegro_v4"), clock), clock.now()
        try:
            while True:
                lab.step()
                while words.poll():
                    word = words.recv()
                    lab.faults[word]() if isinstance(word, str) else word(lab)
                due = max(due + DT, clock.now())
                clock.sleep_until(due)
        except EOFError:
            return
