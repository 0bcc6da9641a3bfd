"""Checks of `doctor --robot` on the twin in stepped time, and without a laboratory."""

import json
import os
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from domains import own_domain
from pixel2catch.cli.doctor import Doctor
from pixel2catch.cli.main import main
from pixel2catch.deployment import machine
from pixel2catch.deployment.control_loop import StepClock
from pixel2catch.deployment.laboratory import Survey, checks_of_laboratory
from pixel2catch.envs.cfg import CatchEnvCfg
from pixel2catch.findings import Absent, Broken, Check
from pixel2catch.ros2 import messages
from pixel2catch.ros2.memory import Broker
from pixel2catch.ros2.profile import DriverJoint, Profile
from pixel2catch.ros2.transport import Topic
from pixel2catch.scene.constants import RGB_CAMERA
from pixel2catch.servo.limits import ServoLimits
from pixel2catch.twin.drivers import CameraDriver
from pixel2catch.twin.lab_node import LabNode
from pixel2catch.twin.simulated_lab import SimulatedLab
from pixel2catch.workcells import find_workcell

PROFILE = Profile.load("ur5e_allegro_v4")
IMAGE = PROFILE.camera.image
CYCLES = 300  #: 0.6 s: 18 images.
GREY = np.full((480, 640, 3), 120, dtype=np.uint8)
OF_MACHINE = {"kernel", "real-time priority", "ticks", "receive buffers"}


class Laboratory:
    """The twin in memory, with a camera that shows what a function of the image's number says."""

    def __init__(self) -> None:
        self.broker, self.clock = Broker(), StepClock(lambda _: None)
        self.lab, self.late = SimulatedLab(CatchEnvCfg(), seed=0), 0.0
        self.picture: Callable[[int], np.ndarray] = lambda _: GREY
        self._number = 0
        node = self.broker.node(self.clock)
        self._lab_node = LabNode(self.lab, PROFILE, node, CameraDriver(self._draw))

    def _draw(self, _: object) -> "Future[np.ndarray]":
        self._number += 1
        drawn: Future[np.ndarray] = Future()
        drawn.set_result(self.picture(self._number))
        return drawn

    def examine(self, profile: Profile = PROFILE, cycles: int = CYCLES) -> dict[str, Check]:
        """What is found after so many cycles of 2 ms, by name."""
        with self.broker.node(self.clock) as node:
            survey = Survey(node, profile, self.clock)
            for number in range(cycles):
                self.clock.time = self._lab_node.time
                self._lab_node.cycle(-self.late)
                if number % 50 == 49:
                    survey.listen()
            survey.listen()
            found = checks_of_laboratory(profile, survey, RGB_CAMERA, is_loopback=True)
        return {each.name: each for each in found}


@pytest.fixture(scope="module")
def shared() -> Iterator[Laboratory]:
    laboratory = Laboratory()
    yield laboratory
    laboratory.lab.close()


@pytest.fixture
def laboratory(shared: Laboratory, monkeypatch: pytest.MonkeyPatch) -> Iterator[Laboratory]:
    monkeypatch.setattr(machine, "NUM_TICKS", 5)
    yield shared
    shared.late, shared.picture = 0.0, lambda _: GREY


def bad(checks: dict[str, Check]) -> set[str]:
    """Names of what is needed and wrong."""
    return {name for name, each in checks.items() if each.is_needed and each.state == "BAD"}


def test_the_twin_is_ready_and_nothing_is_sent(laboratory: Laboratory):
    before = laboratory.broker.nodes[:]
    checks = laboratory.examine()
    assert bad(checks) == set()
    assert {name for name, each in checks.items() if not each.is_needed} == OF_MACHINE
    assert checks["joints of arm"].found.startswith("6 joints, 500.0 Hz")
    assert checks["joints of hand"].found.startswith("13 joints, 100.0 Hz")
    assert checks["images"].found.startswith("640 x 480 rgb8, 30.0 Hz")
    assert checks["exposure"].found == "brightness 120 of 255, changes by 0.0 %"
    assert checks["safety mode"].found == "normal (1)"
    assert laboratory.broker.nodes == before
    assert not any(node.publishers for node in laboratory.broker.nodes[1:])


def flickering(number: int) -> np.ndarray:
    return GREY + np.uint8(20 * (number % 3 == 0))


def drifting(number: int) -> np.ndarray:
    return np.full_like(GREY, min(60 + number % 90, 255))


@pytest.mark.parametrize(
    ("picture", "name", "words"),
    [
        (flickering, "exposure", "lamps flicker"),
        (drifting, "exposure", "automatic exposure and white balance off"),
        (lambda _: GREY[:240, :320], "images", "320 x 240 rgb8, the profile says 640 x 480"),
    ],
)
def test_what_is_wrong_with_images_is_named(
    laboratory: Laboratory, picture: Callable[[int], np.ndarray], name: str, words: str
):
    laboratory.examine(cycles=100)  # what was under way
    laboratory._number, laboratory.picture = 0, picture
    laboratory.examine(cycles=40)
    checks = laboratory.examine()
    assert words in checks[name].found
    assert name in bad(checks)


def test_a_missing_camera_is_named_and_what_there_is(laboratory: Laboratory):
    other = replace(PROFILE.camera, image=replace(IMAGE, name="/camera/color/image_raw"))
    checks = laboratory.examine(replace(PROFILE, camera=other))
    assert bad(checks) == {"images"}
    assert checks["exposure"].state == checks["clocks"].state == "absent"
    assert "nobody publishes /camera/color/image_raw" in checks["images"].found
    assert f"{IMAGE.type} is published on {IMAGE.name}" in checks["images"].found


def test_other_publishers_and_drivers_are_named(laboratory: Laboratory):
    arm, hand = PROFILE.robots
    with laboratory.broker.node(laboratory.clock) as node:
        node.publisher(arm.command_topic)
        node.subscription(hand.command_topic)
        checks = laboratory.examine(cycles=CYCLES)
    assert bad(checks) == {"commands to arm", "commands to hand"}
    assert "1 other publishers of /forward_position_controller/commands" in checks["commands to arm"].found
    assert checks["commands to hand"].found.startswith("2 subscribers")


def test_a_driver_that_takes_no_commands_is_named(laboratory: Laboratory):
    arm, hand = PROFILE.robots
    elsewhere = replace(hand, command_topic=replace(hand.command_topic, name="/hand/commands"))
    checks = laboratory.examine(replace(PROFILE, robots=(arm, elsewhere)))
    assert bad(checks) == {"commands to hand"}
    assert "nobody receives /hand/commands" in checks["commands to hand"].found
    assert "/allegro_hand_position_controller/commands" in checks["commands to hand"].found


def test_joints_that_are_called_otherwise_are_named(laboratory: Laboratory):
    arm, hand = PROFILE.robots
    elbow = DriverJoint(name_in_state="left_elbow_joint", index_in_command=2)
    prefixed = replace(arm, joints={**arm.joints, "elbow_joint": elbow})
    found = laboratory.examine(replace(PROFILE, robots=(prefixed, hand)))["joints of arm"].found
    assert "lacks left_elbow_joint; it has " in found
    assert ", elbow_joint" in found


def test_a_driver_that_is_too_slow_is_named(laboratory: Laboratory):
    arm, hand = PROFILE.robots
    checks = laboratory.examine(replace(PROFILE, robots=(arm, replace(hand, rate_hz=333.0))))
    assert bad(checks) == {"joints of hand"}
    assert "100.0 Hz" in checks["joints of hand"].found
    assert "333 Hz are needed" in checks["joints of hand"].found


def test_a_clock_that_is_off_is_named(laboratory: Laboratory):
    laboratory.late = -0.2
    checks = laboratory.examine()
    assert bad(checks) == {"clocks"}
    assert "/joint_states -200.0 ms old" in checks["clocks"].found


def test_a_robot_that_was_stopped_is_named(laboratory: Laboratory):
    requests = laboratory.broker.node(laboratory.clock)
    say = requests.publisher(Topic(name="/twin/command", type=messages.TEXT))
    laboratory.examine(cycles=1)
    say.publish(messages.text('{"do": "protective_stop"}'))
    checks = laboratory.examine()
    assert bad(checks) == {"safety mode", "program", "speed scaling"}
    assert "protective stop (3), not normal" in checks["safety mode"].found
    assert "press play" in checks["program"].found
    say.publish(messages.text('{"do": "resume"}'))
    assert bad(laboratory.examine()) == set()
    requests.close()


def settings(root: Path, buffer: int, realtime: str) -> Path:
    (root / "sys/kernel").mkdir(parents=True)
    (root / "sys/kernel/realtime").write_text(realtime + "\n")
    (root / "proc/sys/net/core").mkdir(parents=True)
    (root / "proc/sys/net/core/rmem_max").write_text(f"{buffer}\n")
    return root


def test_a_machine_that_is_set_up_and_one_that_is_not(tmp_path: Path):
    good = settings(tmp_path / "good", 8_388_608, "1")
    assert machine.kernel(good) == "PREEMPT_RT"
    assert machine.receive_buffers(good) == "net.core.rmem_max is 8388608"
    poor = settings(tmp_path / "poor", 212_992, "0")
    with pytest.raises(Absent, match="no PREEMPT_RT"):
        machine.kernel(poor)
    with pytest.raises(Broken, match=r"212992, less than 4000000: images are lost. 'sudo sysctl"):
        machine.receive_buffers(poor)
    with pytest.raises(Absent, match="the system does not show it"):
        machine.receive_buffers(tmp_path)


def test_settings_of_the_network_are_read(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    monkeypatch.setenv("ROS_DOMAIN_ID", "7")
    for name, state in (("eth0", "up"), ("eth1", "up"), ("lo", "unknown"), ("wlan0", "down")):
        (tmp_path / "sys/class/net" / name).mkdir(parents=True)
        (tmp_path / "sys/class/net" / name / "operstate").write_text(state + "\n")
    assert machine.dds_settings(True, {}) == "domain 7, this machine only"
    assert machine.dds_settings(False, {}).startswith("domain 7, no CYCLONEDDS_URI")
    assert "takes one of eth0, eth1; name it" in machine.dds_settings(False, {}, tmp_path)
    assert "file:///x.xml" in machine.dds_settings(False, {"CYCLONEDDS_URI": "file:///x.xml"})
    with pytest.raises(Broken, match="rmw_zenoh_cpp, which DDS cannot receive"):
        machine.dds_settings(False, {"RMW_IMPLEMENTATION": "rmw_zenoh_cpp"})
    with pytest.raises(Broken, match="ROS_LOCALHOST_ONLY=1: drivers"):
        machine.dds_settings(False, {"ROS_LOCALHOST_ONLY": "1"})


def test_ticks_are_timed_against_what_stops_the_servo(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(machine, "NUM_TICKS", 20)
    limits = ServoLimits.of(find_workcell(PROFILE.workcell))
    before = os.sched_getscheduler(0)
    assert machine.ticks(replace(limits, tick_age=60.0)).startswith("of 20 ticks of 2 ms the latest came")
    with pytest.raises(Broken, match=r"ms late, the servo stops at 0\.001 ms: end other programs"):
        machine.ticks(replace(limits, tick_age=1e-6))
    assert os.sched_getscheduler(0) == before


def test_without_a_robot_all_is_missing(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    monkeypatch.setenv("ROS_DOMAIN_ID", own_domain())
    monkeypatch.setattr("pixel2catch.deployment.laboratory.DISCOVERY", 0.1)
    monkeypatch.setattr(Doctor, "_checks", lambda self: [])  # tests/cli/test_doctor.py has them
    with pytest.raises(SystemExit, match="1"):
        main(["doctor", "--robot", "ur5e_allegro_v4", "--json"])
    checks = {each["name"]: each for each in json.loads(capsys.readouterr().out)["checks"]}
    assert "nobody publishes /joint_states; nor any topic of that type" in checks["joints of arm"]["found"]
    assert checks["DDS settings"]["state"] == "good"
    assert {checks[name]["state"] for name in ("exposure", "clocks", "pose of arm")} == {"absent"}
