"""Survey of a laboratory's network for `doctor --robot`, and checks of what was found. Nothing is sent.

A check returns what it found, or raises `Broken` with what to do, or `Absent` where it does not apply.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from math import inf, pi
from typing import Any, NamedTuple, final

import numpy as np
from numpy import ndarray

from pixel2catch.deployment import machine
from pixel2catch.deployment.perception import EARLIEST, lens_difference
from pixel2catch.errors import DeploymentError
from pixel2catch.findings import Absent, Broken, Check, check
from pixel2catch.ros2 import messages
from pixel2catch.ros2.profile import CameraProfile, Controller, Profile, RobotPart
from pixel2catch.ros2.transport import Clock, Endpoint, Subscription, Topic, Transport
from pixel2catch.scene.constants import CONTROL_DT, CameraSpec
from pixel2catch.servo.limits import ServoLimits
from pixel2catch.workcells import find_workcell

DISCOVERY = 5.0  #: Real time within which all programs of the profile are found [s]. Source: ours.
SECONDS = 2.0  #: Duration of listening then [s]: a change of lamps and exposure controls. Source: ours.
DEPTHS = {messages.IMAGE: 16}  #: Messages kept between two polls by type: half a second of images.
DEPTH = 2048  #: Likewise of other types: a second of joint states.
THINNING = 4  #: Step between the rows and columns that give the brightness [px].

RATE_SHARE, MOST_RATE_SHARE = 0.95, 1.5  #: Range of a driver's rate, in the profile's. Source: ours.
CLOCK_ERROR = 0.02  #: Largest difference of two clocks [s]. Source: training, docs/deployment.md.
LEAST_IMAGES = 10  #: Images from which a change of the exposure is visible. Source: ours.
MOST_CHANGE = 0.03  #: Largest relative change of the brightness of a still scene. Source: ours.

FULL_SPEED = 99.95  #: Least speed scaling of a robot at its full speed [%]. Source: ours.

SAFETY_MODES = (
    *("undefined", "normal", "reduced", "protective stop", "recovery", "safeguard stop"),
    *("system emergency stop", "robot emergency stop", "violation", "fault", "validate joint id", "unknown"),
    *("automatic mode safeguard stop", "three position enabling stop"),
)
"""By number. Source: `ur_dashboard_msgs/SafetyMode`."""

ROBOT_MODES = (
    *("no controller", "disconnected", "confirm safety", "booting", "power off", "power on", "idle"),
    *("backdrive", "running", "updating firmware"),
)
"""By number plus one. Source: `ur_dashboard_msgs/RobotMode`."""


class _Photo(NamedTuple):
    """What is kept of an image."""

    stamp: float  #: Exposure time [s].
    brightness: ndarray  #: Mean of its red, green and blue.


@dataclass(frozen=True, kw_only=True)
class TopicMessages:
    """Messages of a topic."""

    readings: list[Any] = field(default_factory=list)  #: The decoded messages.
    arrivals: list[float] = field(default_factory=list)  #: Time of day at arrival [s].
    errors: list[str] = field(default_factory=list)  #: Why messages could not be decoded.


@final
class Survey:
    """Programs on the network, and the messages of each topic that a robot publishes."""

    def __init__(self, transport: Transport, profile: Profile, clock: Clock) -> None:
        """Subscribe to the topics of a profile."""
        self._transport, self._clock, self._profile = transport, clock, profile
        status = profile.status
        decoders: dict[Topic | None, Callable[[bytes], Any]] = {
            profile.camera.image: self._read_image,
            profile.camera.info: messages.read_camera_info,
            status.safety_mode: messages.read_safety_mode,
            status.robot_mode: messages.read_robot_mode,
            status.program_running: messages.read_boolean,
            status.speed_scaling: messages.read_number,
        }
        for part in profile.robots:
            decoders[part.state_topic] = messages.read_joint_state
            if part.controller:
                decoders[part.controller.activity] = messages.read_active_controllers
        self._readers: dict[Topic, tuple[Subscription, Callable[[bytes], Any]]] = {
            topic: (transport.subscription(topic, DEPTHS.get(topic.type, DEPTH)), read)
            for topic, read in decoders.items()
            if topic
        }
        self.received = {topic: TopicMessages() for topic in self._readers}  #: The messages by topic.
        self.endpoints: list[Endpoint] = []  #: Publishers and subscriptions of all other programs.

    def others(self, topic: Topic, *, publish: bool) -> list[Endpoint]:
        """Return the publishers, or the subscriptions, of a topic of this name and any type."""
        return [each for each in self.endpoints if (each.topic, each.is_publisher) == (topic.name, publish)]

    def of_type(self, topic: Topic, *, publish: bool) -> str:
        """Return the names of the topics of this type that have a publisher, or a subscription."""
        kind = (topic.type, publish)
        return ", ".join(sorted({e.topic for e in self.endpoints if (e.type, e.is_publisher) == kind}))

    def take(self) -> None:
        """Run until everything of the profile is found, at most for `DISCOVERY`, then for `SECONDS`."""
        end = time.monotonic() + DISCOVERY
        while time.monotonic() < end and not self._is_complete:
            self._transport.wait(0.1)
            self.listen()
        if not any(self.others(topic, publish=True) for topic in self._readers):
            return
        self.received |= {topic: TopicMessages() for topic in self._readers if not topic.is_latched}
        end = self._clock.now() + SECONDS
        while self._clock.now() < end:
            self._transport.wait(0.05)
            self.listen()

    def listen(self) -> None:
        """Take what has arrived."""
        self.endpoints = self._transport.endpoints()
        to_stamp = self._clock.stamp() - self._clock.now()
        for topic, (subscription, read) in self._readers.items():
            found = self.received[topic]
            for message in subscription.take():
                try:
                    found.readings.append(read(message.data))
                    found.arrivals.append(message.arrival + to_stamp)
                except DeploymentError as error:
                    found.errors.append(str(error))

    @property
    def _is_complete(self) -> bool:
        commands = (part.command_topic for part in self._profile.robots)
        return all(self.others(topic, publish=True) for topic in self._readers) and all(
            self.others(topic, publish=False) for topic in commands
        )

    def _read_image(self, data: bytes) -> _Photo:
        image = messages.read_image(data)
        self._profile.camera.require(image)
        return _Photo(image.stamp, image.pixels[::THINNING, ::THINNING].mean(axis=(0, 1)))


def messages_of(survey: Survey, topic: Topic, most: float = 1) -> TopicMessages:
    """Return the messages of a topic that has one publisher, or up to a number, and the profile's type."""
    publishers = survey.others(topic, publish=True)
    if not publishers:
        alike = survey.of_type(topic, publish=True)
        hint = f"{topic.type} is published on {alike}" if alike else "nor any topic of that type"
        raise Broken(f"nobody publishes {topic.name}; {hint}: start the driver, or correct the profile")
    require_type(topic, publishers)
    if len(publishers) > most:
        raise Broken(f"{len(publishers)} publishers of {topic.name}: one may be; end the others")
    found = survey.received[topic]
    if not found.readings:
        why = found.errors[0] if found.errors else "none arrives: check firewall and cables"
        raise Broken(f"no message on {topic.name}: {why}")
    return found


def messages_if_good(survey: Survey, topic: Topic, most: float = 1) -> TopicMessages:
    """Return the messages of a topic; `Absent` if there are none, because another check reports that."""
    try:
        return messages_of(survey, topic, most)
    except Broken as error:
        raise Absent(f"not checked without good messages on {topic.name}") from error


def network(survey: Survey) -> str:
    """Check that there are other programs."""
    publishers = sum(each.is_publisher for each in survey.endpoints)
    if not survey.endpoints:
        raise Broken(
            "no other program is found: compare ROS_DOMAIN_ID with the drivers', check interface and "
            "firewall (UDP from 7400 on), and ROS_LOCALHOST_ONLY where they were started"
        )
    return f"{publishers} publishers, {len(survey.endpoints) - publishers} subscriptions of others"


def require_type(topic: Topic, endpoints: list[Endpoint]) -> None:
    """Refuse endpoints of other types."""
    types = sorted({each.type for each in endpoints})
    if types != [topic.type]:
        raise Broken(f"{topic.name} is of type {', '.join(types)}, the profile has {topic.type}: correct it")


def joint_states(survey: Survey, part: RobotPart, limits: ServoLimits) -> str:
    """Check that all joints of a part are published, at the driver's rate and without pauses."""
    received = messages_of(survey, part.state_topic, inf)
    wanted = {theirs.name_in_state for theirs in part.joints.values()}
    found = {name for reading in received.readings for name in reading.names}
    if missing := sorted(wanted - found):
        raise Broken(
            f"{part.state_topic.name} lacks {', '.join(missing)}; it has {', '.join(sorted(found))}: correct "
            "name_in_state in the profile, or the driver's prefix"
        )
    own = [place for place, reading in enumerate(received.readings) if wanted & set(reading.names)]
    stamps = np.array([received.readings[place].stamp for place in own])
    arrivals = np.array([received.arrivals[place] for place in own])
    age = float(limits.joints.position_age[part.ids].min())
    hint = "check the driver's update_rate, cables and processor load"
    return f"{len(wanted)} joints, {require_rate(stamps, arrivals, part.rate_hz, age, hint)}"


def require_rate(stamps: ndarray, arrivals: ndarray, rate: float, age: float, hint: str) -> str:
    """Refuse a wrong rate [Hz], and pauses longer than an age [s] that stops the robot."""
    times = np.unique(stamps)
    if len(times) < 3:
        raise Broken(f"{len(times)} different stamps: the driver hangs, or does not stamp its messages")
    found = (len(times) - 1) / (times[-1] - times[0])
    pause, jitter = np.diff(arrivals).max(), np.diff(arrivals).std()
    measured = f"{found:.1f} Hz, jitter {1e3 * jitter:.1f} ms, longest pause {1e3 * pause:.0f} ms"
    if found < RATE_SHARE * rate:
        raise Broken(f"{measured}: {rate:g} Hz are needed; {hint}")
    if found > MOST_RATE_SHARE * rate:
        raise Broken(f"{measured}: {rate:g} Hz are expected; end a second driver of the same joints")
    if pause > age:
        raise Broken(f"{measured}: the servo stops after {1e3 * age:.0f} ms; free the processor, use a cable")
    return measured


def images(survey: Survey, camera: CameraProfile, limits: ServoLimits) -> str:
    """Check size, encoding and rate of the images."""
    found = messages_of(survey, camera.image)
    if found.errors:
        raise Broken(found.errors[-1])
    stamps = np.array([reading.stamp for reading in found.readings])
    hint = "expose for less than 33 ms, use another USB 3 port, check the processor load"
    rate = require_rate(stamps, np.array(found.arrivals), 1.0 / CONTROL_DT, limits.image_age, hint)
    return f"{camera.width} x {camera.height} {camera.encoding}, {rate}"


def exposure(survey: Survey, camera: CameraProfile) -> str:
    """Check that images of a still scene keep their brightness in every colour."""
    readings = messages_if_good(survey, camera.image).readings
    if len(readings) < LEAST_IMAGES:
        raise Absent(f"{len(readings)} images are too few")
    brightness = np.array([reading.brightness for reading in readings])
    mean = brightness.mean(axis=0)
    change = np.ptp(brightness, axis=0) / np.maximum(mean, 1.0)
    measured = f"brightness {mean.mean():.0f} of 255, changes by {100.0 * change.max():.1f} %"
    if change.max() <= MOST_CHANGE:
        return measured
    raise Broken(
        f"{measured}: turn automatic exposure and white balance off; if nothing moves in the image and the "
        "change goes up and down, lamps flicker: expose for 10 ms at 50 Hz of mains, 8.3 ms at 60 Hz, or use "
        "lamps with direct current"
    )


def lens(survey: Survey, camera: CameraProfile, expected: CameraSpec) -> str:
    """Check that lens and image size are those of the calibrated camera."""
    if camera.info is None:
        raise Absent("the profile has no topic for it")
    found = messages_of(survey, camera.info).readings[-1].camera
    if (found.width, found.height) != (camera.width, camera.height):
        raise Broken(
            f"{camera.info.name} is of {found.width} x {found.height}, the profile has {camera.width} x "
            f"{camera.height}: set the camera's driver to that"
        )
    if difference := lens_difference(found, expected):
        raise Broken(difference)
    return f"fx {found.fx:.1f}, fy {found.fy:.1f}, cx {found.cx:.1f}, cy {found.cy:.1f}, as calibrated"


def clocks(survey: Survey, profile: Profile, limits: ServoLimits) -> str:
    """Check that stamps are of this machine's clock, by the youngest messages."""
    measured = []
    bounds = {part.state_topic: (-CLOCK_ERROR, CLOCK_ERROR) for part in profile.robots}
    bounds[profile.camera.image] = (EARLIEST, limits.image_age)
    for topic, (earliest, latest) in bounds.items():
        found = messages_if_good(survey, topic, 1 if topic == profile.camera.image else inf)
        ages = np.array(found.arrivals) - [reading.stamp for reading in found.readings]
        age = float(np.quantile(ages, 0.1))
        measured.append(f"{topic.name} {1e3 * age:.1f} ms")
        if not earliest <= age <= latest:
            raise Broken(
                f"{measured[-1]} old at arrival by its stamps, valid are {1e3 * earliest:.0f} to "
                f"{1e3 * latest:.0f} ms: synchronise the machines (chrony or PTP), and let the driver write "
                "the time of measurement into header.stamp"
            )
    return f"ages at arrival: {', '.join(measured)}"


def status(survey: Survey, topic: Topic, wanted: float, words: Callable[[Any], str], fix: str) -> str:
    """Check that the newest value of a topic is the wanted one, or more."""
    found = messages_of(survey, topic).readings[-1]
    if found != wanted and not (topic.type == messages.NUMBER and found > wanted):
        raise Broken(f"{words(found)}, not {words(wanted)}: {fix}")
    return words(found)


def commands(survey: Survey, part: RobotPart) -> str:
    """Check that one driver receives the commands of a part, and no other program sends any."""
    topic = part.command_topic
    receivers, senders = survey.others(topic, publish=False), survey.others(topic, publish=True)
    if senders:
        raise Broken(f"{len(senders)} other publishers of {topic.name}: end that program before arming")
    if not receivers:
        alike = survey.of_type(topic, publish=False)
        hint = f"; {topic.type} is received on {alike}" if alike else ""
        raise Broken(f"nobody receives {topic.name}{hint}: load the controller, or correct the profile")
    require_type(topic, receivers)
    if len(receivers) > 1:
        raise Broken(f"{len(receivers)} subscribers of {topic.name}: one driver may be; end the others")
    return f"{topic.name}: one driver, no other publisher"


def controller(survey: Survey, wanted: Controller) -> str:
    """Check that the controller that receives the commands is active, as it must be after homing."""
    if wanted.name not in messages_of(survey, wanted.activity).readings[-1]:
        raise Absent(
            f"{wanted.name} is not active: switch to it when the arm is at its start pose, before arming"
        )
    return f"{wanted.name} is active"


def pose(survey: Survey, part: RobotPart, home: ndarray, near: ndarray) -> str:
    """Check that the joints of a part are near the start pose; all in joint order [rad]."""
    joint_pos = np.full(len(home), np.nan)
    for reading in messages_if_good(survey, part.state_topic, inf).readings:
        part.merge(reading, joint_pos)
    away = np.abs(joint_pos - home)[part.ids]
    if np.isnan(away).any():
        raise Absent("not checked without all joints")
    far = [
        f"{joint} {value * 180.0 / pi:.0f}°"
        for joint, value, most in zip(part.joints, away, near[part.ids], strict=True)
        if value > most
    ]
    if far:
        raise Absent(f"away from the start pose: {', '.join(far)}; home it before arming")
    return "at the start pose"


def _mode_name(names: Sequence[str], first: int, number: int) -> str:
    is_known = 0 <= number - first < len(names)
    return f"{names[number - first] if is_known else 'unknown'} ({number})"


def checks_of_laboratory(
    profile: Profile, survey: Survey, camera: CameraSpec, *, is_loopback: bool
) -> list[Check]:
    """Return the checks of this machine and of the network, in the order in which to correct them.

    Beside a twin on this machine (loopback) the settings for real time need not be good.
    """
    limits = ServoLimits.of(find_workcell(profile.workcell))
    settings: dict[str, Callable[[], str]] = {
        "kernel": machine.kernel,
        "real-time priority": machine.real_time,
        "ticks": partial(machine.ticks, limits),
        "receive buffers": machine.receive_buffers,
    }
    found = [check(name, probe, is_needed=not is_loopback) for name, probe in settings.items()]
    topics, robots, pendant = profile.status, profile.robots, "correct it at the pendant"
    robot_mode, safety_mode = partial(_mode_name, ROBOT_MODES, -1), partial(_mode_name, SAFETY_MODES, 0)
    play = "press play on the pendant, check its host address"
    states = (
        ("robot mode", topics.robot_mode, messages.RUNNING_ROBOT_MODE, robot_mode, pendant),
        ("safety mode", topics.safety_mode, messages.NORMAL_SAFETY_MODE, safety_mode, pendant),
        ("program", topics.program_running, True, "External Control runs: {}".format, play),
        ("speed scaling", topics.speed_scaling, FULL_SPEED, "{:.1f} %".format, "push its slider to 100 %"),
    )
    probes: dict[str, Callable[[], str]] = {
        "DDS settings": partial(machine.dds_settings, is_loopback),
        "network": partial(network, survey),
    }
    for name, topic, wanted, words, fix in states:
        if topic:
            probes[name] = partial(status, survey, topic, wanted, words, fix)
    probes |= {f"joints of {part.name}": partial(joint_states, survey, part, limits) for part in robots}
    probes["images"] = partial(images, survey, profile.camera, limits)
    probes["exposure"] = partial(exposure, survey, profile.camera)
    probes["lens"] = partial(lens, survey, profile.camera, camera)
    probes["clocks"] = partial(clocks, survey, profile, limits)
    probes |= {f"commands to {part.name}": partial(commands, survey, part) for part in robots}
    for part in robots:
        if part.controller:
            probes[f"controller of {part.name}"] = partial(controller, survey, part.controller)
    home = np.array([joint.home for joint in find_workcell(profile.workcell).joints])
    near = limits.joints.start_error
    probes |= {f"pose of {part.name}": partial(pose, survey, part, home, near) for part in robots}
    return found + [check(name, probe, is_needed=True) for name, probe in probes.items()]
