"""The twin's topics in memory, cycle by cycle, with black images; its page; and `doctor --robot` on it."""

import json
import re
from collections.abc import Iterator
from concurrent.futures import Future
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from domains import free_port, own_domain
from pixel2catch.camera.image import Pixels
from pixel2catch.cli.doctor import Doctor
from pixel2catch.cli.main import main
from pixel2catch.deployment.control_loop import StepClock
from pixel2catch.deployment.laboratory import Survey, checks_of_laboratory, receive_buffers
from pixel2catch.envs.cfg import CatchEnvCfg
from pixel2catch.evaluation.loading import load_policy, task_of
from pixel2catch.installation import Absent, Broken, Check
from pixel2catch.rendering.camera import Exposure
from pixel2catch.ros2 import messages
from pixel2catch.ros2.memory import Broker
from pixel2catch.ros2.profile import DriverJoint, Profile
from pixel2catch.scene.constants import CONTROL_DT, RGB_CAMERA
from pixel2catch.twin import RehearsalCfg
from pixel2catch.twin.drivers import CYCLE, LATENCY, CameraDriver
from pixel2catch.twin.lab_node import COMMAND, STATE, LabNode, twin_profile
from pixel2catch.twin.simulated_lab import Phase, SimulatedLab
from pixel2catch.twin.stepped import in_step
from pixel2catch.viewer import PageCfg
from pixel2catch.viewer.twin import TwinPage
from pixel2catch.workcells import find_workcell

PROFILE = Profile.load("ur5e_allegro_v4")
ARM, HAND = PROFILE.robots
IMAGE, STATUS = PROFILE.camera.image, PROFILE.status
OF_MACHINE = {"real-time priority", "receive buffers"}


def draw_black(_: Exposure) -> "Future[Pixels]":
    future: Future[Pixels] = Future()
    future.set_result(np.zeros((480, 640, 3), dtype=np.uint8))
    return future


class Bench:
    """The twin, and a node that sends requests and commands; stamps are too early by `late` [s]."""

    def __init__(self) -> None:
        self.clock, self.broker, self.late = StepClock(lambda _: None), Broker(), 0.0
        self.lab, self.node = SimulatedLab(CatchEnvCfg(), seed=0), self.broker.node(self.clock)
        self.camera = CameraDriver(draw_black)
        self.lab_node = LabNode(self.lab, PROFILE, self.broker.node(self.clock), self.camera)
        self._states, self._requests = self.hear(STATE), self.node.publisher(COMMAND)

    def hear(self, topic: Any) -> Any:
        return self.node.subscription(topic, depth=1000)

    def ask(self, num_cycles: int = 20, /, **request: Any) -> dict[str, Any]:
        """Send a request; return the state some cycles later."""
        self._requests.publish(messages.text(json.dumps(request)))
        return self.cycle(num_cycles)

    def send(self, joint_pos: np.ndarray) -> None:
        for part in PROFILE.robots:
            with self.broker.node(self.clock) as node:
                node.publisher(part.command_topic).publish(part.command(joint_pos, part.held_angles))

    def cycle(self, num: int = 1, num_late: int = 0) -> dict[str, Any]:
        """Return the newest state, if there is one."""
        for _ in range(num):
            self.clock.time = self.lab_node.time
            self.lab_node.cycle(-self.late, num_late)
        return ([{}] + [json.loads(messages.read_text(each.data)) for each in self._states.take()])[-1]

    def examine(self, profile: Profile = PROFILE) -> dict[str, Check]:
        """What `doctor` finds in 0.6 s with 18 images, by name."""
        with (node := self.broker.node(self.clock)):
            survey = Survey(node, profile, self.clock)
            for _ in range(6):
                self.cycle(50)
                survey.listen()
            found = checks_of_laboratory(profile, survey, RGB_CAMERA, is_loopback=True)
            assert not node.publishers
        return {each.name: each for each in found}


@pytest.fixture
def bench() -> Iterator[Bench]:
    bench = Bench()
    with closing(bench.lab):
        yield bench


def test_arm_hand_and_camera_have_their_own_rates_names_and_latencies(bench: Bench):
    joints, images = bench.hear(ARM.state_topic), bench.hear(IMAGE)
    bench.cycle(500)
    readings = [messages.read_joint_state(message.data) for message in joints.take()]
    arm, hand = ([each for each in readings if len(each.names) == size] for size in (6, 16))
    assert (len(arm), len(hand), len(readings)) == (500, 100, 600)
    assert arm[0].names == tuple(sorted(theirs.name_in_state for theirs in ARM.joints.values()))
    assert set(hand[0].names) == {f"ah_joint{finger}{joint}" for finger in range(4) for joint in range(4)}
    spread = dict(zip(hand[0].names, hand[0].position, strict=True))
    assert [spread[f"ah_joint{finger}0"] for finger in (1, 2, 3)] == [0.0, 0.0, 0.0]
    assert [each.stamp for each in arm] == pytest.approx(CYCLE * np.arange(500), abs=1e-8)
    received = images.take()
    stamps = np.array([messages.read_image(message.data).stamp for message in received])
    delays = np.array([message.arrival for message in received]) - stamps
    assert stamps == pytest.approx((1 + np.arange(29)) * CONTROL_DT, abs=1e-6)
    assert LATENCY - 1e-6 <= delays.min() <= delays.max() < LATENCY + CYCLE
    assert (bench.camera.num_late, bench.camera.num_lost) == (0, 0)


def test_late_subscribers_learn_the_status_and_all_learn_of_a_stop(bench: Bench):
    speed = bench.hear(STATUS.speed_scaling)
    bench.cycle(3)
    safety, program = bench.hear(STATUS.safety_mode), bench.hear(STATUS.program_running)

    def told() -> tuple[int, bool]:
        (mode,), (is_running,) = safety.take(), program.take()
        return messages.read_safety_mode(mode.data), messages.read_boolean(is_running.data)

    assert told() == (1, True)
    bench.ask(12, do="protective_stop")
    assert told() == (3, False)
    scaling = [messages.read_number(message.data) for message in speed.take()]
    assert scaling == [100.0, 0.0, 0.0]  # after 0, 5 and 10 cycles, asked in the third
    bench.ask(2, do="resume")
    assert told() == (1, True)


def test_commands_move_the_joints_they_are_meant_for(bench: Bench):
    start = bench.lab.joints.position
    target = start + np.linspace(-0.3, 0.3, 19)
    for i in range(1, 801):
        bench.send(start + min(i / 200, 1.0) * (target - start))
        state = bench.cycle() or {"ignored": 0}
        assert state["ignored"] == 0
    assert bench.lab.joints.position == pytest.approx(target, abs=0.03)


def test_a_late_twin_takes_waiting_commands_one_by_one(bench: Bench):
    start = bench.lab.joints.position
    for i in range(1, 31):  # 30 cycles of commands, at once far more than 0.04 rad
        bench.send(start + 0.005 * i)
    for left in range(29, -1, -1):
        bench.cycle(num_late=left)
    bench.send(start + 0.155)
    state = bench.cycle(20)
    assert (state["ignored"], state["halted"]) == (0, False)
    bench.send(start + 0.3)
    assert bench.cycle(20)["ignored"] == 1


def test_a_command_of_a_wrong_length_is_no_command(bench: Bench):
    arm, start = bench.node.publisher(ARM.command_topic), bench.lab.joints.position
    for bad in (messages.float_array(start[:5]), b"\x00\x01\x00\x00"):
        arm.publish(bad)
        bench.cycle()
    state = bench.cycle(20)
    assert bench.lab.joints.position == pytest.approx(start, abs=1e-6)
    assert (state["ignored"], state["halted"]) == (2, False)  # no command was taken, so nobody is silent


def test_play_after_a_protective_stop_moves_nothing(bench: Bench):
    """An arm that was displaced meanwhile stays where it is. The servo sends nothing: `test_servo_faults`."""
    bench.ask(100, do="protective_stop")
    bench.lab._qpos[ARM.ids] += 0.03
    displaced = bench.lab.joints.position
    bench.ask(500, do="resume")
    assert bench.lab.joints.position == pytest.approx(displaced, abs=2e-3)


def test_a_request_that_cannot_be_met_is_refused_with_the_reason(bench: Bench):
    for request in ({"do": "dance"}, {"do": "prepare", "seed": 2**63}, {"do": "throw"}):
        assert bench.ask(**request)["refused"] != "", request
        assert bench.ask(do="resume")["refused"] == ""


@pytest.mark.parametrize(
    ("workcell", "profile", "jerk"),
    [
        ("ur5e_allegro_right", "ur5e_allegro_v4", np.inf),
        ("fr3_allegro", "fr3_allegro", 5000.0),
        ("ur5e_leap", "ur5e_leap", np.inf),
        ("ur5e_allegro_release", "ur5e_allegro_v4", np.inf),
    ],
)
def test_a_twin_has_the_shipped_profile_of_its_work_cell(workcell: str, profile: str, jerk: float):
    found = twin_profile(find_workcell(workcell))
    assert (found.name, found.workcell) == (profile, workcell)
    assert found.robots[0].limits.jerk == jerk


def test_buttons_prepare_and_throw(bench: Bench):
    cfg = PageCfg(address=f"127.0.0.1:{free_port()}")
    page = TwinPage(cfg, PROFILE, bench.node, bench.clock)
    with closing(page.page):

        def after(do: str, num_cycles: int = 30) -> dict[str, Any]:
            """What the page shows of the twin, some cycles after a press."""
            page._handle({"do": do})
            bench.cycle(num_cycles)
            page.update()
            return page.page.state["twin"]

        assert "the room is empty" in after("resume")["throw"]
        assert after("prepare", 300)["seed"] == 1
        assert bench.lab.phase is Phase.HELD
        assert f"{bench.lab.object_name} flying" in after("throw")["throw"]
        assert "prepare one" in after("throw")["trouble"]
        assert "press resume" in after("protective_stop")["trouble"]


@pytest.mark.slow
def test_one_button_throws_and_catches():
    policy, _ = load_policy(None)
    task = task_of(policy, physics_hz=120.0)
    with in_step(RehearsalCfg(throws=1, plain=True), task, policy) as (twin, _):
        node = twin.broker.node(twin.clock)
        page = TwinPage(PageCfg(address=f"127.0.0.1:{free_port()}"), PROFILE, node, twin.clock)
        page.seed = 3
        page.catch()
        assert page.trial is not None
        page.trial.join()
        page.update()
        page.page.close()
        assert (twin.lab.outcome, page.seed, page.page.state["tone"]) == ("caught", 4, "stopped")
        assert page.page.state["twin"]["result"] == "caught; 1 of 1 caught"


def bad(checks: dict[str, Check]) -> set[str]:
    """Names of what is needed and wrong."""
    return {name for name, each in checks.items() if each.is_needed and each.state == "BAD"}


def test_the_twin_is_ready(bench: Bench):
    checks = bench.examine()
    assert bad(checks) == set()
    assert {name for name, each in checks.items() if not each.is_needed} == OF_MACHINE
    found = {name: each.found for name, each in checks.items()}
    assert found["joints of arm"].startswith("6 joints, 500.0 Hz")
    assert found["joints of hand"].startswith("13 joints, 100.0 Hz")
    assert found["images"].startswith("640 x 480 rgb8, 30.0 Hz")
    assert found["safety mode"] == "1"


def test_other_publishers_and_drivers_are_named(bench: Bench):
    with bench.broker.node(bench.clock) as node:
        node.publisher(ARM.command_topic)
        node.subscription(HAND.command_topic)
        checks = bench.examine()
    assert bad(checks) == {"commands to arm", "commands to hand"}
    assert "1 other publishers of /forward_position_controller/commands" in checks["commands to arm"].found
    assert checks["commands to hand"].found.startswith("2 ")


CAMERA = replace(PROFILE.camera, image=replace(IMAGE, name="/camera/color/image_raw"))
ELBOW = {"elbow_joint": DriverJoint(name_in_state="left_elbow_joint", index_in_command=2)}
RENAMED = replace(ARM, joints=ARM.joints | ELBOW)
MOVED = replace(HAND, command_topic=replace(HAND.command_topic, name="/hand/commands"))
NOBODY = f"nobody publishes {CAMERA.image.name}.*publishes {IMAGE.type} on {IMAGE.name}"
OTHER_PROFILES: list[tuple[dict[str, Any], str, str]] = [
    ({"camera": CAMERA}, "images", NOBODY),
    ({"camera": replace(PROFILE.camera, width=848)}, "images", "640 x 480 rgb8, the profile says 848 x 480"),
    ({"robots": (ARM, MOVED)}, "commands to hand", "nobody receives /hand/commands.*/allegro_hand_pos"),
    ({"robots": (RENAMED, HAND)}, "joints of arm", "lacks left_elbow_joint; it has .*, elbow_joint"),
    ({"robots": (ARM, replace(HAND, rate_hz=333.0))}, "joints of hand", "100.0 Hz.*333 Hz are needed"),
]


@pytest.mark.parametrize(("change", "name", "words"), OTHER_PROFILES)
def test_what_differs_from_the_profile_is_named(bench: Bench, change: dict[str, Any], name: str, words: str):
    checks = bench.examine(replace(PROFILE, **change))
    assert name in bad(checks) <= {name, "pose of arm"}
    assert re.search(words, checks[name].found)


def test_a_clock_that_is_off_is_named(bench: Bench):
    bench.late = -0.2
    checks = bench.examine()
    assert bad(checks) == {"joints of arm", "joints of hand", "images"}
    assert all("-200.0 ms old" in checks[name].found for name in ("joints of arm", "joints of hand"))


def test_a_robot_that_was_stopped_is_named(bench: Bench):
    bench.ask(1, do="protective_stop")
    checks = bench.examine()
    assert bad(checks) == {"safety mode", "program", "speed scaling"}
    assert checks["safety mode"].found.startswith("3, not 1: ")
    assert "press play" in checks["program"].found
    bench.ask(do="resume")
    assert bad(bench.examine()) == set()


def test_a_small_receive_buffer_is_named(tmp_path: Path):
    path = tmp_path / "rmem_max"
    with pytest.raises(Absent, match="the system does not show it"):
        receive_buffers(path)
    path.write_text("8388608\n")
    assert receive_buffers(path) == "net.core.rmem_max is 8388608"
    path.write_text("212992\n")
    with pytest.raises(Broken, match=r"212992, less than 4000000: images are lost. 'sudo sysctl"):
        receive_buffers(path)


def test_without_a_driver_one_line_says_so(monkeypatch, capsys):
    monkeypatch.setenv("ROS_DOMAIN_ID", own_domain())
    monkeypatch.setattr("pixel2catch.deployment.laboratory.DISCOVERY", 0.1)
    monkeypatch.setattr(Doctor, "_checks", lambda self: [])  # tests/cli/test_doctor.py has them
    with pytest.raises(SystemExit, match="1"):
        main(["doctor", "--robot", "ur5e_allegro_v4", "--json"])
    checks = {each["name"]: each for each in json.loads(capsys.readouterr().out)["checks"]}
    assert checks.keys() == {"network", *OF_MACHINE}
    assert "compare ROS_DOMAIN_ID" in checks["network"]["found"]
