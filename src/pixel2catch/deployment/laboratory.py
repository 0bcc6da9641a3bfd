"""All that must be right before a robot is armed, in the order in which it is mended: for `doctor`.

What judges a survey of the network is a pure function: it says what it found, or raises `Broken` with what to
do.
"""

from collections.abc import Callable
from functools import partial
from math import inf, pi

import numpy as np
from numpy import ndarray

from pixel2catch.deployment import machine
from pixel2catch.deployment.image_subscriber import EARLIEST, other_lens
from pixel2catch.deployment.survey import Heard, Survey
from pixel2catch.findings import Absent, Broken, Check, check
from pixel2catch.ros2 import messages
from pixel2catch.ros2.profile import CameraProfile, Controller, Profile, RobotPart
from pixel2catch.ros2.transport import Endpoint, Topic
from pixel2catch.scene.constants import CONTROL_DT, CameraSpec
from pixel2catch.servo.limits import ServoLimits
from pixel2catch.workcells import find_workcell

RATE_SHARE = 0.95  #: Share of a driver's rate that must arrive. Source: ours.
MOST_RATE_SHARE = 1.5  #: Share of it that one driver cannot exceed. Source: ours.
CLOCK_ERROR = 0.02  #: How far clocks may be apart [s]. Source: training, docs/deployment.md.
LEAST_IMAGES = 10  #: Images that tell whether the exposure is constant.
MOST_CHANGE = 0.03  #: Share by which the brightness of a still scene may change. Source: ours.
TREND = 0.8  #: Correlation with the time from which a change is a drift. Source: ours.

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
"""By number, from -1 on. Source: `ur_dashboard_msgs/RobotMode`."""


def heard_of(survey: Survey, topic: Topic, most: float = 1) -> Heard:
    """What was said on a topic that so many publish at the most, by its type, and that could be read."""
    publishers = survey.publishers(topic)
    if not publishers:
        alike = survey.of_type(topic, is_publisher=True)
        hint = f"{topic.type} is published on {alike}" if alike else "nor any topic of that type"
        raise Broken(f"nobody publishes {topic.name}; {hint}: start the driver, or correct the profile")
    require_type(topic, publishers)
    if len(publishers) > most:
        raise Broken(f"{len(publishers)} publishers of {topic.name}: one may be; end the others")
    heard = survey.heard[topic]
    if not heard.readings:
        why = heard.errors[0] if heard.errors else "the network carries none: look at firewall and cables"
        raise Broken(f"no message on {topic.name}: {why}")
    return heard


def heard_anyway(survey: Survey, topic: Topic, most: float = 1) -> Heard:
    """The same for what needs messages of which another check says that they are missing."""
    try:
        return heard_of(survey, topic, most)
    except Broken as error:
        raise Absent(f"not looked at without good messages on {topic.name}") from error


def network(survey: Survey) -> str:
    """Whether anybody is on the network."""
    endpoints = survey.endpoints
    publishers = sum(each.is_publisher for each in endpoints)
    if not endpoints:
        raise Broken(
            "no other program is seen: compare ROS_DOMAIN_ID with the drivers', look at interface and "
            "firewall (UDP from 7400 on), and at ROS_LOCALHOST_ONLY where they were started"
        )
    return f"{publishers} publishers, {len(endpoints) - publishers} subscriptions of others"


def require_type(topic: Topic, endpoints: list[Endpoint]) -> None:
    """Refuse endpoints of other types."""
    types = sorted({each.type for each in endpoints})
    if types != [topic.type]:
        raise Broken(
            f"{topic.name} is of type {', '.join(types)}, the profile wants {topic.type}: correct it"
        )


def joint_states(survey: Survey, part: RobotPart, limits: ServoLimits) -> str:
    """Whether all joints of a part are heard, at the driver's rate and without pauses."""
    heard = heard_of(survey, part.state_topic, inf)
    wanted = {theirs.name_in_state for theirs in part.joints.values()}
    said = {name for reading in heard.readings for name in reading.names}
    if missing := sorted(wanted - said):
        raise Broken(
            f"{part.state_topic.name} lacks {', '.join(missing)}; it has {', '.join(sorted(said))}: correct "
            "name_in_state in the profile, or the driver's prefix"
        )
    own = [place for place, reading in enumerate(heard.readings) if wanted & set(reading.names)]
    stamps = np.array([heard.readings[place].stamp for place in own])
    arrivals = np.array([heard.arrivals[place] for place in own])
    age = float(limits.joints.position_age[part.ids].min())
    hint = "see the driver's update_rate, cables, processor load"
    return f"{len(wanted)} joints, {require_rate(stamps, arrivals, part.rate_hz, age, hint)}"


def require_rate(stamps: ndarray, arrivals: ndarray, rate: float, age: float, hint: str) -> str:
    """Refuse fewer or more messages in a second [Hz], and pauses longer than an age that is a fault [s]."""
    times = np.unique(stamps)
    if len(times) < 3:
        raise Broken(
            f"{len(times)} different stamps: the driver stands still, or does not stamp its messages"
        )
    found = (len(times) - 1) / (times[-1] - times[0])
    pause, jitter = np.diff(arrivals).max(), np.diff(arrivals).std()
    said = f"{found:.1f} Hz, jitter {1e3 * jitter:.1f} ms, longest pause {1e3 * pause:.0f} ms"
    if found < RATE_SHARE * rate:
        raise Broken(f"{said}: {rate:g} Hz are needed; {hint}")
    if found > MOST_RATE_SHARE * rate:
        raise Broken(f"{said}: {rate:g} Hz are expected; do two drivers say the same?")
    if pause > age:
        raise Broken(f"{said}: the servo stops after {1e3 * age:.0f} ms; free the processor, use a cable")
    return said


def images(survey: Survey, camera: CameraProfile, limits: ServoLimits) -> str:
    """Whether images come in the right size, encoding and rate."""
    heard = heard_of(survey, camera.image)
    if heard.errors:
        raise Broken(heard.errors[-1])
    stamps = np.array([reading.stamp for reading in heard.readings])
    hint = "expose for less than 33 ms, take another USB 3 port, look at the processor's load"
    rate = require_rate(stamps, np.array(heard.arrivals), 1.0 / CONTROL_DT, limits.image_age, hint)
    return f"{camera.width} x {camera.height} {camera.encoding}, {rate}"


def exposure(survey: Survey, camera: CameraProfile) -> str:
    """Whether images of a still scene stay equally bright in every colour."""
    readings = heard_anyway(survey, camera.image).readings
    if len(readings) < LEAST_IMAGES:
        raise Absent(f"{len(readings)} images are too few to tell")
    brightness = np.array([reading.brightness for reading in readings])
    mean = brightness.mean(axis=0)
    change = np.ptp(brightness, axis=0) / np.maximum(mean, 1.0)
    said = f"brightness {mean.mean():.0f} of 255, changes by {100.0 * change.max():.1f} %"
    if change.max() <= MOST_CHANGE:
        return said
    course = brightness[:, change.argmax()]
    if abs(np.corrcoef(course, np.arange(len(course)))[0, 1]) > TREND:
        raise Broken(f"{said}, in one direction: turn automatic exposure and white balance off")
    raise Broken(
        f"{said}, up and down: if nothing moved in the image, lamps flicker; expose for 10 ms at 50 Hz of "
        "mains, 8.3 ms at 60 Hz, or use lamps with direct current"
    )


def lens(survey: Survey, camera: CameraProfile, known: CameraSpec) -> str:
    """Whether the camera's lens and size are those of a calibration."""
    if camera.info is None:
        raise Absent("the profile has no topic for it")
    found = heard_of(survey, camera.info).readings[-1].camera
    if (found.width, found.height) != (camera.width, camera.height):
        raise Broken(
            f"{camera.info.name} is of {found.width} x {found.height}, the profile says {camera.width} x "
            f"{camera.height}: set the camera's driver to that"
        )
    if difference := other_lens(found, known):
        raise Broken(difference)
    return f"fx {found.fx:.1f}, fy {found.fy:.1f}, cx {found.cx:.1f}, cy {found.cy:.1f}, as calibrated"


def clocks(survey: Survey, profile: Profile, limits: ServoLimits) -> str:
    """Whether stamps are of the clock of this machine; the shortest ways tell the offset."""
    said = []
    bounds = {part.state_topic: (-CLOCK_ERROR, CLOCK_ERROR) for part in profile.robots}
    bounds[profile.camera.image] = (EARLIEST, limits.image_age)
    for topic, (earliest, latest) in bounds.items():
        heard = heard_anyway(survey, topic, 1 if topic == profile.camera.image else inf)
        ages = np.array(heard.arrivals) - [reading.stamp for reading in heard.readings]
        age = float(np.quantile(ages, 0.1))
        said.append(f"{topic.name} {1e3 * age:.1f} ms")
        if not earliest <= age <= latest:
            raise Broken(
                f"{said[-1]} old when it arrives, by its stamps; from {1e3 * earliest:.0f} to "
                f"{1e3 * latest:.0f} ms can be: synchronise the machines (chrony or PTP), and have the "
                "driver write the time of measurement into header.stamp"
            )
    return f"ages at arrival: {', '.join(said)}"


def speed_scaling(survey: Survey, topic: Topic) -> str:
    """Whether the robot runs at its full speed."""
    percent = heard_of(survey, topic).readings[-1]
    if percent < 99.95:
        raise Broken(f"{percent:.1f} %: push the slider on the pendant to 100 %, let the program run")
    return f"{percent:.0f} %"


def mode(survey: Survey, topic: Topic, wanted: int, names: tuple[str, ...], first: int = 0) -> str:
    """Whether the robot is in a mode, by its number and the names of all, from the first number on."""
    found = heard_of(survey, topic).readings[-1]
    said = f"{names[found - first] if 0 <= found - first < len(names) else 'unknown'} ({found})"
    if found != wanted:
        raise Broken(f"{said}, not {names[wanted - first]}: mend it at the pendant")
    return said


def program_running(survey: Survey, topic: Topic) -> str:
    """Whether the driver's program runs on the robot."""
    if not heard_of(survey, topic).readings[-1]:
        raise Broken("External Control does not run: press play on the pendant, look at its host address")
    return "External Control runs"


def commands(survey: Survey, part: RobotPart) -> str:
    """Whether one driver takes the commands of a part, and nobody sends any."""
    topic = part.command_topic
    takers, senders = survey.subscriptions(topic), survey.publishers(topic)
    if senders:
        raise Broken(f"{len(senders)} other publishers of {topic.name}: end that program before arming")
    if not takers:
        alike = survey.of_type(topic, is_publisher=False)
        hint = f"; {topic.type} is taken on {alike}" if alike else ""
        raise Broken(f"nobody takes {topic.name}{hint}: load the controller, or correct the profile")
    require_type(topic, takers)
    if len(takers) > 1:
        raise Broken(f"{len(takers)} subscribers of {topic.name}: one driver may take it; end the others")
    return f"{topic.name}: one driver, no other publisher"


def controller(survey: Survey, wanted: Controller) -> str:
    """Whether the controller that takes the commands is active, as it is from homing on."""
    if wanted.name not in heard_of(survey, wanted.activity).readings[-1]:
        raise Absent(
            f"{wanted.name} is not active: switch to it when the arm is at its start pose, before arming"
        )
    return f"{wanted.name} is active"


def poses(survey: Survey, part: RobotPart, home: ndarray, near: ndarray) -> str:
    """How far a part is from the pose in which it may be armed; joints in joint order [rad]."""
    joint_pos = np.full(len(home), np.nan)
    for reading in heard_anyway(survey, part.state_topic, inf).readings:
        part.merge(reading, joint_pos)
    away = np.abs(joint_pos - home)[part.ids]
    if np.isnan(away).any():
        raise Absent("not looked at without all joints")
    far = [
        f"{joint} {value * 180.0 / pi:.0f}°"
        for joint, value, most in zip(part.joints, away, near[part.ids], strict=True)
        if value > most
    ]
    if far:
        raise Absent(f"away from the start pose: {', '.join(far)}; home it before arming")
    return "at the start pose"


def checks_of_laboratory(
    profile: Profile, survey: Survey, known: CameraSpec, *, is_loopback: bool
) -> list[Check]:
    """What is found on this machine and on the network; real time does not matter beside a twin."""
    limits = ServoLimits.of(find_workcell(profile.workcell))
    settings: dict[str, Callable[[], str]] = {
        "cores": machine.cores,
        "kernel": machine.kernel,
        "real-time priority": machine.real_time,
        "ticks": partial(machine.ticks, limits),
        "CPU governor": machine.governor,
        "receive buffers": machine.receive_buffers,
    }
    found = [check(name, probe, is_needed=not is_loopback) for name, probe in settings.items()]
    judged = {
        "DDS settings": partial(machine.dds_settings, is_loopback),
        **_of_network(profile, survey, known, limits),
    }
    return found + [check(name, probe, is_needed=True) for name, probe in judged.items()]


def _of_network(
    profile: Profile, survey: Survey, known: CameraSpec, limits: ServoLimits
) -> dict[str, Callable[[], str]]:
    """What to judge of a survey, by name."""
    home = np.array([joint.home for joint in find_workcell(profile.workcell).joints])
    status, camera, robots = profile.status, profile.camera, profile.robots
    said = (
        (
            "robot mode",
            partial(mode, wanted=messages.RUNNING_ROBOT_MODE, names=ROBOT_MODES, first=-1),
            status.robot_mode,
        ),
        (
            "safety mode",
            partial(mode, wanted=messages.NORMAL_SAFETY_MODE, names=SAFETY_MODES),
            status.safety_mode,
        ),
        ("program", program_running, status.program_running),
        ("speed scaling", speed_scaling, status.speed_scaling),
    )
    probes: dict[str, Callable[[], str]] = {"network": partial(network, survey)}
    probes |= {name: partial(probe, survey, topic) for name, probe, topic in said if topic}
    probes |= {f"joints of {part.name}": partial(joint_states, survey, part, limits) for part in robots}
    probes["images"] = partial(images, survey, camera, limits)
    probes["exposure"] = partial(exposure, survey, camera)
    probes["lens"] = partial(lens, survey, camera, known)
    probes["clocks"] = partial(clocks, survey, profile, limits)
    probes |= {f"commands to {part.name}": partial(commands, survey, part) for part in robots}
    controllers = {part.name: part.controller for part in robots if part.controller}
    probes |= {f"controller of {n}": partial(controller, survey, c) for n, c in controllers.items()}
    near = limits.joints.start_error
    probes |= {f"pose of {part.name}": partial(poses, survey, part, home, near) for part in robots}
    return probes
