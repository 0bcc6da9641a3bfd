"""What a robot's drivers say for some seconds, for `doctor`: nothing is announced, and nothing is sent."""

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, final

import numpy as np
from jaxtyping import Float

from pixel2catch.errors import DeploymentError
from pixel2catch.ros2 import messages
from pixel2catch.ros2.profile import Profile
from pixel2catch.ros2.transport import Clock, Endpoint, Subscription, Topic, Transport

DISCOVERY = 5.0  #: Real time in which all that the profile names should be found [s]. Source: ours.
SECONDS = 2.0  #: How long is listened then [s]: one change of lamps and exposure controls. Source: ours.
DEPTH = 2048  #: Messages that are kept until they are taken: a second of joint states.
IMAGES = 16  #: Images that are; half a second of them.
EVERY = 4  #: Rows and columns of which one is looked at for the brightness.


@dataclass(frozen=True, kw_only=True)
class ImageNote:
    """What is kept of an image."""

    stamp: float  #: When it was exposed [s].
    brightness: Float[np.ndarray, " 3"]  #: Mean of its red, green and blue.


@dataclass(frozen=True, kw_only=True)
class Heard:
    """What was heard on a topic, by arrival."""

    readings: list[Any] = field(default_factory=list)  #: The messages as they were read.
    arrivals: list[float] = field(default_factory=list)  #: Time of day at which each came [s].
    errors: list[str] = field(default_factory=list)  #: Why messages could not be read.


@final
class Survey:
    """What was on the network: who, and what was said on each topic that the robot publishes."""

    def __init__(self, transport: Transport, profile: Profile, clock: Clock) -> None:
        """Begin to listen to all that a profile names."""
        self._transport, self._clock, self._profile = transport, clock, profile
        self._readers: dict[Topic, tuple[Subscription, Callable[[bytes], Any]]] = {}
        for topic, read in self._published():
            depth = IMAGES if topic.type == messages.IMAGE else DEPTH
            self._readers[topic] = transport.subscription(topic, depth), read
        self.heard = {topic: Heard() for topic in self._readers}  #: What was said.
        self.endpoints: list[Endpoint] = []  #: All publishers and subscriptions of others.

    def publishers(self, topic: Topic) -> list[Endpoint]:
        """Who publishes under the name of a topic, whatever type."""
        return [each for each in self.endpoints if each.topic == topic.name and each.is_publisher]

    def subscriptions(self, topic: Topic) -> list[Endpoint]:
        """Who listens under the name of a topic, whatever type."""
        return [each for each in self.endpoints if each.topic == topic.name and not each.is_publisher]

    def of_type(self, topic: Topic, *, is_publisher: bool) -> str:
        """Topics of the type of one that somebody publishes, or listens to."""
        kind = (topic.type, is_publisher)
        return ", ".join(sorted({e.topic for e in self.endpoints if (e.type, e.is_publisher) == kind}))

    def _published(self) -> list[tuple[Topic, Callable[[bytes], Any]]]:
        """What the robot should publish, and how it is read."""
        profile, status = self._profile, self._profile.status
        found: list[tuple[Topic | None, Callable[[bytes], Any]]] = [
            (profile.camera.image, self._note_image),
            (profile.camera.info, messages.read_camera_info),
            (status.safety_mode, messages.read_safety_mode),
            (status.robot_mode, messages.read_robot_mode),
            (status.program_running, messages.read_boolean),
            (status.speed_scaling, messages.read_number),
        ]
        found += [(part.state_topic, messages.read_joint_state) for part in profile.robots]
        controllers = (part.controller for part in profile.robots if part.controller)
        found += [(each.activity, messages.read_active_controllers) for each in controllers]
        return [(topic, read) for topic, read in found if topic is not None]

    @property
    def is_complete(self) -> bool:
        """Whether somebody publishes every topic, and somebody takes every command."""
        taken = (self.subscriptions(part.command_topic) for part in self._profile.robots)
        return all(map(self.publishers, self._readers)) and all(taken)

    @property
    def is_anybody_there(self) -> bool:
        """Whether somebody publishes any of the topics."""
        return any(map(self.publishers, self._readers))

    def listen(self) -> None:
        """See who is there, and take and note what has arrived."""
        self.endpoints = self._transport.endpoints()
        to_stamp = self._clock.stamp() - self._clock.now()
        for topic, (subscription, read) in self._readers.items():
            heard = self.heard[topic]
            for message in subscription.take():
                try:
                    heard.readings.append(read(message.data))
                    heard.arrivals.append(message.arrival + to_stamp)
                except DeploymentError as error:
                    heard.errors.append(str(error))

    def _note_image(self, data: bytes) -> ImageNote:
        reading = messages.read_image(data)
        self._profile.camera.require(reading)
        brightness = reading.pixels[::EVERY, ::EVERY].mean(axis=(0, 1))
        return ImageNote(stamp=reading.stamp, brightness=brightness)

    def forget(self) -> None:
        """Begin anew, but for what is latched: it is said once."""
        self.heard |= {topic: Heard() for topic in self._readers if not topic.is_latched}


def take_survey(transport: Transport, profile: Profile, clock: Clock) -> Survey:
    """Find who is on the network, within `DISCOVERY`, and listen for `SECONDS` of the clock."""
    survey = Survey(transport, profile, clock)
    end = time.monotonic() + DISCOVERY
    while time.monotonic() < end and not survey.is_complete:
        transport.wait(0.1)
        survey.listen()
    if survey.is_anybody_there:
        survey.forget()
        end = clock.now() + SECONDS
        while clock.now() < end:
            transport.wait(0.05)
            survey.listen()
    return survey
