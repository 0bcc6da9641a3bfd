"""Identified dynamics of joints: a command path and a servo for each joint.

A command u arrives `latency` after it was sent and passes the filter

    q̈ = filter_gain (u − q − filter_lookahead q̇).

The filter's output q is the target of the servo: torque = stiffness (target − position) − damping velocity.
The joint has dry friction and the armature of its drive.
"""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.linalg import expm

from pixel2catch.errors import InvalidValueError, UnknownNameError
from pixel2catch.robots.allegro import HAND
from pixel2catch.robots.spec import JointSpec
from pixel2catch.robots.ur5e import ARM

JOINTS: tuple[JointSpec, ...] = (*ARM.joints, *HAND.joints)
"""Default joints: those of the paper's robot."""

SERVOJ_GAIN = 300.0
"""Gain of the UR5e's servoJ filter [1/s²]. Source: the controller's setting, confirmed on recorded motion."""

SERVOJ_LOOKAHEAD = 0.1  #: Look-ahead time of the UR5e's servoJ filter [s]. Source: the controller's setting.
EFFORT_MARGIN = 0.999  #: Share of a joint's effort limit that a servo applies; at the limit MuJoCo clamps.

POSITIVE = 1e-9, 1e9
RANGES = {
    "frictionloss": (0.0, 1e9),
    "latency": (0.0, 1.0),
    "filter_gain": (1e-9, np.inf),
    "filter_lookahead": (0.0, 10.0),
}
"""Ranges of the values of some parameters; those of others are `POSITIVE`. Source: ours."""

Parameter = Float[np.ndarray, " num_joints"]


@dataclass(frozen=True, kw_only=True, eq=False)
class JointDynamics:
    """The dynamics of some joints, one entry per joint."""

    joints: tuple[str, ...]  #: Their names, in joint order.
    stiffness: Parameter  #: Gain on the position error [N·m/rad].
    damping: Parameter  #: Gain on the velocity [N·m·s/rad].
    frictionloss: Parameter  #: Dry friction [N·m].
    armature: Parameter  #: Reflected inertia of the drive [kg·m²].
    latency: Parameter  #: Time from sending a command to its arrival [s].
    filter_gain: Parameter  #: Gain of the command filter [1/s²]; infinite where there is no filter.
    filter_lookahead: Parameter  #: Look-ahead time of the command filter [s]; 0 where there is no filter.

    def __post_init__(self) -> None:
        if not self.joints or len(set(self.joints)) < len(self.joints):
            raise InvalidValueError(f"joints are {list(self.joints)}; name each joint once.")
        for name in PARAMETERS:
            if (values := getattr(self, name)).shape != (len(self.joints),):
                raise InvalidValueError(f"{name} has {values.size} entries; it needs {len(self.joints)}")
            for joint, value in zip(self.joints, values.tolist(), strict=True):
                low, high = RANGES.get(name, POSITIVE)
                if not low <= value <= high:
                    raise InvalidValueError(f"{name} of {joint} is {value:g}; give {low:g} to {high:g}.")

    def require(self, joints: Sequence[JointSpec]) -> None:
        """Require that all joints belong to a robot, in its order."""
        known = [joint.name for joint in joints]
        for name in self.joints:
            if name not in known:
                raise UnknownNameError("joint", name, known)
        if list(self.joints) != [name for name in known if name in self.joints]:
            raise InvalidValueError(f"joints are {list(self.joints)}; name them in the order {known}.")

    def __eq__(self, other: object) -> bool:
        return isinstance(other, JointDynamics) and self._key() == other._key()

    def __hash__(self) -> int:
        return hash(self._key())

    def _key(self) -> tuple[tuple[Any, ...], ...]:
        return (self.joints, *(tuple(getattr(self, name).tolist()) for name in PARAMETERS))

    @classmethod
    def of(cls, specs: Sequence[JointSpec] = JOINTS, known: "JointDynamics | None" = None) -> "JointDynamics":
        """Return the dynamics of joints: the known ones; others are nominal, without latency and filter."""
        fields = ("stiffness", "damping", "frictionloss", "armature")
        nominal = cls(
            joints=tuple(joint.name for joint in specs),
            **{name: np.array([getattr(joint, name) for joint in specs], dtype=float) for name in fields},
            latency=np.zeros(len(specs)),
            filter_gain=np.full(len(specs), np.inf),
            filter_lookahead=np.zeros(len(specs)),
        )
        return known.over(nominal) if known else nominal

    def with_values(self, **values: Any) -> "JointDynamics":
        """Return the same joints with other values; one number holds for every joint."""
        full = {name: np.full(len(self.joints), value, dtype=float) for name, value in values.items()}
        return dataclasses.replace(self, **full)

    def select(self, joints: Sequence[str]) -> "JointDynamics":
        """Return the dynamics of some of the joints, given in joint order."""
        columns = [self.joints.index(name) for name in joints]
        values = {name: getattr(self, name)[columns] for name in PARAMETERS}
        return JointDynamics(joints=tuple(joints), **values)

    def over(self, below: "JointDynamics") -> "JointDynamics":
        """Return the joints of both, those of `below` first; this one's values win for common joints."""
        last = {name: i for i, name in enumerate((*below.joints, *self.joints))}
        rows = [*last.values()]
        values = {
            name: np.concatenate((getattr(below, name), getattr(self, name)))[rows] for name in PARAMETERS
        }
        return JointDynamics(joints=tuple(last), **values)

    @property
    def has_filter(self) -> np.ndarray:
        """Return which joints have a command filter."""
        return np.isfinite(self.filter_gain)

    def command_lag(self, dt: float) -> Float[np.ndarray, " num_joints"]:
        """Return the time between sending a command and the middle of the physics step that uses it [s].

        A servo leads by half a step `dt` [s], a filter by half a step more. The sum adds both to the latency;
        motion then hardly depends on the time step.
        """
        return self.latency + dt / 2 * (1.0 + self.has_filter)

    def filter_transition(self, dt: float) -> Float[np.ndarray, "num_joints 2 2"]:
        """Return the exact transition over `dt` [s] of every filter, with a constant command.

        The state is (position minus command, speed). The matrix is 0 where there is no filter.
        """
        step = np.zeros((len(self.joints), 2, 2))
        gain, lookahead = self.filter_gain, self.filter_lookahead
        for j in np.flatnonzero(self.has_filter):
            step[j] = expm(dt * np.array(((0.0, 1.0), (-gain[j], -gain[j] * lookahead[j]))))
        return step


PARAMETERS = tuple(field.name for field in dataclasses.fields(JointDynamics) if field.name != "joints")
"""Names of the parameters of a joint."""

Values = Any  #: A NumPy array or a PyTorch tensor.


def filter_step(transition: Values, state: Values, command: Values) -> None:
    """Advance the state of command filters by a time step with these commands [rad].

    Transitions are (..., num_joints, 2, 2), as of `JointDynamics.filter_transition`. The state, position
    [rad] and speed [rad/s], is (num_copies, num_joints, 2) and keeps its memory.
    """
    error, speed = state[..., 0] - command, state[..., 1] + 0.0
    state[..., 0] = command + transition[..., 0, 0] * error + transition[..., 0, 1] * speed
    state[..., 1] = transition[..., 1, 0] * error + transition[..., 1, 1] * speed


class DryFriction:
    """Dry friction of identified joints: each joint drags a spring whose force is at most its friction.

    It brakes a moving joint until it rests and then holds it (one Maxwell slip element). A joint that sticks
    swings at √(stiffness / inertia), which the integration allows up to 2 / dt. The stiffness is that of
    1 / dt with the armature alone as inertia. Arrays and tensors are (num_envs, num_joints) and keep their
    memory.
    """

    def __init__(self, frictionloss: Values, armature: Values, joint_pos: Values, dt: float) -> None:
        """Take friction [N·m], armature [kg·m²], positions [rad] and the time step [s]."""
        self._grip: Values = armature / dt**2
        self._slip: Values = frictionloss / self._grip
        self.bend: Values = 0.0 * joint_pos  #: Bend of each joint's spring [rad].
        self.last: Values = joint_pos + 0.0  #: Joint positions of the last step [rad].

    def torque(self, joint_pos: Values) -> Values:
        """Return the torque of the next step [N·m] at these joint positions [rad]."""
        self.bend[:] = (self.bend + (joint_pos - self.last)).clip(-self._slip, self._slip)
        self.last[:] = joint_pos
        return -self._grip * self.bend
