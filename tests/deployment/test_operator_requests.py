"""Who points at the object, and who asked to stop."""

import json
from collections.abc import Iterator
from contextlib import ExitStack

import pytest
from loop_lab import BOX, PROFILE, PassingClock, moved
from networks import MakeNode, ros_nodes

from domains import PATIENCE
from pixel2catch.deployment.operator_requests import OperatorRequests
from pixel2catch.deployment.statistics import RunStatistics
from pixel2catch.perception.segmenter import BoxPrompt
from pixel2catch.ros2 import messages
from pixel2catch.ros2.memory import Broker
from pixel2catch.ros2.transport import Publisher, Transport

PROMPT, STOP = PROFILE.operator.prompt, PROFILE.operator.stop


class Requests:
    """Who listens, and others who point or stop."""

    def __init__(self) -> None:
        self.broker, self.statistics = Broker(), RunStatistics()
        self.heard = OperatorRequests(self.node(), PROFILE.operator, self.statistics)

    def node(self) -> Transport:
        return self.broker.node(PassingClock())

    def heeds(self, *pointing: Publisher) -> list[bool]:
        """Who is heeded of those who point at something in turn, each at another place."""
        boxes = [moved(number) for number, _ in enumerate(pointing)]
        for publisher, box in zip(pointing, boxes, strict=True):
            publisher.publish(messages.text(json.dumps({"box": box})))
        prompts = [*self.heard.take()]
        return [BoxPrompt(box=box) in prompts for box in boxes]


@pytest.fixture
def requests() -> Requests:
    return Requests()


def test_a_second_program_that_points_is_refused_and_told_and_counted(requests: Requests):
    one, two = (requests.node().publisher(PROMPT) for _ in range(2))
    assert requests.heeds(one) == [True]
    assert requests.heeds(two, one, two, two) == [False, True, False, False]
    assert requests.heard.complaint.startswith("a prompt of publisher 2 was refused: publisher 1 points")
    assert requests.statistics.summary()["refused_prompts"] == {"publisher 2": 3}
    assert requests.heeds(one) == [True]
    assert requests.heard.complaint == ""


def test_a_program_that_is_gone_makes_way_for_its_next_start(requests: Requests):
    """It was refused as long as the one before it counted."""
    before = requests.node()
    assert requests.heeds(before.publisher(PROMPT)) == [True]
    page, other = (requests.node().publisher(PROMPT) for _ in range(2))
    assert requests.heeds(page) == [False]
    before.close()
    assert requests.heeds(page, other) == [True, False]


def test_who_only_announces_prompts_takes_nobodys_place(requests: Requests):
    silent, one = (requests.node().publisher(PROMPT) for _ in range(2))
    assert requests.heeds(one) == [True]
    assert requests.heeds(silent) == [False]


def test_it_is_said_and_counted_who_asked_to_stop(requests: Requests):
    one, two = (requests.node().publisher(STOP) for _ in range(2))
    one.publish(messages.boolean(False))
    one.publish(b"stop")
    assert [*requests.heard.take()] == []
    assert requests.heard.stopped_by == ""
    two.publish(messages.boolean(True))
    assert [*requests.heard.take()] == []
    assert requests.heard.stopped_by == "The stop was asked for by publisher 2."
    assert requests.statistics.summary()["stop_requests"] == {"publisher 2": 1}


@pytest.fixture
def make() -> Iterator[MakeNode]:
    with ExitStack() as stack:
        yield ros_nodes(stack)


def test_where_nobody_tells_who_sent_a_prompt_it_counts_only_from_one(make: MakeNode):
    node, statistics = make("deploy"), RunStatistics()
    heard = OperatorRequests(node, PROFILE.operator, statistics)

    def heeds(publisher: Publisher) -> bool:
        publisher.publish(messages.text(json.dumps({"box": BOX})))
        assert node.wait(PATIENCE)
        return [*heard.take()] == [BoxPrompt(box=BOX)]

    one = make("one").publisher(PROMPT)
    assert heeds(one)
    other = make("other")
    other.publisher(PROMPT)
    assert not heeds(one)
    assert statistics.refused_prompts == {"node one or node other": 1}
    other.close()
    assert heeds(one)
