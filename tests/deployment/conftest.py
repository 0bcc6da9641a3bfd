"""A servo with a laboratory in memory, and a control loop's surroundings."""

from collections.abc import Iterator
from contextlib import closing

import pytest
from loop_lab import PROFILE, PassingClock, Surroundings
from wire_lab import Stage

from pixel2catch.deployment.control_loop import Connection
from pixel2catch.ros2.memory import Broker
from pixel2catch.servo.link import LoopEnd, ServoEnd, link


@pytest.fixture
def ends() -> Iterator[tuple[LoopEnd, ServoEnd]]:
    loop, servo = link()
    with closing(loop), closing(servo):
        yield loop, servo


@pytest.fixture
def stage(ends: tuple[LoopEnd, ServoEnd]) -> Stage:
    return Stage(PROFILE, ends)


@pytest.fixture
def around(ends: tuple[LoopEnd, ServoEnd]) -> Surroundings:
    clock, broker = PassingClock(), Broker()
    node, lab = broker.node(clock), broker.node(clock)
    connection = Connection(transport=node, servo=ends[0], clock=clock, recording=None)
    return Surroundings(connection=connection, servo=ends[1], lab=lab, clock=clock, broker=broker)
