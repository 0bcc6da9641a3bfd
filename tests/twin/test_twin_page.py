"""The web page: what it shows is what is on the wire, and its buttons ask the twin."""

import json
import urllib.error
import urllib.request
from collections.abc import Iterator
from typing import Any

import mujoco
import numpy as np
import pytest
import torch
from twin_bench import PROFILE, Bench
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect
from websockets.typing import Origin

from domains import PATIENCE, free_port
from pixel2catch.envs.catch_env import CatchEnvCfg
from pixel2catch.evaluation.loading import load_policy, task_of
from pixel2catch.rendering.video import BOX_COLOR
from pixel2catch.robots.geometry import bare_model, first_chain
from pixel2catch.ros2 import messages
from pixel2catch.ros2.transport import RealClock
from pixel2catch.twin.config import RehearsalCfg
from pixel2catch.twin.simulated_lab import Phase
from pixel2catch.twin.stepped import in_step
from pixel2catch.viewer.config import PageCfg
from pixel2catch.viewer.twin import TwinPage
from pixel2catch.workcells.ur5e_allegro import UR5E_ALLEGRO


class Shown:
    """A page on a bench."""

    def __init__(self) -> None:
        task, clock = CatchEnvCfg(), RealClock()
        self.bench = Bench(task)
        self.page = TwinPage(
            PageCfg(port=free_port()), task.scene, PROFILE, self.bench.broker.node(clock), clock
        )
        self._status = self.bench.node.publisher(PROFILE.operator.status)

    def tell(self, **status: Any) -> None:
        nothing = {"mode": "", "message": "", "stopped_by": [], "refused": [], "found": []}
        self._status.publish(messages.text(json.dumps(nothing | status)))

    def go_on(self, num_cycles: int = 20) -> None:
        self.bench.cycle(num_cycles)
        self.page.update()


@pytest.fixture
def shown() -> Iterator[Shown]:
    shown = Shown()
    yield shown
    shown.page.close()
    shown.bench.lab.close()


def test_the_page_is_there_for_this_machine(shown: Shown):
    assert shown.page.address.startswith("http://127.0.0.1:")
    with urllib.request.urlopen(shown.page.address, timeout=PATIENCE) as answer:
        assert b"<html" in answer.read()


@pytest.mark.parametrize("origin", ["http://evil.example", "null", None])
def test_another_page_cannot_press_a_button(shown: Shown, origin: str | None):
    address = shown.page.address.replace("http://", "ws://")
    with (
        pytest.raises(InvalidStatus, match="403"),
        connect(address, origin=Origin(origin) if origin else None),
    ):
        pass
    request = urllib.request.Request(shown.page.address, headers={"Host": "evil.example"})
    with pytest.raises(urllib.error.HTTPError, match="403") as refused:
        urllib.request.urlopen(request, timeout=PATIENCE)
    refused.value.close()


def test_the_robot_is_shown_where_the_joint_states_have_it(shown: Shown):
    shown.go_on()
    palm, joints = shown.page.wire.view.bodies["palm"], shown.bench.lab.joints.position
    turned = np.zeros(3)
    mujoco.mju_rotVecQuat(turned, bare_model(UR5E_ALLEGRO).site("palm").pos, np.array(palm.wxyz))
    expected, _ = first_chain(UR5E_ALLEGRO).pose(torch.from_numpy(joints)[None, :6])
    assert palm.position + turned == pytest.approx(expected[0].numpy(), abs=0.02)  # noisy encoders


def test_buttons_prepare_and_throw(shown: Shown):
    shown.go_on()
    assert not shown.page.wire.view.thrown.visible
    shown.page.ask("prepare")
    shown.page.update()
    shown.go_on(300)
    assert shown.bench.lab.phase is Phase.HELD
    assert shown.page.wire.view.thrown.visible
    assert shown.page.wire.view.thrown.position == pytest.approx(
        shown.bench.lab.episode.throw.pos[0].numpy(), abs=1e-3
    )
    shown.page.ask("throw")
    shown.page.update()
    shown.go_on(30)
    assert "| twin: phase | flying |" in shown.page.wire.text.content


def test_the_operator_holds_arms_points_and_stops(shown: Shown):
    heard = {
        name: shown.bench.node.subscription(getattr(PROFILE.operator, name))
        for name in ("dead_man", "arm", "prompt", "stop")
    }
    page, console = shown.page, shown.page.console
    page.hold(True)
    shown.go_on()
    assert [messages.read_boolean(message.data) for message in heard["dead_man"].take()] == [True]
    page.hold(False)
    shown.go_on()
    assert [messages.read_boolean(message.data) for message in heard["dead_man"].take()] == [False]
    page.ask("prepare")
    shown.page.update()
    shown.go_on(300)
    page.point()
    console.arm()
    console.stop()
    box = shown.bench.lab.truth()["box"]
    (prompt,) = heard["prompt"].take()
    assert json.loads(messages.read_text(prompt.data))["box"] == pytest.approx(box, abs=1.0)
    assert all(len(heard[name].take()) == 1 for name in ("arm", "stop"))


@pytest.mark.slow
def test_one_button_throws_and_catches():
    policy, _ = load_policy(None)
    task = task_of(policy, physics_hz=120.0)
    with in_step(RehearsalCfg(throws=1, plain=True), task, policy) as rehearsal:
        node = rehearsal.broker.node(rehearsal.clock)
        page = TwinPage(PageCfg(port=free_port()), task.scene, PROFILE, node, rehearsal.clock)
        page.seed.value = 3
        page.catch()
        assert page.trial is not None
        page.trial.join()
        page.update()
        page.close()
        assert rehearsal.lab.outcome == "caught"
        assert page.seed.value == 4
        assert "| deploy: mode | stopped |" in page.wire.text.content


def test_what_the_deployment_sees_is_in_the_picture_and_its_state_in_the_table(shown: Shown):
    for box in ([100, 50, 120, 80], [110, 50, 130, 80]):
        shown.tell(mode="run", box=box)
        shown.go_on(30)
    assert "| deploy: mode | run |" in shown.page.wire.text.content
    assert "| dcx | 10.00 |" in shown.page.wire.text.content
    assert "| cx | 0.19 |" in shown.page.wire.text.content  # 120 of 640
    green = np.argwhere((shown.page.wire.picture.image == BOX_COLOR).all(axis=-1))
    assert (green.min(axis=0).tolist(), green.max(axis=0).tolist()) == ([50, 110], [79, 129])


def test_what_cannot_be_read_shows_nothing(shown: Shown):
    garbage = b"\x00\x01\x00\x00garbage"
    for topic in (PROFILE.camera.image, PROFILE.robots[0].state_topic, PROFILE.operator.status):
        shown.bench.node.publisher(topic).publish(garbage)
    shown.go_on(30)
    shown.tell(mode="run")
    shown.go_on(30)
    assert "| deploy: mode | run |" in shown.page.wire.text.content
