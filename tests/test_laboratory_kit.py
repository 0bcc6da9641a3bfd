"""The laboratory kit agrees with the shipped profiles: launch files, lines of the guide, the risk table."""

import ast
import re
import shlex
import subprocess
import sys
from functools import cache
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
import yaml

from pixel2catch.cli.main import parse
from pixel2catch.deployment.control_loop import read_prompt
from pixel2catch.deployment.laboratory import Survey, checks_of_laboratory
from pixel2catch.ros2 import messages
from pixel2catch.ros2.memory import Broker
from pixel2catch.ros2.profile import PROFILES, Profile, RobotPart
from pixel2catch.ros2.transport import RealClock
from pixel2catch.scene.constants import CONTROL_DT, RGB_CAMERA
from pixel2catch.workcells import find_workcell

ROOT = Path(__file__).parents[1]
LAUNCH = ROOT / "ros" / "pixel2catch_ros" / "launch"
GUIDE = re.sub(r" \\\n +", " ", (ROOT / "docs" / "laboratory.md").read_text("utf-8"))
RISKS = (ROOT / "docs" / "risks.md").read_text("utf-8")
SHIPPED = sorted(path.stem for path in PROFILES.glob("ur5e_allegro_*.yaml"))


@cache
def launch(name: str) -> ElementTree.Element:
    return ElementTree.parse(LAUNCH / f"{name}.launch.xml").getroot()


@cache
def parameters(name: str) -> dict[str, Any]:
    return yaml.safe_load((LAUNCH / f"{name}.yaml").read_text("utf-8"))


def arguments(name: str) -> dict[str, str | None]:
    return {arg.attrib["name"]: arg.get("default") for arg in launch(name).findall("arg")}


def included(name: str) -> dict[str, str]:
    """What a launch file hands on to the driver's own."""
    return {arg.attrib["name"]: arg.attrib["value"] for arg in launch(name).iterfind("include/arg")}


def order(part: RobotPart) -> list[str | None]:
    """The driver's names of the joints of a command."""
    names = {joint.index_in_command: joint.name_in_state for joint in part.joints.values()}
    names |= {place: joint.name_in_state for place, joint in part.held.items()}
    return [names[place] for place in range(part.command_size)]


@pytest.mark.parametrize(
    ("file", "profile"),
    [("hand_v4", "ur5e_allegro_v4"), ("hand_v4", "fr3_allegro"), ("two_hands_v4", "two_ur5e_allegro")],
)
def test_hands_are_launched_with_the_topics_and_joints_of_their_profile(file: str, profile: str):
    hands = [part for part in Profile.load(profile).robots if "hand" in part.name]
    (group,) = launch(file).findall("group")
    (namespace,) = group.findall("push-ros-namespace")
    prefix = f"/{namespace.attrib['namespace']}"
    remaps = {each.attrib["from"]: each.attrib["to"] for each in group.iterfind("node/remap")}
    started = group.findall("node[@exec='spawner']")[0].attrib["args"].split()
    names = [hand.controller.name for hand in hands if hand.controller]
    assert set(parameters(file)) == {f"{prefix}/{name}" for name in ("controller_manager", *names)}
    assert started == ["joint_state_broadcaster", *names, "-c", f"{prefix}/controller_manager"]
    assert f"-c {prefix}/controller_manager" in GUIDE
    manager = parameters(file)[f"{prefix}/controller_manager"]["ros__parameters"]
    for hand, controller in zip(hands, names, strict=True):
        assert remaps["joint_states"] == hand.state_topic.name
        assert remaps[f"{controller}/commands"] == hand.command_topic.name
        assert hand.controller
        assert hand.controller.activity.name == f"{prefix}/controller_manager/activity"
        assert manager["update_rate"] == hand.rate_hz
        assert controller in manager
        joints = parameters(file)[f"{prefix}/{controller}"]["ros__parameters"]["joints"]
        assert joints == order(hand)
        assert "fingers move" in hand.notice


def test_two_arms_are_launched_under_one_controller_manager_with_the_names_of_their_profile():
    profile, file = Profile.load("two_ur5e_allegro"), parameters("two_ur5e")
    manager = file["/controller_manager"]["ros__parameters"]
    spawners = launch("two_ur5e").findall("node[@exec='spawner']")
    active, inactive = (each.attrib["args"].split() for each in spawners)
    for arm in profile.robots[::2]:
        assert arm.controller
        assert arm.controller.activity.name == "/controller_manager/activity"
        assert arm.command_topic.name == f"/{arm.controller.name}/commands"
        assert file[f"/{arm.controller.name}"]["ros__parameters"]["joints"] == order(arm)
        assert arm.controller.name in inactive
        assert manager["update_rate"] == arm.rate_hz
    started = [name for name in (*active, *inactive) if name.endswith(("controller", "broadcaster"))]
    assert {*manager} - {"update_rate"} == {*started}
    watched = {topic.name.split("/")[1] for topic in vars(profile.status).values()}
    assert watched < {*active}
    stoppers = launch("two_ur5e").findall("node[@exec='controller_stopper_node']")
    assert len(stoppers) == 2
    for stopper in stoppers:
        kept = file[f"/{stopper.attrib['name']}"]["ros__parameters"]["consistent_controllers"]
        assert {*kept} == {name for name in active if not name.endswith("trajectory_controller")} & {*started}
        (remap,) = stopper.findall("remap")
        assert remap.attrib["to"].split("/")[1] in active
    placed = ElementTree.parse(LAUNCH / "two_ur5e.urdf.xacro").getroot().iter("origin")
    robots = find_workcell(profile.workcell).robots
    assert [tuple(map(float, each.attrib["xyz"].split())) for each in placed] == [each.pos for each in robots]


@pytest.mark.parametrize("name", SHIPPED)
def test_the_camera_is_launched_as_the_profiles_and_policies_want_it(name: str):
    camera, settings = Profile.load(name).camera, parameters("camera")
    handed = included("camera")
    place = f"/{handed['camera_namespace']}/{handed['camera_name']}/color"
    assert camera.info is not None
    assert (camera.image.name, camera.info.name) == (f"{place}/image_raw", f"{place}/camera_info")
    assert (camera.width, camera.height) == (RGB_CAMERA.width, RGB_CAMERA.height)
    assert settings["rgb_camera.color_profile"] == f"{camera.width}x{camera.height}x{1 / CONTROL_DT:.0f}"
    assert settings["rgb_camera.color_format"].lower() == camera.encoding
    assert [settings[key] for key in settings if "auto" in key] == [False, False]
    for key, value in settings.items():
        if key.startswith("rgb_camera.") and "time" not in key:
            said = str(value).lower() if isinstance(value, bool) else value
            assert re.search(rf"{re.escape(key)}(: |:=| ){said}\b", GUIDE), key


def test_the_arm_is_launched_and_switched_to_the_controller_of_the_profiles():
    topics = {Profile.load(name).robots[0].command_topic.name for name in SHIPPED}
    (controller,) = (topic.removeprefix("/").removesuffix("/commands") for topic in topics)
    assert "initial_joint_controller" not in included("ur5e"), "its name differs between distributions"
    assert f"--deactivate scaled_joint_trajectory_controller --activate {controller}" in GUIDE
    assert (included("ur5e")["headless_mode"], arguments("ur5e")["mock"]) == ("false", "false")


def lines(start: str) -> list[list[str]]:
    """Words of the lines of the guide that begin so, be they in a block or in a table."""
    quoted = r'(?:"(?:[^"\\]|\\.)*"|[^"\n`])*'  # a text in quotes may go on in the next line
    found = re.findall(rf"^ *({re.escape(start)}{quoted})$|`({re.escape(start)}[^`]*)`", GUIDE, re.MULTILINE)
    return [shlex.split(block or cell) for block, cell in found]


def test_lines_of_our_launch_files_have_arguments_that_there_are():
    ours = [words[3:] for words in lines("ros2 launch pixel2catch_ros ")]
    assert {words[0] for words in ours} == {path.name for path in LAUNCH.glob("*.xml")}
    for name, *given in ours:
        known = arguments(name.removesuffix(".launch.xml"))
        assert {word.partition(":=")[0] for word in given} <= set(known)
        assert {key for key, default in known.items() if default is None} <= {w.split(":=")[0] for w in given}


DRIVERS = yaml.safe_load((ROOT / "tests" / "ros_drivers.yaml").read_text("utf-8"))


@pytest.mark.parametrize("distribution", DRIVERS["ur_robot_driver"])
def test_the_arms_driver_has_the_arguments_and_controllers_in_every_distribution(distribution: str):
    driver = DRIVERS["ur_robot_driver"][distribution]
    given = included("ur5e").keys() - {"use_mock_hardware", "use_fake_hardware"}
    assert given <= {*driver["arguments"]}
    assert len({"use_mock_hardware", "use_fake_hardware"} & {*driver["arguments"]}) == 1
    prefix = "" if distribution == "lyrical" else "scaled_"
    homing = f"{prefix}joint_trajectory_controller"
    assert {homing, "forward_position_controller"} <= {*driver["controllers"]}
    assert homing in GUIDE


def test_the_drivers_of_camera_and_hand_have_the_arguments():
    assert included("camera").keys() <= {*DRIVERS["realsense2_camera"]}
    (description,) = (each.attrib["value"] for each in launch("hand_v4").iterfind("let[@name='description']"))
    assert {*re.findall(r"(\w+):=", description)} <= {*DRIVERS["allegro_hand_bringup"]}


def test_the_deployment_is_launched_with_options_that_it_has():
    command = launch("deploy").findall("executable")[0].attrib["cmd"]
    for name, value in (("network", "lo"), ("options", ""), (r"\w+", "x")):
        command = re.sub(rf"\$\(var {name}\)", value, command)
    assert str(parse(command.split()[1:]).record) == "x"


def test_the_ros_package_builds_and_installs_its_launch_files(tmp_path: Path):
    uv = [str(Path(sys.executable).with_name("uv")), "tool", "run", "--with", "colcon-ros==0.5.0"]
    colcon = ["--from", "colcon-core==0.21.3", "colcon", "build", "--base-paths", str(LAUNCH.parents[1])]
    done = subprocess.run([*uv, *colcon], cwd=tmp_path, capture_output=True, text=True)
    if done.returncode and not (tmp_path / "log").exists():
        pytest.skip(f"colcon cannot be installed here: {done.stderr.strip()[-200:]}")
    assert done.returncode == 0, done.stderr
    share = tmp_path / "install" / "pixel2catch_ros" / "share"
    assert (share / "ament_index" / "resource_index" / "packages" / "pixel2catch_ros").exists()
    installed = {path.name for path in (share / "pixel2catch_ros" / "launch").iterdir()}
    assert installed == {path.name for path in LAUNCH.iterdir()}
    for path in LAUNCH.glob("*.xml"):
        assert {*re.findall(r"\$\(dirname\)/([\w.]+)", path.read_text("utf-8"))} <= installed


def test_the_start_pose_of_the_guide_is_that_of_the_task():
    profiles = [Profile.load(name) for name in SHIPPED]
    home = np.array([joint.home for joint in find_workcell(profiles[0].workcell).joints])
    ((*_, goal),) = lines("ros2 action send_goal ")
    trajectory, arm = yaml.safe_load(goal)["trajectory"], profiles[0].robots[0]
    assert trajectory["joint_names"] == order(arm)
    assert trajectory["points"][0]["positions"] == pytest.approx(home[arm.ids], abs=1e-3)
    said = {words[4]: words[5:] for words in lines("ros2 topic pub --once /allegro")}
    assert len(said) == len(profiles)
    for hand in (profile.robots[1] for profile in profiles):
        kind, content = said[hand.command_topic.name]
        values = yaml.safe_load(content)["data" if kind == messages.FLOAT_ARRAY else "position"]
        assert kind == hand.command_topic.type
        expected = messages.read_float_array(hand.command(home, hand.held_angles), kind)
        assert values == pytest.approx(expected, abs=1e-3)


def test_the_prompt_of_the_guide_is_one():
    topic = Profile.load(SHIPPED[0]).operator.prompt
    ((*_, name, kind, content),) = lines("ros2 topic pub --once /pixel2catch/prompt")
    assert (name, kind) == (topic.name, topic.type)
    xmin, ymin, xmax, ymax = read_prompt(messages.text(yaml.safe_load(content)["data"])).box
    assert 0 <= xmin < xmax <= RGB_CAMERA.width
    assert 0 <= ymin < ymax <= RGB_CAMERA.height


def test_every_check_of_a_laboratory_is_explained():
    profile, clock, broker = Profile.load("ur5e_allegro_v4"), RealClock(), Broker()
    broker.node(clock).publisher(profile.camera.image)
    survey = Survey(broker.node(clock), profile, clock)
    survey.listen()
    checks = checks_of_laboratory(profile, survey, RGB_CAMERA, is_loopback=True)
    rows = re.findall(r"^\| ([^|]+) \|", GUIDE[GUIDE.index("| check |") :], re.MULTILINE)
    assert {name for row in rows for name in row.split(", ")} >= {check.name for check in checks}


def test_hazards_are_numbered_and_files_and_tests_of_the_guards_exist():
    rows = [row.split(" | ") for row in re.findall(r"^\| (\d+ \| .*) \|$", RISKS, re.MULTILINE)]
    hazards, guards = ([row for row in rows if len(row) == columns] for columns in (4, 3))
    assert [int(number) for number, *_ in hazards] == list(range(1, len(hazards) + 1))
    assert len(hazards) > 20
    assert [number for number, *_ in guards] == [n for n, _, guard, _ in hazards if guard != "none"]
    for _, files, tests in guards:
        for file in re.findall(r"`([^`]+)`", files):
            assert (ROOT / "src" / "pixel2catch" / file).is_file(), file
        for name in re.findall(r"`([^`]+)`", tests):
            path, _, function = name.partition("::")
            tree = ast.parse((ROOT / "tests" / path).read_text("utf-8"))
            assert function in {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}, name
