"""All that must be right before a robot is armed, in the order in which it is mended: for `doctor`."""

from collections.abc import Callable
from functools import partial

import numpy as np

from pixel2catch.deployment import machine
from pixel2catch.deployment import survey_checks as judge
from pixel2catch.deployment.survey import Survey
from pixel2catch.findings import Check, check
from pixel2catch.ros2.profile import Profile
from pixel2catch.scene.constants import CameraSpec
from pixel2catch.servo.limits import ServoLimits
from pixel2catch.workcells import find_workcell


def checks_of_laboratory(
    profile: Profile, survey: Survey, lens: CameraSpec, *, is_loopback: bool
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
    network = {
        "DDS settings": partial(machine.dds_settings, is_loopback),
        **_of_network(profile, survey, lens, limits),
    }
    return found + [check(name, probe, is_needed=True) for name, probe in network.items()]


def _of_network(
    profile: Profile, survey: Survey, lens: CameraSpec, limits: ServoLimits
) -> dict[str, Callable[[], str]]:
    """What to judge of a survey, by name."""
    home = np.array([joint.home for joint in find_workcell(profile.workcell).joints])
    status, camera, robots = profile.status, profile.camera, profile.robots
    said = (
        ("robot mode", judge.robot_mode, status.robot_mode),
        ("safety mode", judge.safety_mode, status.safety_mode),
        ("program", judge.program_running, status.program_running),
        ("speed scaling", judge.speed_scaling, status.speed_scaling),
    )
    probes: dict[str, Callable[[], str]] = {"network": partial(judge.network, survey)}
    probes |= {name: partial(probe, survey, topic) for name, probe, topic in said if topic}
    probes |= {f"joints of {part.name}": partial(judge.joint_states, survey, part, limits) for part in robots}
    probes["images"] = partial(judge.images, survey, camera, limits)
    probes["exposure"] = partial(judge.exposure, survey, camera)
    probes["lens"] = partial(judge.lens, survey, camera, lens)
    probes["clocks"] = partial(judge.clocks, survey, profile, limits)
    probes |= {f"commands to {part.name}": partial(judge.commands, survey, part) for part in robots}
    controllers = {part.name: part.controller for part in robots if part.controller}
    probes |= {f"controller of {n}": partial(judge.controller, survey, c) for n, c in controllers.items()}
    near = limits.joints.start_error
    probes |= {f"pose of {part.name}": partial(judge.poses, survey, part, home, near) for part in robots}
    return probes
