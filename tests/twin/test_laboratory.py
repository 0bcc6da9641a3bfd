"""Checks of `doctor --robot` on the twin in stepped time, and without a laboratory."""

import json
import re
from collections.abc import Iterator
from concurrent.futures import Future
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from domains import own_domain
from pixel2catch.cli.doctor import Doctor
from pixel2catch.cli.main import main
from pixel2catch.deployment.control_loop import StepClock
from pixel2catch.deployment.laboratory import Survey, checks_of_laboratory, receive_buffers
from pixel2catch.envs.cfg import CatchEnvCfg
from pixel2catch.installation import Absent, Broken, Check
from pixel2catch.ros2 import messages
from pixel2catch.ros2.memory import Broker
from pixel2catch.ros2.profile import DriverJoint, Profile, RobotPart
from pixel2catch.ros2.transport import Topic
from pixel2catch.scene.constants import RGB_CAMERA
from pixel2catch.twin.drivers import CameraDriver
from pixel2catch.twin.lab_node import LabNode
from pixel2catch.twin.simulated_lab import SimulatedLab

PROFILE = Profile.load("ur5e_allegro_v4")
IMAGE, (ARM, HAND) = PROFILE.camera.image, PROFILE.robots
CYCLES = 300  #: 0.6 s: 18 images.
GREY = np.full((480, 640, 3), 120, dtype=np.uint8)
OF_MACHINE = {"real-time priority", "receive buffers"}


class Laboratory:
    """The twin in memory, with a camera that shows the same image."""

    def __init__(self) -> None:
        self.broker, self.clock = Broker(), StepClock(lambda _: None)
        self.lab, self.late = SimulatedLab(CatchEnvCfg(), seed=0), 0.0
        self.pixels = GREY
        node = self.broker.node(self.clock)
        self._lab_node = LabNode(self.lab, PROFILE, node, CameraDriver(self._draw))

    def _draw(self, _: object) -> "Future[np.ndarray]":
        drawn: Future[np.ndarray] = Future()
        drawn.set_result(self.pixels)
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
def laboratory(shared: Laboratory) -> Iterator[Laboratory]:
    yield shared
    shared.late, shared.pixels = 0.0, GREY


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
    assert checks["safety mode"].found == "1"
    assert laboratory.broker.nodes == before
    assert not any(node.publishers for node in laboratory.broker.nodes[1:])


def test_images_of_another_size_are_named(laboratory: Laboratory):
    laboratory.examine(cycles=100)  # what was under way
    laboratory.pixels = GREY[:240, :320]
    laboratory.examine(cycles=40)
    checks = laboratory.examine()
    assert bad(checks) == {"images"}
    assert "320 x 240 rgb8, the profile says 640 x 480" in checks["images"].found
    laboratory.pixels = GREY
    laboratory.examine(cycles=100)


def test_other_publishers_and_drivers_are_named(laboratory: Laboratory):
    with laboratory.broker.node(laboratory.clock) as node:
        node.publisher(ARM.command_topic)
        node.subscription(HAND.command_topic)
        checks = laboratory.examine(cycles=CYCLES)
    assert bad(checks) == {"commands to arm", "commands to hand"}
    assert "1 other publishers of /forward_position_controller/commands" in checks["commands to arm"].found
    assert checks["commands to hand"].found.startswith("2 subscribers")


def with_parts(arm: RobotPart = ARM, hand: RobotPart = HAND) -> Profile:
    return replace(PROFILE, robots=(arm, hand))


CAMERA = replace(PROFILE.camera, image=replace(IMAGE, name="/camera/color/image_raw"))
ELBOW = DriverJoint(name_in_state="left_elbow_joint", index_in_command=2)

OTHER_PROFILES = [
    (
        replace(PROFILE, camera=CAMERA),
        "images",
        f"nobody publishes {CAMERA.image.name}.*publishes {IMAGE.type} on {IMAGE.name}",
    ),
    (
        with_parts(hand=replace(HAND, command_topic=replace(HAND.command_topic, name="/hand/commands"))),
        "commands to hand",
        "nobody receives /hand/commands.*/allegro_hand_position_controller/commands",
    ),
    (
        with_parts(arm=replace(ARM, joints={**ARM.joints, "elbow_joint": ELBOW})),
        "joints of arm",
        "lacks left_elbow_joint; it has .*, elbow_joint",
    ),
    (with_parts(hand=replace(HAND, rate_hz=333.0)), "joints of hand", "100.0 Hz.*333 Hz are needed"),
]


@pytest.mark.parametrize(("profile", "name", "words"), OTHER_PROFILES)
def test_what_differs_from_the_profile_is_named(
    laboratory: Laboratory, profile: Profile, name: str, words: str
):
    checks = laboratory.examine(profile)
    assert name in bad(checks) <= {name, "pose of arm"}
    assert re.search(words, checks[name].found)


def test_a_clock_that_is_off_is_named(laboratory: Laboratory):
    laboratory.late = -0.2
    checks = laboratory.examine()
    assert bad(checks) == {"joints of arm", "joints of hand", "images"}
    assert all("-200.0 ms old" in checks[name].found for name in ("joints of arm", "joints of hand"))


def test_a_robot_that_was_stopped_is_named(laboratory: Laboratory):
    requests = laboratory.broker.node(laboratory.clock)
    say = requests.publisher(Topic(name="/twin/command", type=messages.TEXT))
    laboratory.examine(cycles=1)
    say.publish(messages.text('{"do": "protective_stop"}'))
    checks = laboratory.examine()
    assert bad(checks) == {"safety mode", "program", "speed scaling"}
    assert checks["safety mode"].found.startswith("3, not 1: ")
    assert "press play" in checks["program"].found
    say.publish(messages.text('{"do": "resume"}'))
    assert bad(laboratory.examine()) == set()
    requests.close()


def test_a_small_receive_buffer_is_named(tmp_path: Path):
    path = tmp_path / "rmem_max"
    with pytest.raises(Absent, match="the system does not show it"):
        receive_buffers(path)
    path.write_text("8388608\n")
    assert receive_buffers(path) == "net.core.rmem_max is 8388608"
    path.write_text("212992\n")
    with pytest.raises(Broken, match=r"212992, less than 4000000: images are lost. 'sudo sysctl"):
        receive_buffers(path)


def test_without_a_driver_one_line_says_so(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.setenv("ROS_DOMAIN_ID", own_domain())
    monkeypatch.setattr("pixel2catch.deployment.laboratory.DISCOVERY", 0.1)
    monkeypatch.setattr(Doctor, "_checks", lambda self: [])  # tests/cli/test_doctor.py has them
    with pytest.raises(SystemExit, match="1"):
        main(["doctor", "--robot", "ur5e_allegro_v4", "--json"])
    checks = {each["name"]: each for each in json.loads(capsys.readouterr().out)["checks"]}
    assert checks.keys() == {"network", *OF_MACHINE}
    assert "compare ROS_DOMAIN_ID" in checks["network"]["found"]
