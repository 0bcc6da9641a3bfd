"""The lab on the wire, cycle by cycle, and its page: what is on the topics, and when."""

from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from twin_bench import PROFILE, START, Bench

from domains import free_port
from pixel2catch.envs.catch_env import CatchEnvCfg
from pixel2catch.errors import DeploymentError
from pixel2catch.evaluation.loading import load_policy, task_of
from pixel2catch.ros2 import messages
from pixel2catch.ros2.memory import Broker
from pixel2catch.ros2.profile import Profile
from pixel2catch.ros2.transport import RealClock
from pixel2catch.scene.constants import CONTROL_DT
from pixel2catch.twin import RehearsalCfg
from pixel2catch.twin.drivers import CYCLE, LATENCY
from pixel2catch.twin.lab_node import LabNode
from pixel2catch.twin.simulated_lab import Phase
from pixel2catch.twin.stepped import in_step
from pixel2catch.viewer import PageCfg
from pixel2catch.viewer.twin import TwinPage

TASK = CatchEnvCfg()
EXACT = replace(TASK, sensing=replace(TASK.sensing, joint_noise=0.0, joint_bias=0.0))
ARM, HAND = (tuple(part.joints.values()) for part in PROFILE.robots)


@pytest.fixture
def bench() -> Iterator[Bench]:
    bench = Bench(EXACT)
    yield bench
    bench.lab.close()


def test_arm_and_hand_share_a_topic_with_their_own_rates_and_names(bench: Bench):
    bench.cycle(500)
    readings = [messages.read_joint_state(message.data) for message in bench.queue["joints"].take()]
    arm = [reading for reading in readings if len(reading.names) == 6]
    hand = [reading for reading in readings if len(reading.names) == 16]
    assert (len(arm), len(hand), len(readings)) == (500, 100, 600)
    assert arm[0].names == tuple(sorted(theirs.name_in_state for theirs in ARM))
    assert {theirs.name_in_state for theirs in HAND} < set(hand[0].names)
    assert set(hand[0].names) == {f"ah_joint{finger}{joint}" for finger in range(4) for joint in range(4)}
    spread = dict(zip(hand[0].names, hand[0].position, strict=True))
    assert [spread[f"ah_joint{finger}0"] for finger in (1, 2, 3)] == [0.0, 0.0, 0.0]
    assert np.diff([reading.stamp for reading in arm]) == pytest.approx(np.full(499, CYCLE), abs=1e-8)
    assert arm[0].stamp == pytest.approx(START)
    assert bench.read_joints().shape == (19,)


def test_images_come_30_times_a_second_after_the_latency(bench: Bench):
    arrivals, stamps = [], []
    for _ in range(500):
        now = bench.lab_node.time
        bench.cycle()
        for message in bench.queue["image"].take():
            arrivals.append(now)
            stamps.append(messages.read_image(message.data).stamp - START)
    assert len(stamps) == 29
    assert stamps == pytest.approx([(i + 1) * CONTROL_DT for i in range(29)], abs=1e-6)
    delays = np.array(arrivals) - stamps
    assert delays.min() >= LATENCY - 1e-6
    assert delays.max() < LATENCY + CYCLE
    assert (bench.camera.num_images, bench.camera.num_late, bench.camera.num_lost) == (29, 0, 0)


def test_late_subscribers_learn_the_status_and_all_learn_of_a_stop(bench: Bench):
    bench.cycle(3)
    topics = vars(PROFILE.status)
    late = {name: bench.node.subscription(topics[name]) for name in ("safety_mode", "program_running")}
    assert messages.read_safety_mode(late["safety_mode"].take()[0].data) == 1
    assert messages.read_boolean(late["program_running"].take()[0].data) is True
    bench.ask(do="protective_stop")
    bench.cycle(12)
    assert messages.read_safety_mode(late["safety_mode"].take()[0].data) == 3
    assert messages.read_boolean(late["program_running"].take()[0].data) is False
    scaling = [messages.read_number(message.data) for message in bench.queue["speed_scaling"].take()]
    assert scaling == [100.0, 0.0, 0.0]  # after 0, 5 and 10 cycles, asked in the third
    bench.ask(do="resume")
    bench.cycle(2)
    assert messages.read_safety_mode(late["safety_mode"].take()[0].data) == 1
    assert messages.read_boolean(late["program_running"].take()[0].data) is True


def test_commands_move_the_joints_they_are_meant_for(bench: Bench):
    start = bench.lab.joints.position
    target = start + np.linspace(-0.3, 0.3, 19)
    for i in range(1, 801):
        bench.command(start + min(i / 200, 1.0) * (target - start))
        bench.cycle()
    assert bench.lab.joints.position == pytest.approx(target, abs=0.03)
    assert bench.states()[-1]["ignored"] == 0


def test_a_late_twin_takes_waiting_commands_one_by_one(bench: Bench):
    start = bench.lab.joints.position
    for i in range(1, 31):  # 30 cycles of commands, at once far more than 0.04 rad
        bench.command(start + 0.005 * i)
    for left in range(29, -1, -1):
        bench.lab_node.cycle(START, num_late=left)
    bench.command(start + 0.155)
    bench.cycle(20)
    state = bench.states()[-1]
    assert (state["ignored"], state["halted"]) == (0, False)
    bench.command(start + 0.3)
    bench.cycle(20)
    assert bench.states()[-1]["ignored"] == 1


def test_a_command_of_a_wrong_length_is_no_command(bench: Bench):
    arm, start = bench.node.publisher(PROFILE.robots[0].command_topic), bench.lab.joints.position
    for bad in (messages.float_array(start[:5]), b"\x00\x01\x00\x00"):
        arm.publish(bad)
        bench.cycle()
    bench.cycle(20)
    assert bench.lab.joints.position == pytest.approx(start, abs=1e-6)
    assert bench.states()[-1]["ignored"] == 2
    assert bench.lab_node.is_running  # no command was taken, so nobody is silent


def test_a_request_that_cannot_be_met_is_refused_with_the_reason(bench: Bench):
    for request in ({"do": "dance"}, {"do": "prepare", "seed": 2**63}, {"do": "throw"}):
        bench.ask(**request)
        bench.cycle(20)
        assert bench.states()[-1]["refused"] != "", request
        bench.ask(do="resume")
        bench.cycle(20)
        assert bench.states()[-1]["refused"] == ""


def test_another_drivers_commands_are_refused_at_the_start(bench: Bench):
    with pytest.raises(DeploymentError, match="ur5e_allegro_v4"):
        LabNode(bench.lab, Profile.load("ur5e_allegro_v5"), Broker().node(RealClock()), bench.camera)


def test_buttons_prepare_and_throw():
    bench, clock = Bench(CatchEnvCfg()), RealClock()
    node, cfg = bench.broker.node(clock), PageCfg(address=f"127.0.0.1:{free_port()}")
    with closing(bench.lab), closing(TwinPage(cfg, PROFILE, node, clock)) as page:

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
        page.close()
        assert twin.lab.outcome == "caught"
        assert page.seed == 4
        assert page.page.state["tone"] == "stopped"
        assert page.page.state["twin"]["result"] == "caught; 1 of 1 caught"
