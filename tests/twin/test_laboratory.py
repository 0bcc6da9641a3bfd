"""Checks of `doctor --robot` on the twin in stepped time, and without a laboratory."""

import json
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from twin_bench import PROFILE, Bench

from domains import own_domain
from pixel2catch.cli.doctor import Doctor
from pixel2catch.cli.main import main
from pixel2catch.deployment.control_loop import StepClock
from pixel2catch.deployment.laboratory import Survey, checks_of_laboratory, receive_buffers
from pixel2catch.envs.cfg import CatchEnvCfg
from pixel2catch.installation import Absent, Broken, Check
from pixel2catch.ros2.profile import DriverJoint, Profile, RobotPart
from pixel2catch.ros2.transport import RealClock
from pixel2catch.scene.constants import RGB_CAMERA

IMAGE, (ARM, HAND) = PROFILE.camera.image, PROFILE.robots
CYCLES = 300  #: 0.6 s: 18 images.
OF_MACHINE = {"real-time priority", "receive buffers"}


class Laboratory(Bench):
    """The twin, and what is found of it."""

    late = 0.0  #: Error of the clock [s].

    def examine(self, profile: Profile = PROFILE, cycles: int = CYCLES) -> dict[str, Check]:
        """What is found after so many cycles of 2 ms, by name."""
        clock = StepClock(lambda _: None)
        node: Any
        with self.broker.node(clock) as node:
            survey = Survey(node, profile, clock)
            for number in range(cycles):
                clock.time = self.lab_node.time
                self.lab_node.cycle(-self.late)
                if number % 50 == 49:
                    survey.listen()
            survey.listen()
            found = checks_of_laboratory(profile, survey, RGB_CAMERA, is_loopback=True)
            assert not node.publishers
        return {each.name: each for each in found}


@pytest.fixture(scope="module")
def shared() -> Iterator[Laboratory]:
    laboratory = Laboratory(CatchEnvCfg())
    yield laboratory
    laboratory.lab.close()


@pytest.fixture
def laboratory(shared: Laboratory) -> Iterator[Laboratory]:
    yield shared
    shared.late = 0.0


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


def test_other_publishers_and_drivers_are_named(laboratory: Laboratory):
    with laboratory.broker.node(RealClock()) as node:
        node.publisher(ARM.command_topic)
        node.subscription(HAND.command_topic)
        checks = laboratory.examine(cycles=CYCLES)
    assert bad(checks) == {"commands to arm", "commands to hand"}
    assert "1 other publishers of /forward_position_controller/commands" in checks["commands to arm"].found
    assert checks["commands to hand"].found.startswith("2 ")


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
    (
        replace(PROFILE, camera=replace(PROFILE.camera, width=848)),
        "images",
        "640 x 480 rgb8, the profile says 848 x 480",
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
    laboratory.examine(cycles=1)
    laboratory.ask(do="protective_stop")
    checks = laboratory.examine()
    assert bad(checks) == {"safety mode", "program", "speed scaling"}
    assert checks["safety mode"].found.startswith("3, not 1: ")
    assert "press play" in checks["program"].found
    laboratory.ask(do="resume")
    assert bad(laboratory.examine()) == set()


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
