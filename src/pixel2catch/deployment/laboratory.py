"""Survey of a laboratory for `doctor --robot`: this machine, drivers, camera, clocks. Nothing is sent.

A check returns what it found, or raises `Broken` with what to do, or `Absent` where it does not apply.
"""

import os
import resource
import time
from collections.abc import Callable
from functools import partial
from math import inf
from pathlib import Path
from typing import Any, final

import numpy as np

from pixel2catch.deployment.perception import EARLIEST, lens_difference
from pixel2catch.errors import DeploymentError
from pixel2catch.installation import Absent, Broken, Check, check
from pixel2catch.ros2 import messages
from pixel2catch.ros2.profile import Profile, RobotPart
from pixel2catch.ros2.transport import Clock, Endpoint, Topic, Transport
from pixel2catch.scene.constants import CONTROL_DT, CameraSpec
from pixel2catch.servo.limits import ServoLimits
from pixel2catch.servo.link import SERVO_PRIORITY, scheduled
from pixel2catch.workcells import find_workcell

GUIDE = "docs/laboratory.md"  #: Page with the steps.
LEAST_BUFFER = 4_000_000  #: Least receive buffer of a socket [bytes]: four images. Source: ours.
DISCOVERY = 5.0  #: Real time within which all programs of the profile are found [s]. Source: ours.
SECONDS = 2.0  #: Duration of listening then [s]. Source: ours.
IMAGE_DEPTH, DEPTH = 16, 2048  #: Messages kept between polls: half a second of images, or of joint states.

RATE_SHARE, MOST_RATE_SHARE = 0.95, 1.5  #: Range of a driver's rate, in the profile's. Source: ours.
CLOCK_ERROR = 0.02  #: Largest difference of two clocks [s]. Source: training, docs/deployment.md.
FULL_SPEED = 99.95  #: Least speed scaling of a robot at its full speed [%]. Source: ours.


@final
class Survey:
    """Programs on the network, and the messages of each topic that a robot publishes."""

    def __init__(self, transport: Transport, profile: Profile, clock: Clock) -> None:
        self._transport, self._clock, self._profile = transport, clock, profile
        readers = {
            "safety_mode": messages.read_safety_mode,
            "robot_mode": messages.read_robot_mode,
            "program_running": messages.read_boolean,
            "speed_scaling": messages.read_number,
        }
        decoders: dict[Topic | None, Callable[[bytes], Any]] = {
            profile.camera.image: self._stamp_of_image,
            profile.camera.info: messages.read_camera_info,
            **{topic: readers[name] for arm in profile.all_status for name, topic in arm.items()},
            **{part.state_topic: messages.read_joint_state for part in profile.robots},
        }
        self._decoders = {topic: decode for topic, decode in decoders.items() if topic}
        self._subscriptions = {
            topic: transport.subscription(topic, IMAGE_DEPTH if topic == profile.camera.image else DEPTH)
            for topic in self._decoders
        }
        #: Arrival by the time of day [s] and content of each message, of an image its stamp [s], by topic.
        self.received: dict[Topic, list[tuple[float, Any]]] = {topic: [] for topic in self._decoders}
        self.errors: dict[Topic, str] = {}  #: Why the last message that could not be read was refused.
        self.endpoints: list[Endpoint] = []  #: Publishers and subscriptions of all other programs.

    def take(self) -> None:
        """Wait for all topics of the profile, at most for `DISCOVERY`; then receive for `SECONDS`."""
        publish = {topic.name for topic in self._decoders}
        receive = {part.command_topic.name for part in self._profile.robots}
        wanted = {(name, True) for name in publish} | {(name, False) for name in receive}
        end, found = time.monotonic() + DISCOVERY, set[tuple[str, bool]]()
        while time.monotonic() < end and not wanted <= found:
            self._transport.wait(0.1)
            self.listen()
            found = {(each.topic, each.is_publisher) for each in self.endpoints}
        if not any((name, True) in found for name in publish):
            return
        self.received |= {topic: [] for topic in self._decoders if not topic.is_latched}
        end = self._clock.now() + SECONDS
        while self._clock.now() < end:
            self._transport.wait(0.05)
            self.listen()

    def listen(self) -> None:
        self.endpoints = self._transport.endpoints()
        to_stamp = self._clock.stamp() - self._clock.now()
        for topic, decode in self._decoders.items():
            for message in self._subscriptions[topic].take():
                try:
                    self.received[topic].append((message.arrival + to_stamp, decode(message.data)))
                except DeploymentError as error:
                    self.errors[topic] = str(error)

    def _stamp_of_image(self, data: bytes) -> float:
        image = messages.read_image(data)
        if wrong := self._profile.camera.wrong_format(image):
            raise DeploymentError(wrong)
        return image.stamp

    @property
    def is_heard(self) -> bool:
        """Whether some program publishes or receives a topic of the profile's drivers or camera."""
        topics = {part.command_topic.name for part in self._profile.robots}
        topics |= {topic.name for topic in self._decoders}
        return any(each.topic in topics for each in self.endpoints)

    def require_endpoints(self, topic: Topic, *, publish: bool, most: float = 1) -> None:
        """Refuse a topic without publishers, or subscribers, with another type, or with too many of them."""
        verb, noun = ("publishes", "publishers") if publish else ("receives", "receiving programs")
        others = [each for each in self.endpoints if each.is_publisher == publish]
        named = [each for each in others if each.topic == topic.name]
        found = [each.type for each in named]
        if not found:
            alike = ", ".join(sorted({each.topic for each in others if each.type == topic.type}))
            hint = f"somebody {verb} {topic.type} on {alike}" if alike else "nor any topic of that type"
            raise Broken(f"nobody {verb} {topic.name}; {hint}: start the driver, or correct the profile")
        if wrong := {*found} - {topic.type}:
            raise Broken(f"{topic.name} has type {', '.join(wrong)}, the profile {topic.type}: correct it")
        if (count := len(found) if publish else len({each.program for each in named})) > most:
            raise Broken(f"{count} {noun} of {topic.name}: one may be; end the others")

    def messages_of(self, topic: Topic, most: float = 1) -> list[tuple[float, Any]]:
        """Return arrivals and contents of a topic with one publisher, or up to a number."""
        self.require_endpoints(topic, publish=True, most=most)
        if not self.received[topic]:
            why = self.errors.get(topic, "none arrives: check firewall and cables")
            raise Broken(f"no message on {topic.name}: {why}")
        return self.received[topic]


def real_time() -> str:
    """Check that the servo may use real-time scheduling."""
    with scheduled(os.SCHED_FIFO, SERVO_PRIORITY) as is_granted:
        if is_granted:
            return f"priority {SERVO_PRIORITY} of SCHED_FIFO is granted"
    limit, _ = resource.getrlimit(resource.RLIMIT_RTPRIO)
    raise Broken(
        f"the limit rtprio is {limit}, the servo needs priority {SERVO_PRIORITY}: write "
        f"'@realtime - rtprio 99' into /etc/security/limits.conf, join that group, log in again ({GUIDE})"
    )


def receive_buffers(path: Path = Path("/proc/sys/net/core/rmem_max")) -> str:
    """Check the largest receive buffer of a socket."""
    if not path.exists():
        raise Absent("the system does not show it, as in containers")
    size = int(path.read_text())
    if size < LEAST_BUFFER:
        raise Broken(
            f"net.core.rmem_max is {size}, less than {LEAST_BUFFER}: images are lost. "
            "'sudo sysctl -w net.core.rmem_max=8388608', and the same into /etc/sysctl.d"
        )
    return f"net.core.rmem_max is {size}"


def network(survey: Survey) -> str:
    """Check that there are drivers."""
    if not survey.is_heard:
        raise Broken(
            f"no driver of the profile is found, and {len(survey.endpoints)} publishers and subscriptions of "
            "others; nothing else was checked: compare ROS_DOMAIN_ID with the drivers', check interface and "
            "firewall (UDP from 7400 on), unset ROS_LOCALHOST_ONLY and ROS_AUTOMATIC_DISCOVERY_RANGE where "
            "they were started, and start them with a middleware that is DDS, such as rmw_cyclonedds_cpp"
        )
    publishers = sum(each.is_publisher for each in survey.endpoints)
    return f"{publishers} publishers, {len(survey.endpoints) - publishers} subscriptions of others"


def state(survey: Survey, topic: Topic, wanted: float, fix: str) -> str:
    """Check that the newest value of a topic is the wanted one, or more of a number."""
    _, found = survey.messages_of(topic)[-1]
    if found != wanted and not (topic.type == messages.NUMBER and found > wanted):
        raise Broken(f"{found:g}, not {wanted:g}: {fix}")
    return f"{found:g}"


def joint_states(survey: Survey, part: RobotPart, age: float) -> str:
    """Check that all joints of a part are published, at the driver's rate and without pauses."""
    found = survey.messages_of(part.state_topic, inf)
    wanted = {theirs.name_in_state for theirs in part.joints.values()}
    names = {name for _, reading in found for name in reading.names}
    if missing := sorted(wanted - names):
        raise Broken(
            f"{part.state_topic.name} lacks {', '.join(missing)}; it has {', '.join(sorted(names))}: correct "
            "name_in_state in the profile, or the driver's prefix"
        )
    own = [(arrival, reading.stamp) for arrival, reading in found if wanted & {*reading.names}]
    hint = "check the driver's update_rate, cables and processor load"
    measured = timing(own, part.rate_hz, age, (-CLOCK_ERROR, CLOCK_ERROR), hint)
    return f"{len(wanted)} joints, {measured}"


def images(survey: Survey, profile: Profile, age: float) -> str:
    """Check size, encoding, rate and age of the images."""
    camera = profile.camera
    found = survey.messages_of(camera.image)
    if camera.image in survey.errors:
        raise Broken(survey.errors[camera.image])
    hint = "expose for less than 33 ms, use another USB 3 port, check the processor load"
    measured = timing(found, 1.0 / CONTROL_DT, age, (EARLIEST, age), hint)
    return f"{camera.width} x {camera.height} {camera.encoding}, {measured}"


def timing(
    found: list[tuple[float, float]], rate: float, age: float, ages: tuple[float, float], hint: str
) -> str:
    """Check rate [Hz], pauses and stamps of messages, by their arrivals and stamps, time of day [s].

    A pause longer than the age stops the robot [s]. Stamps with an age at arrival beyond the ages [s] are of
    another clock. The hint is what to do if the rate is too low.
    """
    arrivals, stamps = np.transpose(found)
    times = np.unique(stamps)
    if len(times) < 3:
        raise Broken(f"{len(times)} different stamps: the driver hangs, or does not stamp its messages")
    measured_rate, pause = (len(times) - 1) / (times[-1] - times[0]), np.diff(arrivals).max()
    measured_age = float(np.quantile(arrivals - stamps, 0.1))
    measured = (
        f"{measured_rate:.1f} Hz, longest pause {1e3 * pause:.0f} ms, "
        f"{1e3 * measured_age:.1f} ms old at arrival"
    )
    if not ages[0] <= measured_age <= ages[1]:
        raise Broken(
            f"{measured} by the stamps, valid are {1e3 * ages[0]:.0f} to {1e3 * ages[1]:.0f} ms: synchronise "
            "the machines (chrony or PTP), and let the driver write the time of measurement into header.stamp"
        )
    if measured_rate < RATE_SHARE * rate:
        raise Broken(f"{measured}: {rate:g} Hz are needed; {hint}")
    if measured_rate > MOST_RATE_SHARE * rate:
        raise Broken(f"{measured}: {rate:g} Hz are expected; end a second driver of the same joints")
    if pause > age:
        raise Broken(f"{measured}: the servo stops after {1e3 * age:.0f} ms; free the processor, use a cable")
    return measured


def lens(survey: Survey, topic: Topic | None, expected: CameraSpec) -> str:
    """Check that the lens is that of the calibrated camera."""
    if topic is None:
        raise Absent("the profile has no topic for it")
    _, found = survey.messages_of(topic)[-1]
    if difference := lens_difference(found, expected):
        raise Broken(difference)
    return "as calibrated"


def commands(survey: Survey, part: RobotPart) -> str:
    """Check that one driver receives the commands of a part, and no other program sends any."""
    name = part.command_topic.name
    if senders := sum(each.topic == name and each.is_publisher for each in survey.endpoints):
        raise Broken(f"{senders} other publishers of {name}: end that program before arming")
    survey.require_endpoints(part.command_topic, publish=False)
    return f"{name}: one driver, no other publisher"


def checks_of_laboratory(
    profile: Profile, survey: Survey, camera: CameraSpec, *, is_loopback: bool
) -> list[Check]:
    """Return the checks of this machine and of the network, in the order in which to correct them.

    Beside a twin on this machine (loopback) the settings of the machine need not be good.
    """
    limits = ServoLimits.of(find_workcell(profile.workcell))
    pendant = "at the pendant"
    states = {
        "robot_mode": ("robot mode", messages.RUNNING_ROBOT_MODE, f"switch the robot on {pendant}"),
        "safety_mode": ("safety mode", messages.NORMAL_SAFETY_MODE, f"end the safety stop {pendant}"),
        "program_running": ("program", True, f"press play {pendant}, check its host address"),
        "speed_scaling": ("speed scaling", FULL_SPEED, f"push the slider to 100 % {pendant}"),
    }
    probes: dict[str, Callable[[], str]] = {"network": partial(network, survey)}
    for number, arm in enumerate(profile.all_status, start=1):
        for field, (name, wanted, fix) in states.items():
            if topic := arm.get(field):
                title = name if number == 1 else f"{name} of arm {number}"
                probes[title] = partial(state, survey, topic, wanted, fix)
    for part in profile.robots:
        age = float(limits.joints.position_age[part.ids].min())
        probes[f"joints of {part.name}"] = partial(joint_states, survey, part, age)
    probes["images"] = partial(images, survey, profile, limits.image_age)
    probes["lens"] = partial(lens, survey, profile.camera.info, camera)
    probes |= {f"commands to {part.name}": partial(commands, survey, part) for part in profile.robots}
    if not survey.is_heard:  # one line instead of one for each topic
        probes = {"network": probes["network"]}
    return [
        check("real-time priority", real_time, is_needed=not is_loopback),
        check("receive buffers", receive_buffers, is_needed=not is_loopback),
        *(check(name, probe, is_needed=True) for name, probe in probes.items()),
    ]
