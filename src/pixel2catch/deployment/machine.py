"""Checks of this machine for `doctor --robot`: settings that a deployment needs. They change nothing."""

import os
import resource
from collections.abc import Mapping
from pathlib import Path

from pixel2catch.findings import Absent, Broken
from pixel2catch.ros2.dds import domain_id
from pixel2catch.ros2.transport import RealClock
from pixel2catch.servo.limits import ServoLimits
from pixel2catch.servo.link import SERVO_PRIORITY, scheduled

GUIDE = "docs/laboratory.md"  #: Page with the steps.
LEAST_BUFFER = 4_000_000  #: Least receive buffer of a socket [bytes]: four images. Source: ours.
NUM_TICKS = 500  #: Ticks of the servo that are timed: a second.

MIDDLEWARE = ("", "rmw_cyclonedds_cpp", "rmw_fastrtps_cpp", "rmw_fastrtps_dynamic_cpp")
"""Values of RMW_IMPLEMENTATION that plain DDS can receive from; the first is the default of ROS 2."""

ROS_ON_LOOPBACK = {"ROS_LOCALHOST_ONLY": "1", "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
"""Settings that limit ROS 2 to this machine, the older one first."""


def kernel(root: Path = Path("/")) -> str:
    """Check that the kernel is a real-time kernel."""
    flag = root / "sys/kernel/realtime"
    if flag.exists() and flag.read_text().strip() == "1":
        return "PREEMPT_RT"
    raise Absent(f"no PREEMPT_RT: the servo's ticks may be late under load ({GUIDE})")


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


def ticks(limits: ServoLimits) -> str:
    """Check how late this process wakes up at the servo's rate, with its priority if that is granted."""
    clock, worst = RealClock(), 0.0
    with scheduled(os.SCHED_FIFO, SERVO_PRIORITY):
        due = clock.now()
        for _ in range(NUM_TICKS):
            due += limits.dt
            clock.sleep_until(due)
            worst = max(worst, clock.now() - due)
            due = max(due, clock.now() - limits.dt)
    measured = f"of {NUM_TICKS} ticks of {1e3 * limits.dt:g} ms the latest came {1e3 * worst:.2f} ms late"
    if worst > limits.tick_age / 2.0:
        stop = f"the servo stops at {1e3 * limits.tick_age:g} ms"
        raise Broken(f"{measured}, {stop}: end other programs ({GUIDE})")
    return measured


def receive_buffers(root: Path = Path("/")) -> str:
    """Check the largest receive buffer of a socket."""
    path = root / "proc/sys/net/core/rmem_max"
    if not path.exists():
        raise Absent("the system does not show it, as in containers")
    size = int(path.read_text())
    if size < LEAST_BUFFER:
        raise Broken(
            f"net.core.rmem_max is {size}, less than {LEAST_BUFFER}: images are lost. "
            "'sudo sysctl -w net.core.rmem_max=8388608', and the same into /etc/sysctl.d"
        )
    return f"net.core.rmem_max is {size}"


def dds_settings(
    is_loopback: bool, environment: Mapping[str, str] = os.environ, root: Path = Path("/")
) -> str:
    """Check the environment variables of the network; ROS_DOMAIN_ID must be the drivers'."""
    domain, middleware = domain_id(), environment.get("RMW_IMPLEMENTATION", "")
    if middleware not in MIDDLEWARE:
        raise Broken(f"RMW_IMPLEMENTATION is {middleware}, which DDS cannot receive: use {MIDDLEWARE[1]}")
    if is_loopback:
        return f"domain {domain}, this machine only"
    kept = [f"{name}={value}" for name, value in ROS_ON_LOOPBACK.items() if environment.get(name) == value]
    if kept:
        raise Broken(f"{kept[0]}: drivers with this setting stay on their machine; unset it there and here")
    if configured := environment.get("CYCLONEDDS_URI"):
        return f"domain {domain}, CYCLONEDDS_URI {configured}"
    states = sorted(root.glob("sys/class/net/*/operstate"))
    names = [path.parent.name for path in states if path.read_text().strip() == "up"]
    if len(names) > 1:
        choice = f"Cyclone DDS takes one of {', '.join(names)}; name it in CYCLONEDDS_URI ({GUIDE})"
        return f"domain {domain}, no CYCLONEDDS_URI: {choice}"
    return f"domain {domain}, no CYCLONEDDS_URI"
