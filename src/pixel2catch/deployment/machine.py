"""What the machine of a deployment must be set to, and how: probes that `doctor` runs. Nothing is changed."""

import os
import resource
import socket
from collections.abc import Mapping
from pathlib import Path

from pixel2catch.findings import Absent, Broken
from pixel2catch.ros2.dds import domain_id
from pixel2catch.servo.process import REAL_TIME_PRIORITY

GUIDE = "docs/laboratory.md, the computer"  #: Where the steps are.
LEAST_CORES = 4  #: For servo, policy, perception and drivers. Source: ours.
LEAST_BUFFER = 4_000_000
"""Bytes that may wait in a socket: four images. Source: ours, measured with 30 images a second."""

SPOKEN = ("", "rmw_cyclonedds_cpp", "rmw_fastrtps_cpp", "rmw_fastrtps_dynamic_cpp")
"""Values of RMW_IMPLEMENTATION whose messages plain DDS hears; the first is the default of ROS 2."""

LOCAL = {"ROS_LOCALHOST_ONLY": "1", "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
"""What keeps ROS 2 to its machine: drivers that were started so are not heard by plain DDS."""


def cores(root: Path = Path("/")) -> str:
    """How many cores this process may use, and which are kept free of others."""
    number = len(os.sched_getaffinity(0))
    path = root / "sys/devices/system/cpu/isolated"
    isolated = path.read_text().strip() if path.exists() else ""
    if number < LEAST_CORES:
        raise Broken(f"{number} cores; servo, policy, perception and drivers want {LEAST_CORES}")
    return f"{number} cores, isolated: {isolated or 'none'}"


def kernel(root: Path = Path("/")) -> str:
    """Whether the kernel is made for real time."""
    flag = root / "sys/kernel/realtime"
    if flag.exists() and flag.read_text().strip() == "1":
        return "PREEMPT_RT"
    raise Absent(f"no PREEMPT_RT: the servo's ticks may be late under load ({GUIDE})")


def real_time() -> str:
    """Whether the servo may ask for real-time scheduling: it is tried, and taken back."""
    before, parameters = os.sched_getscheduler(0), os.sched_getparam(0)
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(REAL_TIME_PRIORITY))
    except PermissionError:
        limit, _ = resource.getrlimit(resource.RLIMIT_RTPRIO)
        raise Broken(
            f"the limit rtprio is {limit}, the servo asks for priority {REAL_TIME_PRIORITY}: write "
            f"'@realtime - rtprio 99' into /etc/security/limits.conf, join that group, log in anew ({GUIDE})"
        ) from None
    os.sched_setscheduler(0, before, parameters)
    return f"priority {REAL_TIME_PRIORITY} of SCHED_FIFO is granted"


def governor(root: Path = Path("/")) -> str:
    """What chooses the clock of the cores."""
    paths = sorted(root.glob("sys/devices/system/cpu/cpu[0-9]*/cpufreq/scaling_governor"))
    if not paths:
        raise Absent("the system does not tell, as in virtual machines")
    found = sorted({path.read_text().strip() for path in paths})
    if found != ["performance"]:
        raise Broken(f"{', '.join(found)}: 'sudo cpupower frequency-set -g performance'")
    return "performance"


def receive_buffers(root: Path = Path("/")) -> str:
    """How much may wait in a socket until it is read."""
    size = int((root / "proc/sys/net/core/rmem_max").read_text())
    if size < LEAST_BUFFER:
        raise Broken(
            f"net.core.rmem_max is {size}, less than {LEAST_BUFFER}: images are lost. "
            "'sudo sysctl -w net.core.rmem_max=8388608', and the same into /etc/sysctl.d"
        )
    return f"net.core.rmem_max is {size}"


def dds_settings(is_loopback: bool, environment: Mapping[str, str] = os.environ) -> str:
    """What the environment says of the network; ROS_DOMAIN_ID must be that of the drivers."""
    domain = domain_id()
    middleware = environment.get("RMW_IMPLEMENTATION", "")
    if middleware not in SPOKEN:
        raise Broken(f"RMW_IMPLEMENTATION is {middleware}, which DDS does not hear: take {SPOKEN[1]}")
    if is_loopback:
        return f"domain {domain}, this machine only"
    kept = [f"{name}={value}" for name, value in LOCAL.items() if environment.get(name) == value]
    if kept:
        raise Broken(f"{kept[0]}: drivers started so keep to themselves; unset it for them and here")
    if configured := environment.get("CYCLONEDDS_URI"):
        return f"domain {domain}, CYCLONEDDS_URI {configured}"
    others = [name for _, name in socket.if_nameindex() if name != "lo"]
    if len(others) > 1:
        choice = f"Cyclone DDS takes one of {', '.join(others)}; name it in CYCLONEDDS_URI ({GUIDE})"
        return f"domain {domain}, no CYCLONEDDS_URI: {choice}"
    return f"domain {domain}, no CYCLONEDDS_URI"
