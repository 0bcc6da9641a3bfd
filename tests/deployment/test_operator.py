"""The operator: prompts and stop requests, the console, and keys of an input device."""

import json
import os
from collections.abc import Iterator
from contextlib import ExitStack
from itertools import chain, repeat
from pathlib import Path

import pytest
from loop_lab import BOX, PROFILE, PassingClock, moved
from networks import MakeNode, ros_nodes

from domains import PATIENCE
from pixel2catch.cli.main import main
from pixel2catch.cli.operate import KEYS
from pixel2catch.deployment.control_loop import StepClock
from pixel2catch.deployment.operator import (
    DROPPED,
    EVENT,
    KEY,
    SWITCH_TIME,
    SYNC,
    OperatorConsole,
    OperatorRequests,
    Press,
    Switches,
    operate_by_keys,
    read_prompt,
)
from pixel2catch.deployment.statistics import RunStatistics
from pixel2catch.errors import DeploymentError
from pixel2catch.perception.segmenter import BoxPrompt
from pixel2catch.ros2 import messages
from pixel2catch.ros2.memory import Broker
from pixel2catch.ros2.transport import Publisher, Subscription, Transport

PROMPT, STOP_TOPIC = PROFILE.operator.prompt, PROFILE.operator.stop


class Requests:
    """The requests of a control loop, and other programs that send some."""

    def __init__(self) -> None:
        self.broker, self.statistics = Broker(), RunStatistics()
        self.received = OperatorRequests(self.node(), PROFILE.operator, self.statistics)

    def node(self) -> Transport:
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


def test_prompts_of_a_second_program_are_refused_with_its_name_and_counted(requests: Requests):
    """A program that has announced prompts without sending any is not the first."""
    silent, one, two = (requests.node().publisher(PROMPT) for _ in range(3))
    assert requests.accepts(one) == [True]
    assert requests.accepts(two, one, two, silent) == [False, True, False, False]
    assert requests.received.complaint.startswith("a prompt of publisher 1 was refused: publisher 2 points")
    assert requests.statistics.refused_prompts == {"publisher 3": 2, "publisher 1": 1}
    assert requests.accepts(one) == [True]
    assert requests.received.complaint == ""


def test_after_the_first_program_has_left_another_one_may_send_prompts(requests: Requests):
    before = requests.node()
    assert requests.accepts(before.publisher(PROMPT)) == [True]
    page, other = (requests.node().publisher(PROMPT) for _ in range(2))
    assert requests.accepts(page) == [False]
    before.close()
    assert requests.accepts(page, other) == [True, False]


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


@pytest.fixture
def make() -> Iterator[MakeNode]:
    with ExitStack() as stack:
        yield ros_nodes(stack)


def test_without_names_of_senders_prompts_count_only_from_one_publisher(make: MakeNode):
    node, statistics = make("deploy"), RunStatistics()
    received = OperatorRequests(node, PROFILE.operator, statistics)

    def accepts(publisher: Publisher) -> bool:
        publisher.publish(messages.text(json.dumps({"box": BOX})))
        assert node.wait(PATIENCE)
        return [*received.take_prompts()] == [BoxPrompt(box=BOX)]

    one = make("one").publisher(PROMPT)
    assert accepts(one)
    other = make("other")
    other.publisher(PROMPT)
    assert not accepts(one)
    assert statistics.refused_prompts == {"node one or node other": 1}
    other.close()
    assert accepts(one)


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


def test_while_several_programs_publish_a_status_none_is_used():
    """Such as a second deployment, which is idle, while the robot runs."""
    clock, broker = StepClock(lambda _: None), Broker()
    console = OperatorConsole(broker.node(clock), PROFILE.operator, clock)
    nodes = [broker.node(clock) for _ in range(2)]
    publishers = [node.publisher(PROFILE.operator.status) for node in nodes]
    lists = {"message": "", "stopped_by": [], "refused": [], "found": []}
    for publisher, mode in zip(publishers, ("run", "idle"), strict=True):
        publisher.publish(messages.text(json.dumps(lists | {"mode": mode})))
        console.watch()
        assert console.mode == "several"
    nodes[1].close()
    publishers[0].publish(messages.text(json.dumps(lists | {"mode": "run"})))
    console.watch()
    assert console.mode == "run"


LISTS = '"stopped_by": [], "refused": [], "found": []'


@pytest.mark.parametrize(
    "text",
    [
        *("", "[]", '{"mode": 5}', '{"mode": "run", "message": "", "found": "all"}'),
        *(
            f'{{"mode": "run", "message": "", {LISTS}, {entry}}}'
            for entry in ('"box": [1, 2, 3]', '"box": [0, 0, 1e300, NaN]', '"latency_ms": {"p50": "x"}')
        ),
    ],
)
def test_an_invalid_status_changes_nothing(text: str):
    clock, broker = StepClock(lambda _: None), Broker()
    console = OperatorConsole(broker.node(clock), PROFILE.operator, clock)
    status = broker.node(clock).publisher(PROFILE.operator.status)
    good = {"mode": "run", "message": "", "stopped_by": [], "refused": [], "found": ["dead man"]}
    for sent in (json.dumps(good), text):
        status.publish(messages.text(sent))
        console.watch()
        assert console.status == good


HOLD, ARM, STOP, OTHER = 35, 30, 57, 31  # H, A, space, S


class Device:
    """An input device: what is written to a pipe is what its keys do."""

    def __init__(self, path: Path) -> None:
        os.mkfifo(path)
        self.path = path
        self._file = os.open(path, os.O_RDWR | os.O_NONBLOCK)  # a reader as well, so that it opens at once

    def send(self, kind: int, code: int, value: int) -> None:
        os.write(self._file, EVENT.pack(1, 2, kind, code, value))

    def press(self, code: int) -> None:
        self.send(KEY, code, 1)
        self.send(SYNC, 0, 0)

    def release(self, code: int) -> None:
        self.send(KEY, code, 0)
        self.send(SYNC, 0, 0)

    def unplug(self) -> None:
        os.close(self._file)


@pytest.fixture
def device(tmp_path: Path) -> Device:
    return Device(tmp_path / "keys")


@pytest.fixture
def switches(device: Device) -> Iterator[Switches]:
    with Switches(device.path) as switches:
        yield switches


def test_a_key_is_pressed_until_its_release_or_the_loss_of_events(device: Device, switches: Switches):
    assert switches.poll() == []
    device.press(HOLD)
    device.send(KEY, HOLD, 2)  # repeated by the system
    device.press(OTHER)
    device.send(4, 4, HOLD)  # a scan code
    device.send(3, HOLD, 1)  # a stick
    assert switches.poll() == [Press(HOLD, True), Press(OTHER, True)]
    device.release(HOLD)
    assert switches.poll() == [Press(HOLD, False)]
    assert switches.pressed == {OTHER}
    device.send(SYNC, DROPPED, 0)
    switches.poll()
    assert switches.pressed == set()


def test_a_device_that_is_not_there_is_refused(tmp_path: Path):
    with pytest.raises(DeploymentError, match="No such file"):
        Switches(tmp_path / "none")


class Desk:
    """An operator with a device, and a subscriber; time passes while the operator waits."""

    def __init__(self, switches: Switches) -> None:
        self._clock, broker = StepClock(self._wait), Broker()
        self._console = OperatorConsole(broker.node(self._clock), PROFILE.operator, self._clock)
        self._switches = switches
        node = broker.node(self._clock)
        self._queues = {
            name: node.subscription(getattr(PROFILE.operator, name), depth=100)
            for name in ("dead_man", "arm", "stop")
        }

    def _wait(self, moment: float) -> None:
        self._clock.time = moment

    def run(self, seconds: float, held_up: float = 0.0) -> None:
        """Operate for a while, in a process that is suspended for some time before its first poll [s]."""
        end = self._clock.now() + seconds + held_up
        moments = chain([self._clock.now() + held_up], repeat(0.0))

        def is_over() -> bool:
            self._clock.time = max(self._clock.time, next(moments))
            return self._clock.now() > end

        operate_by_keys(self._console, self._switches, KEYS, self._clock, is_over, lambda *_: None)

    def received(self) -> dict[str, list[bool]]:
        return {name: taken(queue) for name, queue in self._queues.items()}


def taken(queue: Subscription) -> list[bool]:
    return [messages.read_boolean(message.data) for message in queue.take()]


def test_the_switch_is_held_with_its_key_and_released_at_the_end(device: Device, switches: Switches):
    desk = Desk(switches)
    device.press(HOLD)
    desk.run(10.5 * SWITCH_TIME)
    assert desk.received() == {"dead_man": [True] * 11 + [False], "arm": [], "stop": []}
    device.release(HOLD)
    device.press(OTHER)
    desk.run(0.1)
    assert desk.received()["dead_man"] == []


def test_keys_arm_and_stop_once_and_a_stop_comes_first(device: Device, switches: Switches):
    desk = Desk(switches)
    device.press(ARM)
    device.release(ARM)
    desk.run(0.05)
    assert desk.received() == {"dead_man": [], "arm": [True], "stop": []}
    device.press(ARM)
    device.press(STOP)
    desk.run(0.05)
    assert desk.received() == {"dead_man": [], "arm": [], "stop": [True]}


def test_after_a_suspension_the_switch_must_be_pressed_again_and_nothing_arms(
    device: Device, switches: Switches
):
    """Presses of the meantime arrive as if they were new; a stop still counts."""
    desk = Desk(switches)
    device.press(HOLD)
    desk.run(0.05)
    assert desk.received()["dead_man"] == [True, True, False]
    for key in (ARM, STOP):
        device.press(key)
        device.release(key)
    desk.run(0.05, held_up=1.0)
    assert desk.received() == {"dead_man": [], "arm": [], "stop": [True]}
    device.release(HOLD)
    device.press(HOLD)
    desk.run(0.05)
    assert desk.received()["dead_man"] == [True, True, False]


def test_an_unplugged_device_releases_the_switch_and_is_an_error(device: Device, switches: Switches):
    desk = Desk(switches)
    device.press(HOLD)
    device.unplug()
    with pytest.raises(DeploymentError, match="plug it in"):
        desk.run(1.0)
    assert desk.received()["dead_man"] == [True, False]
    assert switches.pressed == set()


def test_the_command_without_a_switch_is_refused(capsys: pytest.CaptureFixture[str]):
    assert main(["operate"]) == 2
    assert "--web" in capsys.readouterr().err
