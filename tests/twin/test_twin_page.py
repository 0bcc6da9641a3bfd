"""The web page: what it shows is what is on the wire, and its buttons ask the twin."""

from collections.abc import Iterator
from typing import Any

import pytest
from twin_bench import PROFILE, Bench

from domains import free_port
from pixel2catch.envs.catch_env import CatchEnvCfg
from pixel2catch.evaluation.loading import load_policy, task_of
from pixel2catch.ros2.transport import RealClock
from pixel2catch.twin import RehearsalCfg
from pixel2catch.twin.simulated_lab import Phase
from pixel2catch.twin.stepped import in_step
from pixel2catch.viewer import PageCfg
from pixel2catch.viewer.twin import TwinPage


class Shown:
    """A page on a bench."""

    def __init__(self) -> None:
        task, clock = CatchEnvCfg(), RealClock()
        self.bench = Bench(task)
        self.page = TwinPage(
            PageCfg(address=f"127.0.0.1:{free_port()}"), PROFILE, self.bench.broker.node(clock), clock
        )

    @property
    def twin(self) -> dict[str, Any]:
        return self.page.page.state["twin"]

    def go_on(self, num_cycles: int = 20) -> None:
        self.bench.cycle(num_cycles)
        self.page.update()


@pytest.fixture
def shown() -> Iterator[Shown]:
    shown = Shown()
    yield shown
    shown.page.close()
    shown.bench.lab.close()


def test_buttons_prepare_and_throw(shown: Shown):
    shown.go_on()
    assert "the room is empty" in shown.twin["throw"]
    shown.page._handle({"do": "prepare"})
    shown.go_on(300)
    assert shown.bench.lab.phase is Phase.HELD
    assert shown.twin["seed"] == 1
    shown.page._handle({"do": "throw"})
    shown.go_on(30)
    assert f"{shown.bench.lab.object_name} flying" in shown.twin["throw"]
    shown.page._handle({"do": "throw"})
    shown.go_on(30)
    assert "prepare one" in shown.twin["trouble"]
    shown.page._handle({"do": "protective_stop"})
    shown.go_on(30)
    assert "press resume" in shown.twin["trouble"]


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
