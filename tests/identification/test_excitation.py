"""Trajectories as they are drawn: repeatable, complete, as fast as asked for. `excite` tries them."""

import dataclasses

import numpy as np
import pytest

from pixel2catch.errors import InvalidValueError, UnknownNameError
from pixel2catch.identification.excitation import ExcitationCfg, draw_excitation
from pixel2catch.identification.robot import JOINT_SPECS, ROBOTS

WHOLE = ExcitationCfg(seconds=20.0, seed=0)


def test_it_begins_and_ends_in_the_start_pose():
    trajectory = draw_excitation(WHOLE, {})
    assert trajectory.joints == ROBOTS["ur5e_allegro"]
    assert trajectory.duration == pytest.approx(20.0)
    home = [spec.home for spec in JOINT_SPECS.values()]
    np.testing.assert_allclose(trajectory.positions[[0, -1]], [home, home])


def test_the_same_seed_draws_the_same_and_another_another():
    first, again = draw_excitation(WHOLE, {}), draw_excitation(WHOLE, {})
    np.testing.assert_array_equal(first.positions, again.positions)
    other = draw_excitation(dataclasses.replace(WHOLE, seed=4), {})
    assert np.abs(other.positions - first.positions).max() > 0.1


def test_all_kinds_of_motion_are_there_in_order():
    trajectory = draw_excitation(WHOLE, {})
    segments = trajectory.header["segments"]
    assert list(segments) == ["multisine", "steps", "policy_targets", "turns", "slow_reversals"]
    edges = np.array(list(segments.values())).ravel()
    assert (np.diff(edges) > 0.0).all()
    for start, end in segments.values():
        inside = trajectory.positions[(trajectory.times >= start) & (trajectory.times < end)]
        assert (np.ptp(inside, axis=0) > 0.005).all()


def test_less_speed_is_gentler_everywhere():
    jumps = [
        np.abs(np.diff(draw_excitation(dataclasses.replace(WHOLE, speed=speed), {}).positions, axis=0)).max(0)
        for speed in (0.2, 1.0)
    ]
    np.testing.assert_array_less(jumps[0], 0.5 * jumps[1])


def test_what_cannot_be_drawn_is_refused():
    with pytest.raises(UnknownNameError, match="Did you mean 'ur5e'"):
        ExcitationCfg(robot="ur5")
    with pytest.raises(InvalidValueError, match=r"speed is 1\.5; it must be above 0 and at most 1"):
        ExcitationCfg(speed=1.5)
    with pytest.raises(InvalidValueError, match="seed is -1"):
        ExcitationCfg(seed=-1)
    with pytest.raises(InvalidValueError, match="seconds is nan"):
        ExcitationCfg(seconds=float("nan"))
    with pytest.raises(InvalidValueError, match="seconds is 10; at this speed it must be at least 2"):
        draw_excitation(ExcitationCfg(seconds=10.0), {})
    shortest = draw_excitation(ExcitationCfg(seconds=21.0), {})
    assert shortest.duration == pytest.approx(21.0)
