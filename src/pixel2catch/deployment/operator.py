"""The operator's side of a deployment: the dead-man's switch, requests, and what there is to know."""

import json
from collections.abc import Callable
from contextlib import suppress
from math import inf
from typing import Any

from pixel2catch.deployment.switches import Keys, Press, Switches
from pixel2catch.errors import DeploymentError
from pixel2catch.ros2 import messages
from pixel2catch.ros2.profile import OperatorTopics
from pixel2catch.ros2.transport import Clock, Message, Transport

SWITCH_TIME = 0.04
"""Time between two messages of the dead-man's switch [s]. Source: ours, a fifth of what the servo waits."""

FARTHEST = 1e6  #: Distance from the image's corner at which no box is [px], and a latency that is none [ms].
SHOWN_LATENCIES = ("p50", "p90", "p99")  #: What is shown of the latency.
DEPTH = 64  #: Messages that are kept from one look to the next.
SEVERAL = {"mode": "several", "message": "", "stopped_by": [], "refused": [], "found": []}
"""The status while several programs say what the deployment does: nobody knows which of them is right."""

HELD_UP = 0.2  #: Time between two looks at the keys after which what they tell is old [s]. Source: ours.


class OperatorConsole:
    """What an operator has at hand; call `watch` more often than `SWITCH_TIME`."""

    def __init__(self, transport: Transport, topics: OperatorTopics, clock: Clock) -> None:
        """Announce and listen, with the switch let go."""
        self._clock = clock
        self._switch, self._arm, self._stop, self._prompt = (
            transport.publisher(topic) for topic in (topics.dead_man, topics.arm, topics.stop, topics.prompt)
        )
        self._transport, self._status_topic = transport, topics.status
        self._statuses = transport.subscription(topics.status, DEPTH)
        self._said, self._next_switch = False, -inf
        self.holds = False  #: Whether the dead-man's switch is held.
        self.status: dict[str, Any] = {}  #: Newest status of the deployment; empty before the first.

    @property
    def mode(self) -> str:
        """Mode of the servo; empty before the first status."""
        return self.status.get("mode", "")

    def arm(self) -> None:
        """Ask to arm."""
        self._arm.publish(messages.boolean(True))

    def stop(self) -> None:
        """Ask to stop."""
        self._stop.publish(messages.boolean(True))

    def point(self, box: list[float]) -> None:
        """Point at the object: xmin, ymin, xmax, ymax [px]."""
        self._prompt.publish(messages.text(json.dumps({"box": box})))

    def watch(self) -> None:
        """Say that the switch is held, or once that it was let go; hear the newest status."""
        now = self._clock.now()
        if self.holds != self._said or (self.holds and now >= self._next_switch):
            self._switch.publish(messages.boolean(self.holds))
            self._said, self._next_switch = self.holds, now + SWITCH_TIME
        arrived = self._statuses.take()
        said = newest(arrived, self.status)
        if arrived and self._transport.num_other_publishers(self._status_topic) > 1:
            said = dict(SEVERAL)  # another one's word that it stands still is not that of the robot
        self.status = said if _is_status(said) else self.status


def newest(arrived: list[Message], known: dict[str, Any]) -> dict[str, Any]:
    """The newest message of a topic of JSON that is one; the known one before where there is none."""
    for message in reversed(arrived):
        with suppress(DeploymentError):
            return messages.read_json(message.data)
    return known


def _is_status(said: dict[str, Any]) -> bool:
    """Whether it is the status of a deployment, as far as operators and pages need it."""
    box, latency = said.get("box"), said.get("latency_ms")
    if box is not None and not (isinstance(box, list) and len(box) == 4 and all(map(_is_near, box))):
        return False
    if latency is not None and not (
        isinstance(latency, dict) and all(_is_near(latency.get(name)) for name in SHOWN_LATENCIES)
    ):
        return False
    lists = [said.get(name) for name in ("stopped_by", "refused", "found")]
    if not all(isinstance(each, list) for each in lists):
        return False
    texts = [said.get("mode"), said.get("message"), *(text for each in lists for text in each or ())]
    return all(isinstance(text, str) for text in texts)


def _is_near(value: Any) -> bool:
    """Whether a value is a number that can be shown."""
    return isinstance(value, int | float) and abs(value) < FARTHEST


POLL = 0.005  #: Time between two looks at the keys [s]. Source: ours.


def operate_by_keys(
    console: OperatorConsole,
    switches: Switches,
    keys: Keys,
    clock: Clock,
    is_over: Callable[[], bool],
    report: Callable[[list[Press], dict[str, Any]], None],
) -> None:
    """Hold, arm and stop as the keys say until it is over, and let go of the switch then.

    It begins with the switch let go, whatever is pressed already. What was pressed and the newest status are
    reported all the time.

    Raises:
        DeploymentError: The device is gone.
    """
    try:
        looked = clock.now()
        while not is_over():
            presses, before, looked = switches.poll(), looked, clock.now()
            down = {press.code for press in presses if press.is_down}
            if looked - before > HELD_UP:  # this program hung: who holds or asks to arm must press anew
                switches.pressed.clear()
                down.difference_update(keys.arm)
            console.holds = not switches.pressed.isdisjoint(keys.hold)
            console.watch()
            if not down.isdisjoint(keys.stop):
                console.stop()
            elif not down.isdisjoint(keys.arm):
                console.arm()
            report(presses, console.status)
            clock.sleep_until(clock.now() + POLL)
    finally:
        console.holds = False
        console.watch()
