"""The operator's side: the console and the keys that send requests and show the status."""

import errno
import json
import os
import struct
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, suppress
from itertools import chain
from math import inf
from pathlib import Path
from typing import Any, NamedTuple, final

from pixel2catch.errors import DeploymentError
from pixel2catch.ros2 import messages
from pixel2catch.ros2.profile import OperatorTopics
from pixel2catch.ros2.transport import Clock, Message, Transport

DEPTH = 64  #: Messages kept between two polls.
ANSWERS = ("caught", "reached", "dropped", "repeat")  #: What the operator can say of a throw of a series.
SWITCH_TIME = 0.04  #: Time between two messages of the switch [s]. Source: ours, a fifth of its timeout.
FARTHEST = 1e9  #: Limit of the coordinates [px] and latencies [ms] of a valid status. Source: ours.
NOTHING = {"mode": "", "message": "", "stopped_by": [], "refused": [], "found": []}
"""The entries that every status has."""


class OperatorConsole:
    """Sends the operator's requests and receives the status; call `watch` every `SWITCH_TIME` or sooner."""

    def __init__(self, transport: Transport, topics: OperatorTopics, clock: Clock) -> None:
        """Announce the requests, with the switch released."""
        requests = topics.dead_man, topics.arm, topics.stop, topics.prompt
        self._switch, self._arm, self._stop, self._prompt = map(transport.publisher, requests)
        self._statuses = transport.subscription(topics.status, DEPTH)
        self._clock, self._transport, self._status_topic = clock, transport, topics.status
        self._sent, self._next_switch = False, -inf
        self.holds = False  #: Whether the dead-man's switch is held.
        self.status: dict[str, Any] = {}  #: Newest status of the deployment; empty before the first.

    @property
    def mode(self) -> str:
        """Mode of the servo; empty before the first status."""
        return self.status.get("mode", "")

    def arm(self) -> None:
        self._arm.publish(messages.boolean(True))

    def stop(self) -> None:
        self._stop.publish(messages.boolean(True))

    def point(self, box: list[float]) -> None:
        """Point at the object: xmin, ymin, xmax, ymax [px]."""
        self._prompt.publish(messages.text(json.dumps({"box": box})))

    def answer(self, answer: str) -> None:
        """Say one of `ANSWERS` of a throw."""
        self._prompt.publish(messages.text(json.dumps({"answer": answer})))

    def watch(self) -> None:
        """Send the state of the switch: repeatedly while held, once when released. Receive the status."""
        now = self._clock.now()
        if self.holds != self._sent or (self.holds and now >= self._next_switch):
            self._switch.publish(messages.boolean(self.holds))
            self._sent, self._next_switch = self.holds, now + SWITCH_TIME
        arrived = self._statuses.take()
        found = newest(arrived, self.status)
        if arrived and self._transport.num_other_publishers(self._status_topic) > 1:
            found = NOTHING | {"mode": "several"}  # either may be that of the robot
        self.status = found if is_status(found) else self.status


def newest(arrived: list[Message], default: dict[str, Any]) -> dict[str, Any]:
    """Return the newest message that is a JSON object; the default without one."""
    for message in reversed(arrived):
        with suppress(DeploymentError):
            return messages.read_json(message.data)
    return default


def is_status(found: dict[str, Any]) -> bool:
    """Return whether a message has the entries of a status that operators and pages read."""
    box, latency = found.get("box") or [0.0] * 4, found.get("latency_ms") or {}
    lists = [found.get(name) for name in ("stopped_by", "refused", "found")]
    if not (isinstance(latency, dict) and all(isinstance(each, list) for each in (box, *lists))):
        return False
    numbers = [*box, *latency.values()]
    texts = [found.get("mode"), found.get("message"), *chain(*filter(None, lists))]
    are_numbers = all(isinstance(each, int | float) and abs(each) < FARTHEST for each in numbers)
    return len(box) == 4 and are_numbers and all(isinstance(each, str) for each in texts)


EVENT = struct.Struct("@llHHi")  #: Time (s, µs), type, code, value. Source: Linux, `struct input_event`.
SYNC, KEY = 0, 1  #: Types of events. Source: Linux, `EV_SYN` and `EV_KEY`.
DROPPED = 3  #: Code of a `SYNC` after lost events. Source: Linux, `SYN_DROPPED`.
MOST_EVENTS = 64  #: Events read at once.
DEVICES = Path("/dev/input/by-id")  #: Folder of the permanent names of input devices.


class Press(NamedTuple):
    """A key that was pressed or released."""

    code: int
    is_down: bool


@final
class Switches(AbstractContextManager["Switches"]):
    """The keys of a Linux input device: a pedal, a gamepad or a keyboard."""

    def __init__(self, device: Path) -> None:
        """Open a device such as /dev/input/by-id/usb-…-event-kbd; raise DeploymentError if that fails."""
        found = ", ".join(sorted(map(str, DEVICES.glob("*-event-*")))) or f"there is none in {DEVICES}"
        try:
            self._file = os.open(device, os.O_RDONLY | os.O_NONBLOCK)
        except OSError as error:
            denied = "add yourself to the group 'input', and log in again"
            fix = denied if error.errno == errno.EACCES else f"name an input device: {found}"
            raise DeploymentError(f"{device} cannot be opened ({error.strerror}); {fix}") from error
        with suppress(OSError):
            os.lseek(self._file, 0, os.SEEK_CUR)  # an input device cannot seek
            raise DeploymentError(f"{device} is no input device; name one: {found}")
        self.pressed: set[int] = set()  #: Codes of the keys that are pressed.

    def poll(self) -> list[Press]:
        """Return the presses and releases since the last call; raise DeploymentError without the device."""
        try:
            data = os.read(self._file, MOST_EVENTS * EVENT.size)
        except BlockingIOError:
            return []
        except OSError:
            data = b""
        if not data:
            self.pressed.clear()
            raise DeploymentError("the input device with the dead-man's switch is gone; plug it in again")
        presses: list[Press] = []
        for *_, kind, code, value in EVENT.iter_unpack(data[: len(data) // EVENT.size * EVENT.size]):
            if (kind, code) == (SYNC, DROPPED):
                self.pressed.clear()  # a release may be lost: keys must be pressed again
            elif kind == KEY and value in (0, 1):
                presses.append(Press(code, value == 1))
                (self.pressed.add if value else self.pressed.discard)(code)
        return presses

    def __exit__(self, *exception: object) -> None:
        os.close(self._file)


POLL = 0.005  #: Time between two polls of the keys [s]. Source: ours.
HELD_UP = 0.2  #: Time between two polls after which old presses do not count [s]. Source: ours.


def operate_by_keys(
    console: OperatorConsole,
    switches: Switches,
    keys: Sequence[Sequence[int]],
    clock: Clock,
    is_over: Callable[[], bool],
    report: Callable[[list[Press], dict[str, Any]], None],
) -> None:
    """Hold, arm and stop by keys until it is over; then release the switch.

    The keys are codes of those that hold, arm and stop. A key that is pressed before the start has to be
    pressed again. `report` gets the presses and the newest status in every poll. Raises as `Switches.poll`.
    """
    hold, arm, stop = keys
    try:
        now = clock.now()
        while not is_over():
            presses, before, now = switches.poll(), now, clock.now()
            down = {press.code for press in presses if press.is_down}
            if now - before > HELD_UP:  # this program was suspended: hold and arm must be pressed again
                switches.pressed.clear()
                down.difference_update(arm)
            console.holds = not switches.pressed.isdisjoint(hold)
            console.watch()
            if not down.isdisjoint(stop):
                console.stop()
            elif not down.isdisjoint(arm):
                console.arm()
            report(presses, console.status)
            clock.sleep_until(clock.now() + POLL)
    finally:
        console.holds = False
        console.watch()
