"""What is fitted, and the coordinates in which it is."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from pixel2catch.errors import InvalidValueError, UnknownNameError
from pixel2catch.identification.fit_simulation import FIT_DT
from pixel2catch.robot.constants import FINGERS
from pixel2catch.robot.joint_dynamics import PARAMETERS, JointDynamics

SERVO_PARAMETERS = ("stiffness", "damping", "frictionloss", "armature", "latency")
"""What is fitted where commands reach the servo unfiltered."""

FILTER_PARAMETERS = ("filter_gain", "filter_lookahead", "latency")
"""What is fitted of the command path in front of a servo that is known."""

SCALE = ("stiffness", "damping", "frictionloss", "armature")
"""Parameters that are all torques over motion: positions alone leave their common scale open."""

LATENCY_UNIT = 0.01
"""Latency that counts as much as a factor e of another parameter [s]. Source: ours."""

MAX_LATENCY = 0.2
"""Largest latency that a fit tries [s]. Source: ours."""

MAX_FACTOR = 1e3
"""Largest factor between the start and the result of any other parameter. Source: ours."""

LEAST_VALUE = 1e-9
"""What a fit takes for 0 where it needs a logarithm."""

Point = Float[np.ndarray, "num_joints num_free"]


@dataclass(frozen=True, kw_only=True)
class FitCfg:
    """How the dynamics are fitted.

    Attributes:
        free: Parameters that are fitted; the others keep their start values.
        prior: Standard deviation of what is known before, in the coordinates of the fit: 2 is a factor 7.
        physics_dt: Time step of the simulation [s].
        max_rounds: Most evaluations of the slopes with this time step.
    """

    free: tuple[str, ...] = SERVO_PARAMETERS
    prior: float = 2.0
    physics_dt: float = FIT_DT
    max_rounds: int = 4

    def __post_init__(self) -> None:
        """Refuse unknown parameters, none at all, and sizes that are not positive."""
        for name in self.free:
            if name not in PARAMETERS:
                raise UnknownNameError("parameter", name, PARAMETERS)
        if not self.free:
            raise InvalidValueError(f"nothing is free to be fitted; name some of {', '.join(PARAMETERS)}")
        for name in ("prior", "physics_dt", "max_rounds"):
            if not getattr(self, name) > 0:
                raise InvalidValueError(f"{name} is {getattr(self, name):g}; it must be more than 0")


class Coordinates:
    """The free parameters as the numbers that the optimiser moves, one row per joint."""

    def __init__(self, start: JointDynamics, free: tuple[str, ...]) -> None:
        """Remember the start, which also has the values of what is not free.

        Raises:
            InvalidValueError: The filter is free, but the start has none.
        """
        if {"filter_gain", "filter_lookahead"} & set(free) and not start.has_filter.all():
            raise InvalidValueError(
                "the command filter is to be fitted, but the start has none; "
                "start with filter_gain=300 and filter_lookahead=0.1, the settings of servoJ."
            )
        self._start = start
        self._free = free
        self._is_latency = np.array([name == "latency" for name in free])

    def of(self, dynamics: JointDynamics) -> Point:
        """Where the dynamics are."""
        values = np.stack([getattr(dynamics, name) for name in self._free], axis=-1)
        logarithms = np.log(np.maximum(values, LEAST_VALUE))
        return np.where(self._is_latency, values / LATENCY_UNIT, logarithms)

    def dynamics(self, point: Point) -> JointDynamics:
        """The dynamics at a point."""
        with np.errstate(over="ignore"):  # a latency is no exponent
            values = np.where(self._is_latency, point * LATENCY_UNIT, np.exp(point))
        columns = {name: values[:, i].copy() for i, name in enumerate(self._free)}
        return self._start.with_values(**columns)

    def bounded(self, point: Point) -> Point:
        """The nearest point that a fit may try."""
        center, width = self.of(self._start), np.log(MAX_FACTOR)
        lower = np.where(self._is_latency, 0.0, center - width)
        upper = np.where(self._is_latency, MAX_LATENCY / LATENCY_UNIT, center + width)
        return point.clip(lower, upper)

    def directions(self, names: Sequence[str], is_coupled: bool) -> "Directions":
        """How some of the parameters can move.

        Commands reach all joints of the arm together, and all of the hand, so that they share the change of
        latency; every other parameter is a joint's own. What is a torque over motion moves with the
        stiffness: their common scale shows weakly, and differences of large slopes would not tell it.

        Args:
            names: The parameters: one that is free at least.
            is_coupled: Whether to see that the motion of a joint moves others: that of the arm all, that of a
                finger the rest of it.
        """
        owners = np.array([_owner(joint) for joint in self._start.joints])
        is_arm = owners == "arm"
        chain = np.where(is_arm[:, None], True, owners[:, None] == owners)
        steps, felt_by = [], []
        for name in self._free:
            is_shared = name == "latency"
            along = np.isin(self._free, SCALE if name == "stiffness" else name) & np.isin(self._free, names)
            moved = np.stack((is_arm, ~is_arm)) if is_shared else np.eye(len(owners), dtype=bool)
            for group in moved[moved.any(axis=1)] if name in names else ():
                steps.append(np.outer(group, along).astype(float))
                felt_by.append(chain[group].any(axis=0) if is_coupled else group)
        return Directions(steps=np.array(steps), felt_by=np.array(felt_by))


@dataclass(frozen=True, kw_only=True)
class Directions:
    """Ways in which a point can move.

    Attributes:
        steps: A unit step of each.
        felt_by: Which joints move otherwise then.
    """

    steps: Float[np.ndarray, "num_directions num_joints num_free"]
    felt_by: Bool[np.ndarray, "num_directions num_joints"]

    def together(self) -> list[list[int]]:
        """Directions by number, in batches that no joint feels more than one of."""
        batches: list[list[int]] = []
        for number, joints in enumerate(self.felt_by):
            fitting = (batch for batch in batches if not (self.felt_by[batch] & joints).any())
            batch = next(fitting, None)
            if batch is None:
                batches.append([number])
            else:
                batch.append(number)
        return batches


def _owner(joint: str) -> str:
    """The finger of a joint, or the arm."""
    return next((finger for finger in FINGERS if joint.startswith(finger)), "arm")
