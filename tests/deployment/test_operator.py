"""The operator: prompts and stop requests, the console, and keys of an input device."""

import json
import os
from collections.abc import Iterator
from functools import partialmethod
from itertools import chain, repeat
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from loop_lab import BOX, PROFILE, PassingClock, moved

from pixel2catch.cli.operate import KEYS
from pixel2catch.deployment import operator
from pixel2catch.deployment.control_loop import OperatorRequests, StepClock, read_prompt
from pixel2catch.deployment.statistics import RunStatistics
from pixel2catch.errors import DeploymentError
from pixel2catch.perception.segmenter import BoxPrompt
from pixel2catch.ros2 import messages
from pixel2catch.ros2.memory import Broker, MemoryTransport
from pixel2catch.ros2.transport import Publisher

PROMPT, STOP_TOPIC = PROFILE.operator.prompt, PROFILE.operator.stop


class Requests:
    """The requests of a control loop, and other programs that send some."""

    def __init__(self) -> None:
        self.broker, self.statistics = Broker(), RunStatistics()
        self.own = self.node()
        self.received = OperatorRequests(self.own, PROFILE.operator, self.statistics)

    def node(self) -> MemoryTransport:
        return self.broker.node(PassingClock())

    def accepts(self, *senders: Publisher) -> list[bool]:
        """Whether the prompt of each is accepted, each at another place."""
        boxes = [moved(number) for number, _ in enumerate(senders)]
        for publisher, box in zip(senders, boxes, strict=True):
            publisher.publish(messages.text(json.dumps({"box": box})))
        prompts = [*self.received.take_prompts()]
        return [BoxPrompt(box=box) in prompts for box in boxes]


@pytest.fixture
def requests() -> Requests:
    return Requests()


def test_prompts_of_a_second_program_are_refused_with_its_name_while_the_first_is_there(requests: Requests):
    """A program that has announced prompts without sending any is not the first."""
    first, others = requests.node(), requests.node()
    silent, one, two = others.publisher(PROMPT), first.publisher(PROMPT), others.publisher(PROMPT)
    assert requests.accepts(one) == [True]
    assert requests.accepts(two, one, two, silent) == [False, True, False, False]
    assert requests.received.complaint.startswith("a prompt of publisher 1 was refused: publisher 2 points")
    assert requests.statistics.refused_prompts == {"publisher 3": 2, "publisher 1": 1}
    assert requests.accepts(one) == [True]
    assert requests.received.complaint == ""
    first.close()
    assert requests.accepts(two, silent) == [True, False]


def test_stop_requests_are_counted_by_sender(requests: Requests):
    one, two = (requests.node().publisher(STOP_TOPIC) for _ in range(2))
    one.publish(messages.boolean(False))
    one.publish(b"stop")
    assert [*requests.received.take_prompts()] == []
    assert requests.received.stopped_by == ""
    two.publish(messages.boolean(True))
    assert [*requests.received.take_prompts()] == []
    assert "publisher 2" in requests.received.stopped_by
    assert requests.statistics.stop_requests == {"publisher 2": 1}


def test_without_names_of_senders_prompts_count_only_from_one_publisher(requests: Requests):
    (prompts,) = (each for each in requests.own.queues if each.topic == PROMPT)

    def is_accepted() -> bool:
        prompts.put(messages.text(json.dumps({"box": BOX})))
        return [*requests.received.take_prompts()] == [BoxPrompt(box=BOX)]

    requests.node().publisher(PROMPT)
    assert is_accepted()
    other = requests.node()
    other.publisher(PROMPT)
    assert not is_accepted()
    assert requests.statistics.refused_prompts == {"publisher 1 or publisher 2": 1}
    other.close()
    assert is_accepted()


BAD_PROMPTS = {
    **{text: text for text in ("", '{"box": [1, 2, 3]}', '{"box": [9, 9, 1, 1]}')},
    "400 digits": '{"box": [0, 0, ' + 400 * "9" + ", 9]}",
    "deep": 20_000 * "[" + 20_000 * "]",
    "infinite": '{"box": [0, 0, Infinity, 9]}',
    "not a number": '{"box": [0, 0, NaN, 9]}',
}


@pytest.mark.parametrize("text", BAD_PROMPTS.values(), ids=BAD_PROMPTS.keys())
def test_a_prompt_without_a_box_is_refused(text: str):
    with pytest.raises(DeploymentError, match="prompt"):
        read_prompt(messages.text(text))


STATUS = {"mode": "run", "message": "", "stopped_by": [], "refused": [], "found": ["dead man"]}


class Statuses(operator.OperatorConsole):
    """A console, and two programs that publish a status."""

    def __init__(self) -> None:
        clock, broker = StepClock(lambda _: None), Broker()
        super().__init__(broker.node(clock), PROFILE.operator, clock)
        self.others = [broker.node(clock) for _ in range(2)]
        self.publishers = [node.publisher(PROFILE.operator.status) for node in self.others]

    def after(self, text: str, sender: int = 0) -> dict[str, Any]:
        self.publishers[sender].publish(messages.text(text))
        self.watch()
        return self.status


def test_while_several_programs_publish_a_status_none_is_used():
    """Such as a second deployment, which is idle, while the robot runs."""
    statuses = Statuses()
    for sender, mode in enumerate(("run", "idle")):
        assert statuses.after(json.dumps(STATUS | {"mode": mode}), sender)["mode"] == "several"
    statuses.others[1].close()
    assert statuses.after(json.dumps(STATUS)) == STATUS


@pytest.mark.parametrize(
    "text",
    [
        *("", "[]", '{"mode": 5}', json.dumps(STATUS | {"found": "all"})),
        *(json.dumps(STATUS | {"box": box}) for box in ([1, 2, 3], [0, 0, 1e300, np.nan])),
        json.dumps(STATUS | {"latency_ms": {"p50": "x"}}),
    ],
)
def test_an_invalid_status_changes_nothing(text: str):
    statuses = Statuses()
    statuses.others[1].close()
    statuses.after(json.dumps(STATUS))
    assert statuses.after(text) == STATUS


HOLD, ARM, STOP, OTHER = 35, 30, 57, 31  # H, A, space, S


class Desk:
    """An operator with an input device, a pipe, and a subscriber; time passes while the operator waits."""

    def __init__(self, path: Path) -> None:
        os.mkfifo(path)
        self.device = os.open(path, os.O_RDWR | os.O_NONBLOCK)  # a reader as well, so that it opens at once
        self.switches = operator.Switches(path)
        self._clock, broker = StepClock(lambda moment: setattr(self._clock, "time", moment)), Broker()
        self._console = operator.OperatorConsole(broker.node(self._clock), PROFILE.operator, self._clock)
        node, names = broker.node(self._clock), ("dead_man", "arm", "stop")
        self._queues = {name: node.subscription(getattr(PROFILE.operator, name), depth=100) for name in names}

    def send(self, kind: int, code: int, value: int) -> None:
        os.write(self.device, operator.EVENT.pack(1, 2, kind, code, value))

    def press(self, *codes: int, value: int = 1) -> None:
        for code in codes:
            self.send(operator.KEY, code, value)

    release = partialmethod(press, value=0)

    def run(self, seconds: float, held_up: float = 0.0) -> None:
        """Operate for a while, in a process that is suspended for some time before its first poll [s]."""
        end = self._clock.now() + seconds + held_up
        moments = chain([self._clock.now() + held_up], repeat(0.0))

        def is_over() -> bool:
            self._clock.time = max(self._clock.time, next(moments))
            return self._clock.now() > end

        operator.operate_by_keys(self._console, self.switches, KEYS, self._clock, is_over, lambda *_: None)

    def received(self) -> dict[str, list[bool]]:
        """What was sent since the last call, by topic."""
        taken = ((name, queue.take()) for name, queue in self._queues.items())
        return {name: [messages.read_boolean(each.data) for each in sent] for name, sent in taken if sent}


@pytest.fixture
def desk(tmp_path: Path) -> Iterator[Desk]:
    desk = Desk(tmp_path / "keys")
    with desk.switches:
        yield desk


def test_a_key_is_pressed_until_its_release_or_the_loss_of_events(desk: Desk):
    assert desk.switches.poll() == []
    desk.press(HOLD)
    desk.press(HOLD, value=2)  # repeated by the system
    desk.press(OTHER)
    desk.send(4, 4, HOLD)  # a scan code
    desk.send(3, HOLD, 1)  # a stick
    assert desk.switches.poll() == [operator.Press(HOLD, True), operator.Press(OTHER, True)]
    desk.release(HOLD)
    assert desk.switches.poll() == [operator.Press(HOLD, False)]
    assert desk.switches.pressed == {OTHER}
    desk.send(operator.SYNC, operator.DROPPED, 0)
    desk.switches.poll()
    assert desk.switches.pressed == set()


def test_the_switch_is_held_with_its_key_and_released_at_the_end(desk: Desk):
    desk.press(HOLD)
    desk.run(10.5 * operator.SWITCH_TIME)
    assert desk.received() == {"dead_man": [True] * 11 + [False]}
    desk.release(HOLD)
    desk.press(OTHER)
    desk.run(0.1)
    assert desk.received() == {}


def test_keys_arm_and_stop_once_and_a_stop_comes_first(desk: Desk):
    desk.press(ARM)
    desk.release(ARM)
    desk.run(0.05)
    assert desk.received() == {"arm": [True]}
    desk.press(ARM, STOP)
    desk.run(0.05)
    assert desk.received() == {"stop": [True]}


def test_after_a_suspension_the_switch_must_be_pressed_again_and_nothing_arms(desk: Desk):
    """Presses of the meantime arrive as if they were new; a stop still counts."""
    held = {"dead_man": [True, True, False]}
    desk.press(HOLD)
    desk.run(0.05)
    assert desk.received() == held
    desk.press(ARM, STOP)
    desk.release(ARM, STOP)
    desk.run(0.05, held_up=1.0)
    assert desk.received() == {"stop": [True]}
    desk.release(HOLD)
    desk.press(HOLD)
    desk.run(0.05)
    assert desk.received() == held


def test_an_unplugged_device_releases_the_switch_and_is_an_error(desk: Desk, tmp_path: Path):
    with pytest.raises(DeploymentError, match="No such file"):
        operator.Switches(tmp_path / "none")
    desk.press(HOLD)
    os.close(desk.device)
    with pytest.raises(DeploymentError, match="plug it in"):
        desk.run(1.0)
    assert desk.received() == {"dead_man": [True, False]}
    assert desk.switches.pressed == set()
