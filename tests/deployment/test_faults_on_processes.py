"""Twenty-one more things that go wrong, done to real processes over DDS, one after the other.

`test_servo_faults` and `test_faults` have more of them, in stepped time.
"""

import os
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from camera_lab import CameraLab
from process_lab import ARM, PROFILE, Watcher

from domains import own_domain
from pixel2catch.errors import DeploymentError
from pixel2catch.ros2 import messages
from pixel2catch.ros2.factory import make_transport
from pixel2catch.ros2.transport import LOOPBACK, RealClock, Topic, Transport
from pixel2catch.servo.limits import STOP_TIME

RATE = 0.1
MOST_TRIES = 8
HAND = PROFILE.robots[1].command_topic
STATES = PROFILE.robots[0].state_topic
Inject = Callable[[Watcher], None]


def stranger(watcher: Watcher, name: str = "stranger") -> Transport:
    """A node of somebody else, until all is well again."""
    return watcher.guests.enter_context(make_transport("dds", name, LOOPBACK, watcher.clock))


def announces(topic: Topic) -> Inject:
    """Somebody else announces a topic, and says nothing on it."""
    return lambda watcher: stranger(watcher).publisher(topic) and None


def listens(topic: Topic) -> Inject:
    """Somebody else takes the robot's commands."""
    return lambda watcher: stranger(watcher).subscription(topic) and None


def told(change: Callable[[CameraLab], object]) -> Inject:
    """Something changes in the laboratory."""
    return lambda watcher: watcher.say(change)


def lying(lab: CameraLab, joint: str, value: float, *, is_offset: bool = False) -> None:
    """A joint is measured where it is not."""

    def lie(reading: messages.JointReading) -> messages.JointReading:
        position = reading.position.copy()
        for place, name in enumerate(reading.names):
            if name == joint:
                position[place] = value + position[place] * is_offset
        return replace(reading, position=position)

    lab.change = lie


def junk(lab: CameraLab) -> None:
    """Bytes that mean nothing, on every topic of the laboratory; then no joint states."""
    random = np.random.default_rng(0)
    for topic in lab.topics:
        for size in (0, 4, 12, 50, 4000):
            with suppress(DeploymentError):  # DDS itself does not send all of it
                lab.say(topic, b"\x00\x01\x00\x00" + random.bytes(size))
    lab.silent.update(("arm", "hand"))


def scaling(lab: CameraLab, percent: float) -> None:
    lab.speed = percent


def says(lab: CameraLab, name: str, data: bytes) -> None:
    """The driver says something of itself."""
    lab.say(getattr(PROFILE.status, name), data)


def inactive(lab: CameraLab) -> None:
    """The controller was switched."""
    for part in PROFILE.robots:
        if part.controller:
            lab.say(part.controller.activity, messages.activity({part.controller.name: 2}, 0.0))


def silent(lab: CameraLab, name: str) -> None:
    lab.silent.add(name)


def from_the_future(lab: CameraLab) -> None:
    lab.age = -1.0


@contextmanager
def asleep(pid: int) -> Iterator[None]:
    """A process is held up."""
    os.kill(pid, signal.SIGSTOP)
    try:
        yield
    finally:
        os.kill(pid, signal.SIGCONT)


def children(pid: int) -> list[int]:
    return [int(child) for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


def loop_hangs(watcher: Watcher) -> None:
    """The control loop is held up for a second of the clock."""
    with asleep(watcher.deploy.pid):
        time.sleep(1.0 / RATE)


def servo_hangs(watcher: Watcher) -> None:
    """The servo process is held up for 50 ms of the clock."""
    (servo,) = (pid for pid in children(watcher.deploy.pid) if b"spawn_main" in command_line(pid))
    with asleep(servo):
        time.sleep(0.05 / RATE)


def command_line(pid: int) -> bytes:
    return Path(f"/proc/{pid}/cmdline").read_bytes()


ELBOW, FINGER = "elbow_joint", PROFILE.robots[1].joints[next(iter(PROFILE.robots[1].joints))].name_in_state
FAULTS: dict[str, tuple[Inject, set[str]]] = {
    "somebody announces commands of the arm": (announces(ARM), {"other publisher"}),
    "somebody announces commands of the hand": (announces(HAND), {"other publisher"}),
    "a second switch": (announces(PROFILE.operator.dead_man), {"other operator"}),
    "a second program that arms": (announces(PROFILE.operator.arm), {"other operator"}),
    "a second driver of the arm": (listens(ARM), {"other subscriber"}),
    "a second camera": (announces(PROFILE.camera.image), {"perception unsound"}),
    "an elbow 0.1 rad off": (
        told(partial(lying, joint=ELBOW, value=0.1, is_offset=True)),
        {"tracking error"},
    ),
    "a finger at 100 rad": (told(partial(lying, joint=FINGER, value=100.0)), {"joints implausible"}),
    "a finger at 1e308 rad": (told(partial(lying, joint=FINGER, value=1e308)), {"joints implausible"}),
    "joints that repeat themselves": (told(CameraLab.repeat), {"joints frozen", "tracking error"}),
    "junk on every topic": (told(junk), {"joints stale", "safety mode", "stop request"}),
    "speed scaling without end": (told(partial(scaling, percent=np.inf)), {"speed scaling"}),
    "speed scaling falls silent": (
        told(partial(silent, name=PROFILE.status.speed_scaling.name)),  # type: ignore[union-attr]
        {"status unknown"},
    ),
    "emergency stop": (
        told(partial(says, name="safety_mode", data=messages.safety_mode(7))),
        {"safety mode"},
    ),
    "robot switched off": (
        told(partial(says, name="robot_mode", data=messages.robot_mode(3))),
        {"safety mode"},
    ),
    "another controller": (told(inactive), {"controller"}),
    "images of the future": (told(from_the_future), {"image stale", "perception unsound"}),
    "no images": (told(partial(silent, name="camera")), {"image stale"}),
    "the switch falls silent": (told(partial(silent, name=PROFILE.operator.dead_man.name)), {"dead man"}),
    "the control loop hangs": (loop_hangs, {"policy late", "image stale"}),
    "the servo hangs": (servo_hangs, {"clock"}),
}
"""What goes wrong, and the reasons of which one at least is given."""


@pytest.fixture(scope="module")
def watcher(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Watcher]:
    with ExitStack() as stack:
        stack.enter_context(pytest.MonkeyPatch.context()).setenv("ROS_DOMAIN_ID", own_domain())
        clock = RealClock(RATE)
        node = stack.enter_context(make_transport("dds", "watcher", LOOPBACK, clock))
        yield Watcher(node, clock, stack, tmp_path_factory.mktemp("processes"))


@pytest.mark.slow
@pytest.mark.parametrize("fault", FAULTS)
def test_it_stops_the_robot_which_goes_on_when_it_is_mended(fault: str, watcher: Watcher):
    """The reason is given, commands stand still, nobody has ended. On a busy machine it is tried again."""
    (inject, reasons), found = FAULTS[fault], list[set[str]]()
    while not (found and reasons & found[-1]):
        assert len(found) < MOST_TRIES, found
        watcher.guests.close()
        watcher.arm(("armed",))
        watcher.say("point")
        watcher.until(lambda: watcher.status["mode"] in ("run", "stopped"))
        inject(watcher)
        watcher.until(lambda: watcher.status["mode"] == "stopped")
        found.append(set(watcher.status["stopped_by"]))
    watcher.rest(2.0 * STOP_TIME)
    if "other publisher" in watcher.status["stopped_by"]:
        last = watcher.commands[-1][0]
        watcher.rest(STOP_TIME)
        assert watcher.commands[-1][0] == last, "it fights somebody else"
    else:
        stands = np.array([command for _, command in watcher.commands[-5:]])
        np.testing.assert_allclose(stands - stands[-1], 0.0, atol=1e-9)
    assert watcher.deploy.poll() is None
    watcher.guests.close()
    watcher.arm()
