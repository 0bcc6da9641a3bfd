"""The operator's page: what a browser asks for, what the servo makes of it, and what the page says."""

import json
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from typing import Any

import numpy as np
import pytest
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect
from websockets.sync.connection import Connection
from websockets.typing import Origin

from domains import PATIENCE, free_port, until
from pixel2catch.deployment.control_loop import StepClock
from pixel2catch.deployment.operator import OperatorConsole
from pixel2catch.errors import DeploymentError
from pixel2catch.ros2 import messages
from pixel2catch.ros2.memory import Broker
from pixel2catch.ros2.profile import Profile
from pixel2catch.viewer import PageCfg
from pixel2catch.viewer.operator_page import REFUSAL_TIME, OperatorPage, box_in_image
from pixel2catch.viewer.visitors import HeldButton

PROFILE = Profile.load("ur5e_allegro_v4")
OPERATOR = PROFILE.operator
WAITS = {"mode": "idle", "stopped_by": [], "refused": [], "found": ["dead man"], "message": ""}
WORDS = "robot ur5e_allegro, profile ur5e_allegro_v4, network lo, clock 1"


class Desk:
    """A page and the network beside it, whose time goes on by hand."""

    def __init__(self, *, has_switch: bool = True) -> None:
        self.clock, broker = StepClock(self._wait), Broker()
        self.node = broker.node(self.clock)
        page_node = broker.node(self.clock)
        self.console = OperatorConsole(page_node, OPERATOR, self.clock)
        self.page = OperatorPage(
            PageCfg(address=f"127.0.0.1:{free_port()}"),
            "desk",
            PROFILE,
            page_node,
            self.clock,
            self.console,
            button=HeldButton(PATIENCE) if has_switch else None,
            words=WORDS,
        )
        self.heard = {
            name: self.node.subscription(getattr(OPERATOR, name), depth=1000)
            for name in ("dead_man", "arm", "stop", "prompt")
        }
        self.status = self.node.publisher(OPERATOR.status)

    def _wait(self, moment: float) -> None:
        self.clock.time = moment

    def tell(self, **status: Any) -> None:
        self.status.publish(messages.text(json.dumps(WAITS | status)))

    def go_on(self, seconds: float = 0.02) -> dict[str, Any]:
        """What the page says a moment later."""
        self.clock.time += seconds
        self.console.holds = self.page.is_held
        self.console.watch()
        self.page.update()
        return self.page.state

    def until(self, is_true: Callable[[], Any]) -> None:
        """Go on until something is true, no faster than real time, in which a browser answers."""
        until(is_true, lambda: self.go_on(0.001))

    def taken(self, name: str) -> list[Any]:
        read = messages.read_json if name == "prompt" else messages.read_boolean
        return [read(message.data) for message in self.heard[name].take()]


@contextmanager
def link(address: str) -> Iterator[Connection]:
    with connect(
        f"{address.replace('http', 'ws')}/link", origin=Origin(address), open_timeout=PATIENCE
    ) as visitor:
        yield visitor


def consume(visitor: Connection) -> None:
    while True:
        visitor.recv(PATIENCE)


def ask(visitor: Connection, do: Any, heard: Any = 0.0, **more: Any) -> None:
    visitor.send(json.dumps({"do": do, "heard": heard, **more}))


def error_of(visitor: Connection) -> str:
    """The next one that the page is told of."""
    while not (error := json.loads(visitor.recv(PATIENCE)).get("error")):
        pass
    return error


@pytest.fixture
def desk() -> Iterator[Desk]:
    desk = Desk()
    yield desk
    desk.page.close()


def test_the_switch_is_held_while_its_holder_says_so():
    now = [0.0]
    button, me, other = HeldButton(0.25, lambda: now[0]), object(), object()
    assert button.holder is None
    button.press(me)
    for time_ in (0.2, 0.4, 0.6):
        now[0] = time_
        button.keep(me)
        assert button.holder is me
    with pytest.raises(DeploymentError, match="another page"):
        button.press(other)
    button.let_go(other)
    assert button.holder is me
    now[0] = 0.86  # silent for 0.26 s
    assert button.holder is None
    with pytest.raises(DeploymentError, match="was released"):
        button.keep(me)
    assert button.holder is None
    button.press(other)
    button.drop()
    assert button.holder is None


def test_a_stop_is_sent_at_once_and_again_until_it_is_heard(desk: Desk):
    with link(desk.page.address) as visitor:
        desk.tell(mode="run", found=[])
        desk.go_on()
        ask(visitor, "press")
        desk.until(lambda: desk.console.holds)
        ask(visitor, "stop")
        until(lambda: desk.taken("stop"))  # before the page goes on
        assert desk.go_on()["num_heard"] == 0
        assert not desk.page.is_held
        assert desk.taken("dead_man")[-1] is False
        assert desk.taken("stop")
        desk.tell(mode="run", found=[])
        assert desk.go_on()["num_heard"] == 0
        desk.tell(mode="stopped", stopped_by=["stop request"])
        with closing(desk.node.broker.node(desk.clock)) as other:  # such as a second deployment
            other.publisher(OPERATOR.status)
            assert desk.go_on()["num_heard"] == 0
        desk.tell(mode="stopped", stopped_by=["stop request"])
        state = desk.go_on()
        assert (state["num_heard"], state["tone"]) == (1, "stopped")
        assert state["headline"] == "stopped: a stop was requested"
        desk.taken("stop")
        desk.go_on()
        assert desk.taken("stop") == []


def test_the_switch_falls_with_the_connection(desk: Desk):
    with link(desk.page.address) as visitor:
        ask(visitor, "press")
        desk.until(lambda: desk.console.holds)
    desk.until(lambda: not desk.console.holds)
    assert desk.taken("dead_man")[-1] is False


def test_operating_ends_with_a_released_switch(desk: Desk):
    with link(desk.page.address) as visitor:
        ask(visitor, "press")
        desk.page.operate(lambda: desk.console.holds, lambda _: None)
        assert desk.taken("dead_man") == [True, False]


def test_beside_a_pedal_the_page_has_no_switch():
    desk = Desk(has_switch=False)
    with closing(desk.page), link(desk.page.address) as visitor:
        ask(visitor, "press")
        assert "no request" in error_of(visitor)
        assert not desk.go_on()["has_switch"]


def test_who_says_what_no_page_says_is_cut_off(desk: Desk):
    for said in ("[]", "1" * 2000, b"\x00"):
        with link(desk.page.address) as visitor:
            visitor.send(said)
            with pytest.raises(ConnectionClosed, match="not a request"):
                consume(visitor)


def test_what_cannot_be_done_is_said_to_who_asked(desk: Desk):
    with link(desk.page.address) as visitor:
        for do in (None, 5, "point", "fly", "hold"):
            ask(visitor, do, box=[1, 2, 3])
            assert "too late" not in error_of(visitor)


@pytest.mark.parametrize("heard", [-0.7, None])
def test_presses_that_waited_neither_hold_nor_arm_but_stop(heard: Any, desk: Desk):
    """Of a tab that slept, or from while this program hung; the browser's own clock is not asked."""
    with link(desk.page.address) as visitor:
        for do in ("press", "hold", "arm", "point"):
            ask(visitor, do, heard, box=[0, 0, 9, 9])
            assert "too late" in error_of(visitor)
        assert (desk.page.is_held, desk.taken("arm"), desk.taken("prompt")) == (False, [], [])
        ask(visitor, "press", desk.go_on()["time"])
        desk.until(lambda: desk.console.holds)
        for do, is_done in (("let_go", lambda: not desk.console.holds), ("stop", lambda: desk.taken("stop"))):
            ask(visitor, do, heard)
            desk.until(is_done)


@pytest.mark.parametrize(
    ("box", "expected"),
    [
        ([10, 20, 30.5, 40], [10.0, 20.0, 30.5, 40.0]),
        ([-5, -5, 10, 10], [0.0, 0.0, 10.0, 10.0]),
        ([600, 470, 700, 1e300], [600.0, 470.0, 640.0, 480.0]),
        *((box, None) for box in ([30, 40, 10, 20], [0, 0, 2, 9], [700, 10, 720, 30], [0, 0, True, 9])),
        *((box, None) for box in ([0, 0, float("nan"), 9], "box", None, [1, 2, 3, "4"])),
    ],
)
def test_a_box_is_that_in_the_image(box: Any, expected: list[float] | None):
    if expected:
        assert box_in_image(box, PROFILE.camera) == expected
    else:
        with pytest.raises(DeploymentError):
            box_in_image(box, PROFILE.camera)


LATENCY = {"p50": 20.0, "p90": 21.0, "p99": 25.0, "max": 30.0}


def test_words_follow_the_statuses(desk: Desk):
    assert desk.go_on()["tone"] == "absent"
    desk.tell(refused=["dead man", "switch not pressed"], latency_ms=LATENCY, verdict="not found")
    state = desk.go_on()
    assert state["headline"] == "waiting: hold the switch and press arm"
    assert state["refusal"] == "Arming was refused: the dead-man's switch is not held. Hold the switch."
    assert state["sight"] == "perception has lost the object: point at it"
    assert state["latency_ms"] == LATENCY
    desk.tell()
    assert desk.go_on(0.9 * REFUSAL_TIME)["refusal"]
    desk.tell(mode="armed")
    assert not desk.go_on()["refusal"]
    assert desk.go_on(1.5)["headline"] == "no status of a deployment is received"


def test_the_page_says_which_robot_and_how_fast_and_where_it_differs(desk: Desk):
    assert desk.go_on()["robot"] == WORDS
    fast = f"{WORDS}; joints up to: arm 2.79 rad/s"
    desk.tell(robot=fast)
    assert desk.go_on()["robot"] == fast
    desk.tell(robot=fast.replace("clock 1", "clock 0.5"))
    assert desk.go_on()["robot"].endswith(f"; but this program: {WORDS}")


def test_texts_of_the_network_have_no_control_characters(desk: Desk):
    desk.tell(message="\x1b]0;owned\x07 a\nb", found=["\x9b31m"], robot="\u202e")
    state = desk.go_on()
    assert state["message"] == "\ufffd]0;owned\ufffd a\ufffdb"
    assert "\ufffd31m" in state["headline"]
    assert "\u202e" not in str(state)


def is_on(box: Any) -> Callable[[float, float], tuple[float, float]]:
    """Where pixels of an image are that is shown in a box of a browser's window."""
    return lambda x, y: (box["x"] + x * box["width"] / 640, box["y"] + y * box["height"] / 480)


def test_the_switch_of_a_browser_falls_whenever_there_is_doubt(desk: Desk, browser_page: Any):
    image = desk.node.publisher(PROFILE.camera.image)
    desk.go_on()
    browser_page.goto(desk.page.address)
    hold = browser_page.locator("#hold")
    desk.until(hold.is_visible)
    box = hold.bounding_box()
    middle = (box["x"] + 0.5 * box["width"], box["y"] + 0.5 * box["height"])
    hide = "Object.defineProperty(document, 'hidden', {value: true}); document.dispatchEvent(new Event('%s'))"
    for let_go in (
        browser_page.mouse.up,
        lambda: browser_page.mouse.move(5, 300),
        lambda: browser_page.evaluate("dispatchEvent(new Event('blur'))"),
        lambda: browser_page.evaluate(hide % "visibilitychange"),
    ):
        browser_page.mouse.move(*middle)
        browser_page.mouse.down()
        desk.until(lambda: desk.console.holds)
        let_go()
        desk.until(lambda: not desk.console.holds)
        browser_page.mouse.up()
    desk.taken("prompt")
    pixels = np.full((480, 640, 3), 90, np.uint8)
    image.publish(messages.image(pixels, 0.0))
    at = is_on(browser_page.locator("#image").bounding_box())
    browser_page.mouse.move(*at(300, 120))
    browser_page.mouse.down()
    browser_page.mouse.move(*at(200, 160))
    browser_page.mouse.up()
    prompts: list[Any] = []
    desk.until(lambda: prompts.extend(desk.taken("prompt")) or prompts)
    assert prompts[0]["box"] == pytest.approx([200, 120, 300, 160], abs=1.0)
    for stop in (browser_page.locator("#stop").click, lambda: browser_page.keyboard.press("Escape")):
        desk.taken("stop")
        stop()
        desk.until(lambda: desk.taken("stop"))
        desk.until(lambda: "was not confirmed" in browser_page.locator("#heard").text_content())
        desk.tell(mode="stopped")
        desk.until(lambda: "was confirmed after" in browser_page.locator("#heard").text_content())
        desk.taken("stop")
        desk.go_on()
        assert desk.taken("stop") == []
    for let_go in (
        lambda: browser_page.keyboard.up("h"),
        lambda: browser_page.evaluate("dispatchEvent(new KeyboardEvent('keyup', {code: 'KeyH'}))"),
        browser_page.close,
    ):
        browser_page.keyboard.down("h")
        desk.until(lambda: desk.console.holds)
        let_go()
        desk.until(lambda: not desk.console.holds)
        if not browser_page.is_closed():
            browser_page.keyboard.up("h")


def test_stop_is_in_sight_in_a_window_of_any_size(desk: Desk, browser_page: Any):
    desk.go_on()
    browser_page.goto(desk.page.address)
    stop = browser_page.locator("#stop")
    desk.until(stop.is_visible)
    for width, height in ((320, 240), (900, 300), (400, 700)):
        browser_page.set_viewport_size({"width": width, "height": height})
        for end in ("0", "document.documentElement.scrollHeight"):
            browser_page.evaluate(f"scrollTo(0, {end})")
            stop_box = stop.bounding_box()
            assert stop_box["x"] >= 0.0
            assert stop_box["y"] >= 0.0
            assert stop_box["x"] + stop_box["width"] <= width
            assert stop_box["y"] + stop_box["height"] <= height
