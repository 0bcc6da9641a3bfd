"""Throws one by one, and what makes them harder."""

from contextlib import closing
from itertools import islice

import numpy as np
import pytest

from pixel2catch.scene.constants import OBJECT_POS
from pixel2catch.viewer.throws import ThrowOrder, ThrowPlayer, ThrowStep


def object_pos(step: ThrowStep) -> np.ndarray:
    return step.exposure.moment.qpos[OBJECT_POS]


def test_a_throw_flies_along_its_path_is_caught_and_comes_again_from_its_seed():
    """In air, which bends the path."""
    order = ThrowOrder(policy="catch_alone+fit", objects="cube_s", disturbance="air 30 g")
    with closing(ThrowPlayer()) as thrower:
        task = thrower.task(order)
        assert task.randomization.air_density == 1.2
        *_, first = thrower.run(order, seed=3)
        assert first.outcome == "caught and held"
        assert first.is_success
        flight = [step for step in first.steps if 0.0 <= step.exposure.moment.time < 0.4]
        path = first.path[::-1]  # towards the robot, x falls
        for step in flight[::4]:
            pos = object_pos(step)
            assert pos == pytest.approx(
                [np.interp(pos[0], path[:, 0], path[:, i]) for i in range(3)], abs=0.02
            )
        gone = object_pos(flight[-1]) - object_pos(flight[0])
        assert np.linalg.norm(gone) > 1.0
        assert flight[0].exposure.moment.time == pytest.approx(0.0, abs=1 / 30)
        *_, again = islice(thrower.run(order, seed=3), 15)
        assert again.number == first.number + 1
        for step, same in zip(again.steps, first.steps, strict=False):
            assert (step.exposure.moment.qpos == same.exposure.moment.qpos).all()
