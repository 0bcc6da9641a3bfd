"""Keys of an input device as the operator's switches: a pipe that speaks as Linux's devices do."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack
from itertools import chain, repeat
from pathlib import Path

import pytest
from loop_lab import PROFILE
from networks import dds_nodes

from domains import PATIENCE, own_domain
from pixel2catch.cli.main import main
from pixel2catch.deployment.operator import SWITCH_TIME, OperatorConsole, operate_by_keys
from pixel2catch.deployment.stepped import StepClock
from pixel2catch.deployment.switches import DROPPED, EVENT, KEY, SYNC, Keys, Press, Switches
from pixel2catch.errors import DeploymentError
from pixel2catch.ros2 import messages
from pixel2catch.ros2.memory import Broker
from pixel2catch.ros2.transport import Subscription

HOLD, ARM, STOP, OTHER = 57, 28, 1, 30
REPEATED = 2


class Device:
    """An input device: what is written to a pipe is what its keys do."""

    def __init__(self, path: Path) -> None:
        os.mkfifo(path)
        self.path = path
        self._file = os.open(path, os.O_RDWR | os.O_NONBLOCK)  # a reader, too, so that it opens at once

    def tell(self, kind: int, code: int, value: int) -> None:
        os.write(self._file, EVENT.pack(1, 2, kind, code, value))

    def press(self, code: int) -> None:
        self.tell(KEY, code, 1)
        self.tell(SYNC, 0, 0)

    def release(self, code: int) -> None:
        self.tell(KEY, code, 0)
        self.tell(SYNC, 0, 0)

    def unplug(self) -> None:
        os.close(self._file)


@pytest.fixture
def device(tmp_path: Path) -> Device:
    return Device(tmp_path / "keys")


@pytest.fixture
def switches(device: Device) -> Iterator[Switches]:
    with Switches(device.path) as switches:
        yield switches


def test_keys_are_down_from_the_press_to_the_release(device: Device, switches: Switches):
    assert switches.poll() == []
    device.press(HOLD)
    device.tell(KEY, HOLD, REPEATED)
    device.press(OTHER)
    assert switches.poll() == [Press(code=HOLD, is_down=True), Press(code=OTHER, is_down=True)]
    assert switches.pressed == {HOLD, OTHER}
    device.release(HOLD)
    assert switches.poll() == [Press(code=HOLD, is_down=False)]
    assert switches.pressed == {OTHER}


def test_what_is_no_key_is_none(device: Device, switches: Switches):
    device.tell(4, 4, HOLD)  # a scan code
    device.tell(3, HOLD, 1)  # a stick
    assert switches.poll() == []


def test_where_events_are_missing_nothing_counts_as_held(device: Device, switches: Switches):
    device.press(HOLD)
    device.tell(SYNC, DROPPED, 0)
    switches.poll()
    assert switches.pressed == set()


def test_a_device_that_is_gone_holds_nothing_and_says_so(device: Device, switches: Switches):
    device.press(HOLD)
    switches.poll()
    device.unplug()
    with pytest.raises(DeploymentError, match="plug it in"):
        switches.poll()
    assert switches.pressed == set()


def test_a_device_that_is_not_there_is_refused(tmp_path: Path):
    with pytest.raises(DeploymentError, match="No such file"):
        Switches(tmp_path / "none")


class Desk:
    """An operator with a device, and who hears of it; time goes on as the operator waits."""

    def __init__(self, switches: Switches) -> None:
        self._clock, broker = StepClock(self._wait), Broker()
        self._console = OperatorConsole(broker.node(self._clock), PROFILE.operator, self._clock)
        self._switches = switches
        node = broker.node(self._clock)
        self._heard = {
            name: node.subscription(getattr(PROFILE.operator, name), depth=100)
            for name in ("dead_man", "arm", "stop")
        }

    def _wait(self, moment: float) -> None:
        self._clock.time = moment

    def run(self, seconds: float, held_up: float = 0.0) -> None:
        """Operate for a while, in a process that is held up for some time before its first look [s]."""
        end = self._clock.now() + seconds + held_up
        moments = chain([self._clock.now() + held_up], repeat(0.0))

        def is_over() -> bool:
            self._clock.time = max(self._clock.time, next(moments))
            return self._clock.now() > end

        operate_by_keys(self._console, self._switches, Keys(), self._clock, is_over, lambda *_: None)

    def heard(self) -> dict[str, list[bool]]:
        """What was heard since the last call."""
        return {name: taken(queue) for name, queue in self._heard.items()}


def taken(queue: Subscription) -> list[bool]:
    return [messages.read_boolean(message.data) for message in queue.take()]


def test_the_switch_is_held_while_the_key_is_and_let_go_at_the_end(device: Device, switches: Switches):
    desk = Desk(switches)
    device.press(HOLD)
    desk.run(10.5 * SWITCH_TIME)
    assert desk.heard() == {"dead_man": [True] * 11 + [False], "arm": [], "stop": []}


def test_a_released_key_is_told_at_once_and_once(device: Device, switches: Switches):
    desk = Desk(switches)
    device.press(HOLD)
    device.release(HOLD)
    desk.run(0.1)
    assert desk.heard()["dead_man"] == []
    device.press(OTHER)
    desk.run(0.1)
    assert desk.heard()["dead_man"] == []


def test_keys_arm_and_stop_once_and_a_stop_comes_first(device: Device, switches: Switches):
    desk = Desk(switches)
    device.press(ARM)
    device.release(ARM)
    desk.run(0.05)
    assert desk.heard() == {"dead_man": [], "arm": [True], "stop": []}
    device.press(ARM)
    device.press(STOP)
    desk.run(0.05)
    assert desk.heard() == {"dead_man": [], "arm": [], "stop": [True]}


def test_after_a_hold_up_the_switch_must_be_pressed_anew_and_nothing_arms(device: Device, switches: Switches):
    """What was pressed meanwhile is told as if it were pressed now; a stop is a stop."""
    desk = Desk(switches)

    device.press(HOLD)
    desk.run(0.05)
    assert desk.heard()["dead_man"] == [True, True, False]
    for key in (ARM, STOP):
        device.press(key)
        device.release(key)
    desk.run(0.05, held_up=1.0)
    assert desk.heard() == {"dead_man": [], "arm": [], "stop": [True]}
    desk.run(0.05)
    assert desk.heard()["dead_man"] == []
    device.release(HOLD)
    device.press(HOLD)
    desk.run(0.05)
    assert desk.heard()["dead_man"] == [True, True, False]


def test_without_the_device_the_switch_is_let_go(device: Device, switches: Switches):
    desk = Desk(switches)
    device.press(HOLD)
    device.unplug()
    with pytest.raises(DeploymentError, match="gone"):
        desk.run(1.0)
    assert desk.heard()["dead_man"] == [True, False]


def test_the_command_speaks_over_dds_until_its_end(device: Device, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("ROS_DOMAIN_ID", own_domain())
    command = [sys.executable, "-m", "pixel2catch", "operate", str(device.path)]
    with ExitStack() as stack:
        node = dds_nodes(stack)("laboratory")
        queue = node.subscription(PROFILE.operator.dead_man, depth=1000)
        process = stack.enter_context(subprocess.Popen(command, stderr=subprocess.PIPE))
        stack.callback(process.kill)
        assert process.stderr is not None
        assert b"network: lo, the digital twin on this machine" in process.stderr.readline()
        assert b"listening" in process.stderr.readline()
        device.press(HOLD)
        said = until(queue, 3)
        process.send_signal(signal.SIGINT)
        assert process.wait(PATIENCE) == 0
        assert said[:3] == [True, True, True]
        while said[-1]:
            said += until(queue, 1)
        assert said[-1] is False


def test_a_command_without_a_switch_is_refused(capsys: pytest.CaptureFixture[str]):
    assert main(["operate"]) == 2
    assert "--web" in capsys.readouterr().err


def until(queue: Subscription, num: int) -> list[bool]:
    """What has come when so many messages have."""
    said: list[bool] = []
    end = time.monotonic() + PATIENCE
    while len(said) < num:
        assert time.monotonic() < end
        said += taken(queue)
        time.sleep(0.01)
    return said


LISTS = '"stopped_by": [], "refused": [], "found": []'


def test_where_several_programs_say_the_status_none_is_believed():
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


@pytest.mark.parametrize(
    "text",
    [
        *("", "[]", "{}", 20_000 * "[", '{"mode": 5}', '{"mode": "run", "message": "", "found": "all"}'),
        *(
            f'{{"mode": "run", "message": "", {LISTS}, "box": {box}}}'
            for box in ("5", "[1, 2, 3]", '[1, 2, 3, "x"]', "[0, 0, Infinity, NaN]", "[0, 0, 1e300, 9]")
        ),
        *(
            f'{{"mode": "run", "message": "", {LISTS}, "latency_ms": {ms}}}'
            for ms in ("22.5", "{}", '{"p50": 1, "p90": "2", "p99": 3}', '{"p50": 1, "p90": NaN, "p99": 3}')
        ),
    ],
)
def test_a_status_that_is_none_changes_nothing(text: str):
    clock, broker = StepClock(lambda _: None), Broker()
    console = OperatorConsole(broker.node(clock), PROFILE.operator, clock)
    status = broker.node(clock).publisher(PROFILE.operator.status)
    good = {"mode": "run", "message": "", "stopped_by": [], "refused": [], "found": ["dead man"]}
    for said in (json.dumps(good), text):
        status.publish(messages.text(said))
        console.watch()
        assert console.status == good
