"""Robot profiles: the shipped ones, commands, joint states, and errors."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import yaml

from paper_robot import JOINTS
from pixel2catch.cli.main import main
from pixel2catch.errors import DeploymentError
from pixel2catch.ros2 import messages
from pixel2catch.ros2.profile import PROFILES, Profile
from pixel2catch.workcells import find_workcell

NAMES = [joint.name for joint in JOINTS]


@pytest.mark.parametrize("name", sorted(path.stem for path in PROFILES.glob("*.yaml")))
def test_shipped_profiles_have_all_joints_and_the_policies_camera(name: str):
    """`twin/test_driver_doubles.py` has the order of their commands."""
    profile = Profile.load(name)
    profile.require(find_workcell(profile.workcell).joint_names)
    assert profile.name == name
    assert (profile.camera.width, profile.camera.height) == (640, 480)
    latched = profile.status.safety_mode
    assert latched.is_latched if latched else name == "fr3_allegro"
    assert profile.operator.dead_man.name == "/pixel2catch/dead_man"


def reading(**positions: float):
    return messages.read_joint_state(messages.joint_state(positions, positions.values(), 0.0))


def test_joint_states_are_read_by_name_in_any_order_and_some_at_a_time():
    arm, hand = Profile.load("ur5e_allegro_v4").robots
    state = reading(elbow_joint=2.0, ah_joint11=6.0, shoulder_pan_joint=0.0, gripper=99.0, ah_joint00=15.0)
    found = [part.columns(state.names) for part in (arm, hand)]
    assert [ids.tolist() for _, ids in found] == [[0, 2], [6, 15]]
    assert [state.position[columns].tolist() for columns, _ in found] == [[0.0, 2.0], [6.0, 15.0]]
    assert arm.columns(("gripper",))[1].tolist() == []


def shipped() -> Any:
    return yaml.safe_load((PROFILES / "ur5e_allegro_v4.yaml").read_text(encoding="utf-8"))


def load(content: Any, folder: Path) -> Profile:
    path = folder / "lab.yaml"
    path.write_text(yaml.safe_dump(content), encoding="utf-8")
    return Profile.load(path)


def test_optional_topics_may_be_left_out(tmp_path: Path):
    content = shipped()
    del content["status"], content["camera"]["info"]
    profile = load(content | {"operator": {"arm": "/lab/arm"}}, tmp_path)
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
    ("robots.1.held.4.angle", 0.5, "angle is 0.5; it may be -0.47 to 0.47 rad"),
    ("robots.0.command_topic.type", messages.NUMBER, "'std_msgs/msg/Float64'"),
    ("places", {"bin": {"joints": {"elbow": 1.0}}}, "unknown arm joint 'elbow'"),
    ("places", {"bin": {"joints": {"elbow_joint": 9.0}}}, "places.bin: elbow_joint is 9; it may be"),
    ("places", {"bin": {"palm": [0.5, 0.1]}}, "places"),
    ("robots.1.command_topic.name", "/forward_position_controller/commands", "/forward_posi"),
]


@pytest.mark.parametrize(("keys", "value", "message"), MISTAKES)
def test_a_mistake_is_refused_with_file_and_key(tmp_path: Path, keys: str, value, message: str):
    place = content = shipped()
    *path, last = (int(key) if key.isdecimal() else key for key in keys.split("."))
    for key in path:
        place = place[key]
    place[last] = value
    if value is GONE:
        del place[last]
    with pytest.raises(DeploymentError) as raised:
        load(content, tmp_path)
    assert str(tmp_path / "lab.yaml") in str(raised.value)
    assert message in str(raised.value)


def test_a_file_that_is_not_there_is_refused(tmp_path: Path):
    """Damaged files are in fuzz/test_hostile.py."""
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
