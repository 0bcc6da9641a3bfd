"""Robot profiles: the shipped ones, commands, joint states, and errors."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from paper_robot import JOINTS
from pixel2catch.cli.main import main
from pixel2catch.errors import DeploymentError
from pixel2catch.ros2 import messages
from pixel2catch.ros2.messages import decode
from pixel2catch.ros2.profile import PROFILES, Profile, RobotPart
from pixel2catch.workcells import find_workcell

NAMES = [joint.name for joint in JOINTS]
SHIPPED = sorted(path.stem for path in PROFILES.glob("ur5e_allegro_*.yaml"))
ARM = [0.0, 1.0, 2.0, 3.0, 4.0, 5.0]
INDEX, MIDDLE, RING, THUMB = [6.0, 7.0, 8.0], [9.0, 10.0, 11.0], [12.0, 13.0, 14.0], [15.0, 16.0, 17.0, 18.0]
THUMB_FIRST = [*THUMB, 0.0, *INDEX, 0.0, *MIDDLE, 0.0, *RING]
THUMB_LAST = [0.0, *INDEX, 0.0, *MIDDLE, 0.0, *RING, *THUMB]


@pytest.mark.parametrize("name", SHIPPED)
def test_shipped_profiles_have_all_joints_and_the_policies_camera(name: str):
    profile = Profile.load(name)
    profile.require(NAMES)
    assert profile.name == name
    assert (profile.camera.width, profile.camera.height) == (640, 480)
    assert profile.status.safety_mode
    assert profile.status.safety_mode.is_latched
    assert profile.operator.dead_man.name == "/pixel2catch/dead_man"


def test_every_other_work_cell_with_a_policy_has_a_profile_that_moves_all_its_joints():
    """Commands in the driver's order are read back by name; LEAP fingers begin with abduction."""
    others = sorted({path.stem for path in PROFILES.glob("*.yaml")} - {*SHIPPED})
    assert others == ["fr3_allegro", "two_ur5e_allegro", "ur5e_leap"]
    for name in others:
        profile = Profile.load(name)
        joints = find_workcell(name).joint_names
        profile.require(joints)
        assert (profile.name, profile.workcell) == (name, name)
        targets, joint_pos = np.arange(len(joints), dtype=np.float64), np.full(len(joints), -1.0)
        for part in profile.robots:
            sent: Any = decode(command(part, targets), part.command_topic.type)
            values = sent.data if hasattr(sent, "data") else sent.position
            states = {j.name_in_state: values[j.index_in_command] for j in part.joints.values()}
            part.merge(reading(**states), joint_pos)
        np.testing.assert_array_equal(joint_pos, targets)
    hand = Profile.load("ur5e_leap").robots[1]
    assert positions_of(command(hand, np.arange(22.0)))[:4].tolist() == [7.0, 6.0, 8.0, 9.0]


def command(part: RobotPart, joint_pos: np.ndarray) -> bytes:
    return part.command(joint_pos, part.held_angles)


def positions_of(data: bytes) -> np.ndarray:
    """Return the positions of a command."""
    message: Any = decode(data, messages.JOINT_STATE)
    return message.position


@pytest.mark.parametrize(
    ("name", "hand", "read"),
    [
        ("ur5e_allegro_v4", THUMB_FIRST, messages.read_float_array),
        ("ur5e_allegro_v5", THUMB_LAST, positions_of),
        ("ur5e_allegro_classic", THUMB_LAST, positions_of),
    ],
)
def test_commands_have_the_order_of_the_driver(name: str, hand: list[float], read):
    arm_part, hand_part = Profile.load(name).robots
    targets = np.arange(len(JOINTS), dtype=np.float64)
    assert messages.read_float_array(command(arm_part, targets)).tolist() == ARM
    assert read(command(hand_part, targets)).tolist() == hand


def reading(**positions: float):
    return messages.read_joint_state(messages.joint_state(positions, positions.values(), 0.0))


def test_joint_states_are_read_by_name_in_any_order_and_some_at_a_time():
    arm, hand = Profile.load("ur5e_allegro_v4").robots
    joint_pos = np.full(len(JOINTS), -1.0)
    state = reading(elbow_joint=2.0, ah_joint11=6.0, shoulder_pan_joint=0.0, gripper=99.0, ah_joint00=15.0)
    assert arm.merge(state, joint_pos).tolist() == [0, 2]
    assert joint_pos.tolist() == [0.0, -1.0, 2.0, *[-1.0] * 16]
    assert hand.merge(state, joint_pos).tolist() == [6, 15]
    assert (joint_pos[6], joint_pos[15]) == (6.0, 15.0)
    assert arm.merge(reading(gripper=1.0), joint_pos).tolist() == []


def changed(tmp_path: Path, change) -> Path:
    """A shipped profile with a change in its content, as a file."""
    content = yaml.safe_load((PROFILES / "ur5e_allegro_v4.yaml").read_text(encoding="utf-8"))
    change(content)
    path = tmp_path / "lab.yaml"
    path.write_text(yaml.safe_dump(content), encoding="utf-8")
    return path


def test_optional_topics_may_be_left_out(tmp_path: Path):
    def change(content):
        del content["status"], content["camera"]["info"]
        content["operator"] = {"arm": "/lab/arm"}

    profile = Profile.load(changed(tmp_path, change))
    assert (profile.status.safety_mode, profile.camera.info) == (None, None)
    assert (profile.operator.arm.name, profile.operator.stop.name) == ("/lab/arm", "/pixel2catch/stop")


def test_a_robot_without_joints_of_the_policy_is_refused():
    with pytest.raises(DeploymentError, match="'ur5e_allegro_v4' has no lift, which the policy moves"):
        Profile.load("ur5e_allegro_v4").require([*NAMES, "lift"])


GONE = object()
ARM_JOINT = "robots.0.joints.elbow_joint"

MISTAKES = [
    ("camera.widths", 1, "unknown field 'camera.widths'"),
    ("camera.image", "raw", "'image': 'raw' is no topic"),
    (f"{ARM_JOINT}.index_in_command", 1, "the command's place 1 is given twice"),
    ("robots.0.joints.elbow", {"name_in_state": "x", "index_in_command": 0}, "unknown joint 'elbow'"),
    ("robots.1.held.4", GONE, "places 0 to 15"),
    ("robots.1.held.4.angle", float("nan"), "'angle' has the number nan"),
    ("robots.0.command_topic.type", messages.NUMBER, "'std_msgs/msg/Float64'"),
    ("places", {"bin": {}}, "places.bin: give joints or palm"),
    ("places", {"bin": {"joints": {"elbow": 1.0}}}, "unknown arm joint 'elbow'"),
    ("places", {"bin": {"joints": {"elbow_joint": 9.0}}}, "places.bin: elbow_joint is 9; it may be"),
    ("places", {"bin": {"palm": [0.5, 0.1]}}, "places"),
    ("robots.1.command_topic.name", "/forward_position_controller/commands", "/forward_posi"),
]


@pytest.mark.parametrize(("keys", "value", "message"), MISTAKES)
def test_a_mistake_is_refused_with_file_and_key(tmp_path: Path, keys: str, value, message: str):
    def change(content):
        *path, last = (int(key) if key.isdecimal() else key for key in keys.split("."))
        for key in path:
            content = content[key]
        content[last] = value
        if value is GONE:
            del content[last]

    with pytest.raises(DeploymentError) as raised:
        Profile.load(changed(tmp_path, change))
    assert str(tmp_path / "lab.yaml") in str(raised.value)
    assert message in str(raised.value)


def test_a_file_that_is_not_a_profile_is_refused(tmp_path: Path):
    path = tmp_path / "lab.yaml"
    path.write_text("camera: [", encoding="utf-8")
    with pytest.raises(DeploymentError, match=r"lab\.yaml"):
        Profile.load(path)
    with pytest.raises(DeploymentError, match=r"cannot read the profile '.*gone\.yaml': .* Correct it"):
        Profile.load(tmp_path / "gone.yaml")


def test_a_copy_of_a_shipped_profile_has_its_comments_and_its_own_name(tmp_path: Path):
    path = tmp_path / "my_lab.yaml"
    assert main(["deploy", "--profile", "ur5e_leap", "--write-profile", str(path)]) == 0
    text, ours = path.read_text(), (PROFILES / "ur5e_leap.yaml").read_text()
    assert text.replace('name: "my_lab"', "name: ur5e_leap") == ours
    assert Profile.load(path) == replace(Profile.load("ur5e_leap"), name="my_lab")
    assert main(["deploy", "--write-profile", str(path)]) == 2
    assert path.read_text() == text
