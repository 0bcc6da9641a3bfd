"""A servo with a laboratory in memory."""

from collections.abc import Iterator
from contextlib import closing

import pytest
from wire_lab import Stage

from pixel2catch.ros2.profile import Profile
from pixel2catch.servo.link import LoopEnd, ServoEnd, link


@pytest.fixture
def ends() -> Iterator[tuple[LoopEnd, ServoEnd]]:
    loop, servo = link()
    with closing(loop), closing(servo):
        yield loop, servo


@pytest.fixture
def stage(ends: tuple[LoopEnd, ServoEnd]) -> Stage:
    return Stage(Profile.load("ur5e_allegro_v4"), ends)
