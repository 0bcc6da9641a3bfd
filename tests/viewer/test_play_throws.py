"""Throws one by one, and what makes them harder."""

from collections.abc import Iterator
from itertools import islice
from math import radians

import numpy as np
import pytest

from pixel2catch.envs.cfg import CatchEnvCfg
from pixel2catch.viewer.throws import DISTURBANCES, ThrowOrder, ThrowPlayer, disturbed, released_at

TASK = CatchEnvCfg()
AS_TRAINED = tuple(disturbance.of(TASK) for disturbance in DISTURBANCES)


def order(**settings: float | tuple[float, float]) -> ThrowOrder:
    by_field = {disturbance.name: i for i, disturbance in enumerate(DISTURBANCES)}
    values = list(AS_TRAINED)
    for name, value in settings.items():
        values[by_field[name]] = value
    return ThrowOrder(policy="catch_alone+fit", objects="cube_s", settings=tuple(values))


@pytest.fixture
def thrower() -> Iterator[ThrowPlayer]:
    thrower = ThrowPlayer()
    yield thrower
    thrower.close()


def test_a_task_is_left_alone_by_its_own_settings():
    assert disturbed(TASK, AS_TRAINED) is TASK


def test_settings_are_fields_of_the_task_in_its_units():
    task = disturbed(TASK, order(latency_steps=(2.5, 4.0), drop_rate=20.0, camera_turn=2.0).settings)
    assert task.sensing.latency_steps == (2.5, 4.0)
    assert task.sensing.latency_grid == 0.5
    assert task.sensing.drop_rate == pytest.approx(0.2)
    assert task.sensing.camera_turn == pytest.approx(radians(2.0))
    assert task.randomization == TASK.randomization


def test_every_setting_is_read_back():
    for each in DISTURBANCES:
        setting = (each.largest, each.largest) if isinstance(each.of(TASK), tuple) else each.largest
        assert each.of(each.applied(TASK, setting)) == pytest.approx(setting)


def test_a_throw_flies_along_its_path_is_caught_and_comes_again_from_its_seed(thrower: ThrowPlayer):
    *_, first = thrower.run(order(air_density=1.2), seed=3)
    assert first.outcome == "caught and held"
    assert first.is_success
    flight = [frame for frame in first.frames if 0.0 <= frame.time < 0.7 * first.flight_time]
    times = np.linspace(0.0, first.flight_time, len(first.path))
    for frame in flight[::4]:
        on_path = [np.interp(frame.time, times, first.path[:, axis]) for axis in range(3)]
        assert frame.object_pos == pytest.approx(on_path, abs=0.02)  # the path has corners
    *_, again = islice(thrower.run(order(air_density=1.2), seed=3), 15)
    assert again.number == first.number + 1
    for frame, same in zip(again.frames, first.frames, strict=False):
        assert (frame.exposure.moment.qpos == same.exposure.moment.qpos).all()


def test_a_throw_begins_where_it_is_told_to_and_passes_the_robot(thrower: ThrowPlayer):
    task = released_at(TASK, (2.2, 0.5, 1.1))
    assert task.throws.aim_x == TASK.throws.aim_x
    ordered = ThrowOrder(
        policy="catch_alone+fit", objects="cube_s", settings=AS_TRAINED, release_pos=(2.2, 0.5, 1.1)
    )
    throw = next(thrower.run(ordered, 0))
    assert throw.frames[0].object_pos == pytest.approx((2.2, 0.5, 1.1), abs=1e-3)
    (low, high), height = TASK.throws.aim_x, TASK.throws.aim_z
    assert low < throw.path[-1, 0] < high
    assert height[0] < throw.path[-1, 2] < height[1]
