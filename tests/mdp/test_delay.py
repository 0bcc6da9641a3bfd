"""The line that delays boxes and joint targets."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from pixel2catch.mdp.sensing import Detection
from pixel2catch.mdp.tensors import DelayLine


def detection(mark: float, num_envs: int = 1) -> Detection:
    return Detection(
        box=torch.full((num_envs, 4), mark),
        object_pos=torch.full((num_envs, 3), -mark),
        is_seen=torch.ones(num_envs, dtype=torch.bool),
        stale=torch.zeros(num_envs),
        age_error=torch.zeros(num_envs),
    )


def line(longest: int = 2, num_envs: int = 1) -> DelayLine[Detection]:
    return DelayLine.filled(detection(0.0, num_envs), longest)


def delivered(detections: DelayLine[Detection], *latency: float) -> list[float]:
    """Marks of what arrives; box and position of a detection travel together."""
    arrived = detections.delivered(torch.tensor(latency, dtype=torch.float32))
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
        arrived.append(targets.delivered(torch.tensor([0.0, 2.0]))[:, 5].tolist())
    assert arrived == [[0.0, 0.0], [1.0, 0.0], [2.0, 0.0], [3.0, 1.0]]


def test_no_delay_is_no_line():
    value = torch.ones(3, 4)
    undelayed = DelayLine.filled(torch.zeros(3, 4), 0).pushed(value)
    assert undelayed.delivered(torch.zeros(3)) is value
    assert torch.equal(undelayed.interpolated(torch.zeros(3)), value)


@pytest.mark.parametrize(
    ("latency", "expected"), [(0.0, 3.0), (0.9, 3.0), (1.0, 2.0), (1.99, 2.0), (2.5, 1.0)]
)
def test_a_detection_does_not_arrive_before_its_time(latency, expected):
    """Of 1, 2, 3 the newest that is old enough: what lies between two control steps waits for the later."""
    detections = line()
    for mark in (1.0, 2.0, 3.0):
        detections = detections.pushed(detection(mark))
    assert delivered(detections, latency) == [expected]


def sent(*numbers: float, num_envs: int = 1) -> DelayLine[Tensor]:
    """Targets of 19 joints, one number after another."""
    targets = DelayLine.filled(torch.full((num_envs, 19), numbers[0]), len(numbers) - 1)
    for number in numbers[1:]:
        targets = targets.pushed(torch.full((num_envs, 19), number))
    return targets


def test_interpolation_by_hand():
    """Of 8, 2, 5, 1, the newest last: 1 + 0.25 (5 - 1) = 2, (5 + 2) / 2 = 3.5, 2 + 0.75 (8 - 2) = 6.5."""
    delay = torch.tensor([0.0, 0.25, 1.5, 2.75, 3.0])
    arrived = sent(8.0, 2.0, 5.0, 1.0, num_envs=5).interpolated(delay)
    expected = torch.tensor([1.0, 2.0, 3.5, 6.5, 8.0])[:, None].expand(5, 19)
    torch.testing.assert_close(arrived, expected)


@given(st.lists(st.floats(-3.0, 3.0, width=32), min_size=1, max_size=5), st.data())
def test_whole_delays_are_exact_and_others_between_their_neighbours(numbers, data):
    targets = sent(*numbers, num_envs=2)
    whole = data.draw(st.integers(0, len(numbers) - 1))
    delays = torch.full((2,), float(whole))
    assert torch.equal(targets.interpolated(delays), targets.delivered(delays))
    fraction = data.draw(st.floats(0.0, 1.0, width=32)) if whole else 0.0
    neighbours = numbers[::-1][max(whole - 1, 0)], numbers[::-1][whole]
    arrived = targets.interpolated(delays - fraction)
    assert min(neighbours) - 1e-5 <= arrived.min()
    assert arrived.max() <= max(neighbours) + 1e-5
    expected = fraction * neighbours[0] + (1.0 - fraction) * neighbours[1]
    torch.testing.assert_close(arrived, torch.full((2, 19), expected), atol=1e-5, rtol=0)
