"""The web page: what it shows is what is on the wire, and its buttons ask the twin."""

from contextlib import closing
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
