"""The line that delays boxes and joint targets."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from pixel2catch.mdp.delay import DelayLine
from pixel2catch.mdp.sensing import Detection


def detection(mark: float, num_envs: int = 1) -> Detection:
    return Detection(box=torch.full((num_envs, 4), mark), object_pos=torch.full((num_envs, 3), -mark))


def line(longest: int = 2, num_envs: int = 1) -> DelayLine[Detection]:
    return DelayLine.filled(detection(0.0, num_envs), longest)


def delivered(detections: DelayLine[Detection], *latency: int) -> list[float]:
    """Marks of what arrives; box and position of a detection travel together."""
    arrived = detections.delivered(torch.tensor(latency))
    assert torch.equal(arrived.box[:, :3], -arrived.object_pos)
    return arrived.box[:, 0].tolist()


@pytest.mark.parametrize("latency", [0, 1, 2])
def test_a_detection_arrives_exactly_after_the_latency(latency):
    marked = line().pushed(detection(9.0))
    arrivals = []
    for _ in range(4):
        arrivals += delivered(marked, latency)
        marked = marked.pushed(detection(0.0))
    assert arrivals == [9.0 if age == latency else 0.0 for age in range(4)]


def test_latency_is_each_environments_own():
    detections = line(num_envs=3)
    for mark in (1.0, 2.0, 3.0):
        detections = detections.pushed(detection(mark, 3))
    assert delivered(detections, 0, 1, 2) == [3.0, 2.0, 1.0]
    assert detections.newest.box[:, 0].tolist() == [3.0, 3.0, 3.0]


@given(st.lists(st.floats(0.0, 640.0, width=32), min_size=1, max_size=12), st.integers(0, 2))
def test_detections_arrive_in_order_and_none_is_lost(marks, latency):
    detections, arrived = DelayLine.filled(detection(marks[0]), 2), []
    for mark in marks:
        detections = detections.pushed(detection(mark))
        arrived += delivered(detections, latency)
    assert arrived == [marks[0]] * min(latency, len(marks)) + marks[: len(marks) - latency]


def test_nothing_old_survives_filling():
    assert {delivered(DelayLine.filled(detection(1.0), 2), age)[0] for age in range(3)} == {1.0}


def test_pushing_leaves_the_stream_before_as_it_was():
    before = line()
    before.pushed(detection(7.0))
    assert not before.newest.box.any()


def test_tensors_travel_as_detections_do():
    """The targets 0, 1, 2, 3 arrive undelayed in the first environment, two steps late in the second."""
    targets = DelayLine.filled(torch.zeros(2, 19), 2)
    arrived = []
    for number in range(4):
        targets = targets.pushed(torch.full((2, 19), float(number)))
        arrived.append(targets.delivered(torch.tensor([0, 2]))[:, 5].tolist())
    assert arrived == [[0.0, 0.0], [1.0, 0.0], [2.0, 0.0], [3.0, 1.0]]


def test_no_delay_is_no_line():
    value = torch.ones(3, 4)
    undelayed = DelayLine.filled(torch.zeros(3, 4), 0).pushed(value)
    assert undelayed.delivered(torch.zeros(3, dtype=torch.long)) is value
