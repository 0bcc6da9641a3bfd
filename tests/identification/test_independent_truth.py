"""A robot that shares nothing with our simulation, `benchmarks/independent_robot.py`, is identified."""

import numpy as np
import pytest
from identify_independent_truth import LAG, judged, recorded
from independent_robot import Faults, Robot


def test_the_independent_robot_sticks_short_of_its_target():
    """Friction of 0.02 N·m behind 3 N·m/rad: within 6.7 mrad of rest nothing moves it."""
    finger = Robot(
        names=("index_joint_1",),
        stiffness=np.array([3.0]),
        damping=np.array([0.1]),
        viscous=np.array([0.002]),
        frictionloss=np.array([0.02]),
        armature=np.array([1e-3]),
        faults=Faults(lost=0.0, play=0.0, stribeck=1.0),
    )
    times = np.array((0.0, 0.1))
    for jump, least, most in ((0.004, 0.0, 0.002), (0.1, 0.0925, 0.1)):
        sent = [(times, np.array(((0.0,), (jump,))))]
        path = finger._path(np.random.default_rng(0), sent, 0.6)
        assert least <= path[-1, 0] <= most
        assert (path[: round(0.112 / 2.5e-4), 0] == 0.0).all()


@pytest.mark.slow
def test_friction_and_clocks_of_a_robot_that_is_not_ours_are_found():
    robot, recordings = recorded(0, ("index_joint_1",), 20.0, Faults())
    rows = judged(robot, 0, recordings[0])
    for name, goal in (("frictionloss", 0.3), ("latency", 1e-3), (LAG, 0.02), ("drift", 6e-5)):
        assert abs(rows[name]["error"]) < goal, name
    assert all(rows[name]["holds"] for name in ("stiffness", "damping", "frictionloss", "armature"))
