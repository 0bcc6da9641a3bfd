"""The page to play with, as its visitors use it, and its throws one by one."""

import re
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing
from dataclasses import replace
from itertools import islice
from typing import Any

import numpy as np
import pytest

from domains import PATIENCE, free_port, until
from pixel2catch.errors import UnknownNameError
from pixel2catch.scene.constants import OBJECT_POS
from pixel2catch.scene.scene import SceneCfg
from pixel2catch.viewer import PageCfg
from pixel2catch.viewer.play import PlayPage
from pixel2catch.viewer.stage import Playback
from pixel2catch.viewer.throws import ThrowOrder, ThrowPlayer, ThrowStep

CUBE = ThrowOrder(policy="catch_alone+fit", objects="cube_s")


class Visited:
    def __init__(self, pool: ThreadPoolExecutor) -> None:
        self.page = PlayPage(PageCfg(address=f"127.0.0.1:{free_port()}"), ThrowPlayer(), CUBE, seed=3)
        self.page.playback.set(speed=100.0)  # as fast as it goes
        self.playing: Future[None] = pool.submit(self.page.run)

    def wait_for(self, is_true: Callable[[], Any]) -> None:
        until(lambda: self.playing.done() or is_true())
        assert not self.playing.done(), self.playing.exception()


@pytest.fixture
def visited() -> Iterator[Visited]:
    with ThreadPoolExecutor(1) as pool:
        visited = Visited(pool)
        yield visited
        visited.page.close()
        visited.playing.result(PATIENCE)
        visited.page.free()


def test_a_throw_is_shown_counted_kept_and_shown_again(visited: Visited):
    page = visited.page
    page.is_repeated.value = False
    page.throw()
    visited.wait_for(lambda: page.throws)
    assert page.throws[1].outcome in page.stage.text.content
    assert "1 of 1" in page.rates.content
    num_frames = len(page.throws[1].steps)
    visited.wait_for(lambda: page.stage.num_pictures >= num_frames)
    page.show_again(1)
    visited.wait_for(lambda: page.stage.num_pictures >= 2 * num_frames)
    visited.wait_for(lambda: "throw 1: cube_s **caught" in page.stage.text.content)
    assert len(page.throws) == 1
    caught = page.throws[1].steps[-1].exposure.moment.qpos[OBJECT_POS]
    palm = np.array(page.stage.view.bodies["palm"].position)
    assert np.linalg.norm(palm - caught) < 0.2
    page.disturbance.value = "latency 5 steps"
    visited.wait_for(lambda: "no throw like this" in page.rates.content)
    assert page.order.disturbance == "latency 5 steps"
    page.stage.set_scene(SceneCfg(workcell="fr3_allegro"))
    assert "fr3_link7" in page.stage.view.bodies


def test_a_visitor_plays(visited: Visited, browser_page: Any):
    """Loads, throws, catches; pause acts; nothing is wrong in the browser."""
    page, wrong = visited.page, []
    page.is_repeated.value = False  # else throws are counted on, however long a busy browser takes to tell
    browser_page.on("console", lambda said: wrong.append(said.text) if said.type == "error" else None)
    browser_page.on("pageerror", lambda error: wrong.append(str(error)))
    browser_page.goto(page.server.address)
    browser_page.get_by_text(re.compile("S.R. 100 %")).wait_for()
    browser_page.get_by_text("1 of 1").wait_for()
    assert len(np.unique(np.frombuffer(browser_page.locator("canvas").first.screenshot(), np.uint8))) > 100

    browser_page.get_by_label("pause").click()
    visited.wait_for(lambda: page.playback.is_paused)
    browser_page.get_by_label("pause").click()
    visited.wait_for(lambda: not page.playback.is_paused)
    browser_page.get_by_role("button", name="throw", exact=True).click()
    visited.wait_for(lambda: 2 in page.throws)
    page.is_repeated.value = False
    browser_page.get_by_role("button", name=re.compile("^1 ")).click()
    browser_page.get_by_text("throw 1: cube_s caught").wait_for()
    assert not wrong


def test_unknown_objects_are_refused_before_there_is_a_page():
    with pytest.raises(UnknownNameError, match="teapot"):
        PlayPage(PageCfg(), ThrowPlayer(), replace(CUBE, objects="teapot"))


def test_late_pictures_are_not_made_up_for_without_end():
    playback = Playback()
    playback.begin()
    time.sleep(0.3)
    begin = time.monotonic()
    for _ in range(10):
        playback.wait(0.05)
    assert time.monotonic() - begin > 0.3  # 0.5 s, of which 0.1 s may be made up for


def test_nobody_waits_after_an_interruption():
    playback = Playback()
    playback.begin()
    playback.set(is_paused=True)
    with ThreadPoolExecutor(1) as pool:
        waiting = pool.submit(playback.wait, 1000.0)
        playback.interrupt()
        assert not waiting.result(PATIENCE)
    assert not playback.wait(1000.0)
    playback.begin()
    playback.set(is_paused=False)
    assert playback.wait(0.0)


def object_pos(step: ThrowStep) -> np.ndarray:
    return step.exposure.moment.qpos[OBJECT_POS]


def test_a_throw_flies_along_its_path_is_caught_and_comes_again_from_its_seed():
    """In air, which bends the path."""
    order = replace(CUBE, disturbance="air 30 g")
    with closing(ThrowPlayer()) as thrower:
        task = thrower.task(order)
        assert task.randomization.air_density == 1.2
        *_, first = thrower.run(order, seed=3)
        assert first.outcome == "caught and held"
        assert first.is_success
        flight = [step for step in first.steps if 0.0 <= step.exposure.moment.time < 0.4]
        path = first.path[::-1]  # towards the robot, x falls
        for step in flight[::4]:
            pos = object_pos(step)
            expected = [np.interp(pos[0], path[:, 0], path[:, i]) for i in range(3)]
            assert pos == pytest.approx(expected, abs=0.02)
        gone = object_pos(flight[-1]) - object_pos(flight[0])
        assert np.linalg.norm(gone) > 1.0
        assert flight[0].exposure.moment.time == pytest.approx(0.0, abs=1 / 30)
        *_, again = islice(thrower.run(order, seed=3), 15)
        assert again.number == first.number + 1
        for step, same in zip(again.steps, first.steps, strict=False):
            assert (step.exposure.moment.qpos == same.exposure.moment.qpos).all()
