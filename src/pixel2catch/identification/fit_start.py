"""Where a fit starts, and what becomes of what was known before."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pixel2catch.errors import InvalidValueError
from pixel2catch.identification.fit import Fit
from pixel2catch.identification.fit_ranges import gain_ranges
from pixel2catch.identification.recording import ROBOTS
from pixel2catch.mdp.dynamics_file import DynamicsFile
from pixel2catch.robot.joint_dynamics import SERVOJ_GAIN, SERVOJ_LOOKAHEAD, JointDynamics

STIFF_FACTOR = 10.0
"""Stiffness of the servo behind a command filter over the nominal one.

Source: ours; the controller's feed-forward makes that servo look stiffer than positions can tell.
"""

STIFF_LAG = 0.003
"""Damping over stiffness of the servo behind a command filter [s]. Source: real UR5, target to position."""


@dataclass(frozen=True, kw_only=True)
class Start:
    """What is known before a fit.

    Attributes:
        robot: Whose joints are fitted: a name in `ROBOTS`.
        file: The dynamics file that was given, if any.
        before: The robot's joints in it; those that are not in it are nominal.
        first: The same, with a command filter in front where one is to be fitted.
    """

    robot: str
    file: DynamicsFile | None
    before: JointDynamics
    first: JointDynamics


def start_of_fit(robot: str, path: Path | None, fits_filter: bool) -> Start:
    """Read what is known.

    Args:
        robot: Whose joints are fitted.
        path: A dynamics file, if there is one.
        fits_filter: Whether the filter of the commands is to be fitted. Without a file, the servo behind it
            is taken to be stiff.

    Raises:
        InvalidValueError: If the file cannot be read, or the robot has joints without such a filter.
    """
    if fits_filter and robot != "ur5e":
        raise InvalidValueError(
            f"--filter is the UR5e's and --robot is {robot}; identify --robot ur5e with it, then --robot "
            "allegro with the dynamics file of the first as --start: the result has both."
        )
    file = DynamicsFile.load(path) if path else None
    nominal = JointDynamics.nominal()
    before = (file.dynamics.over(nominal) if file else nominal).select(ROBOTS[robot])
    first = before if file or not fits_filter else stiff(before)
    return Start(robot=robot, file=file, before=before, first=_filtered(first) if fits_filter else first)


def stiff(nominal: JointDynamics) -> JointDynamics:
    """The servos of a controller whose feed-forward makes them look stiffer than positions can tell."""
    stiffness = STIFF_FACTOR * nominal.stiffness
    return nominal.with_values(stiffness=stiffness, damping=STIFF_LAG * stiffness)


def _filtered(dynamics: JointDynamics) -> JointDynamics:
    """With the filter of servoJ where there is none."""
    gain = np.where(dynamics.has_filter, dynamics.filter_gain, SERVOJ_GAIN)
    lookahead = np.where(dynamics.has_filter, dynamics.filter_lookahead, SERVOJ_LOOKAHEAD)
    return dynamics.with_values(filter_gain=gain, filter_lookahead=lookahead)


def identified(fit: Fit, start: Start) -> DynamicsFile:
    """The result as training takes it; joints of the file before that were not fitted are carried over.

    Args:
        fit: The fit.
        start: Where it started.
    """
    old = start.file or DynamicsFile(dynamics=fit.dynamics)
    return DynamicsFile(dynamics=fit.dynamics.over(old.dynamics), gains=gain_ranges(fit, old.gains))
