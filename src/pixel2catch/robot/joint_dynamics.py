"""What is identified: for each joint a servo, and the command path in front of it; the dynamics file.

A command is held until the next one is sent. It reaches the joint `latency` later, passes the filter

    q̈ = filter_gain (u − q − filter_lookahead q̇)

and its output is the target of the servo: torque = stiffness (target − position) − damping velocity, with dry
friction and the drive's armature. Without latency and filter this is the simulator's joint.
"""

import dataclasses
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.linalg import expm

from pixel2catch.errors import InvalidValueError, UnknownNameError
from pixel2catch.files import write_atomically
from pixel2catch.robot.constants import JOINTS

FORMAT_VERSION = 1

SERVOJ_GAIN = 300.0
"""Gain of the UR5e's servoJ filter [1/s²]. Source: the controller's setting, confirmed on recorded motion."""

SERVOJ_LOOKAHEAD = 0.1
"""Look-ahead time of the UR5e's servoJ filter [s]. Source: as of the gain."""

Parameter = Float[np.ndarray, " num_joints"]


@dataclass(frozen=True, kw_only=True)
class JointDynamics:
    """The dynamics of some joints, one entry per joint.

    Attributes:
        joints: Their names, in joint order.
        stiffness: Gain on the position error [N·m/rad].
        damping: Gain on the velocity [N·m·s/rad].
        frictionloss: Dry friction [N·m].
        armature: Reflected inertia of the drive [kg·m²].
        latency: Time from sending a command to its arrival [s].
        filter_gain: Gain of the command filter [1/s²]; infinite where there is no filter.
        filter_lookahead: Look-ahead time of the command filter [s]; 0 where there is no filter.
    """

    joints: tuple[str, ...]
    stiffness: Parameter
    damping: Parameter
    frictionloss: Parameter
    armature: Parameter
    latency: Parameter
    filter_gain: Parameter
    filter_lookahead: Parameter

    def __post_init__(self) -> None:
        """Refuse unknown joints, a wrong order and values out of range."""
        known = [joint.name for joint in JOINTS]
        for name in self.joints:
            if name not in known:
                raise UnknownNameError("joint", name, known)
        if not self.joints or list(self.joints) != [name for name in known if name in self.joints]:
            raise InvalidValueError(f"joints are {list(self.joints)}; name each once, in the order {known}")
        for name in PARAMETERS:
            self._check(name)

    def _check(self, name: str) -> None:
        values = getattr(self, name)
        may_be_zero = name in ("frictionloss", "latency", "filter_lookahead")
        is_good = (values >= 0.0) if may_be_zero else (values > 0.0)
        if name != "filter_gain":
            is_good &= np.isfinite(values)
        if not is_good.all():
            bad = int(np.argmin(is_good))
            least = "0 or more" if may_be_zero else "more than 0"
            raise InvalidValueError(
                f"{name} of {self.joints[bad]} is {values[bad]:g}; it must be {least}, and finite"
            )

    @classmethod
    def nominal(cls, joints: Sequence[str] | None = None) -> "JointDynamics":
        """What the simulator has without an identification: neither latency nor filter.

        Args:
            joints: Names, in joint order; all joints if not given.
        """
        specs = [joint for joint in JOINTS if joints is None or joint.name in joints]
        fields = ("stiffness", "damping", "frictionloss", "armature")
        return cls(
            joints=tuple(joints or (joint.name for joint in specs)),
            **{name: np.array([getattr(joint, name) for joint in specs], dtype=float) for name in fields},
            latency=np.zeros(len(specs)),
            filter_gain=np.full(len(specs), np.inf),
            filter_lookahead=np.zeros(len(specs)),
        )

    def with_values(self, **values: Any) -> "JointDynamics":
        """The same joints with other values; a single number is every joint's."""
        full = {name: np.full(len(self.joints), value, dtype=float) for name, value in values.items()}
        return dataclasses.replace(self, **full)

    @property
    def has_filter(self) -> np.ndarray:
        """Which joints have a command filter."""
        return np.isfinite(self.filter_gain)

    def save(self, path: Path) -> None:
        """Write the dynamics file, JSON; an infinite gain is null there."""
        values = {name: getattr(self, name).tolist() for name in PARAMETERS}
        values["filter_gain"] = [gain if np.isfinite(gain) else None for gain in self.filter_gain.tolist()]
        content = {"format_version": FORMAT_VERSION, "joints": list(self.joints), **values}
        write_atomically({path: (json.dumps(content, indent=2, allow_nan=False) + "\n").encode()})

    @classmethod
    def load(cls, path: Path) -> "JointDynamics":
        """Read a dynamics file.

        Raises:
            InvalidValueError: The file is missing or damaged, of another version, or has a bad value.
        """
        try:
            content = json.loads(path.read_text(encoding="utf-8"))
            version = content.pop("format_version")
            joints = tuple(content.pop("joints"))
            content["filter_gain"] = [np.inf if gain is None else gain for gain in content["filter_gain"]]
            values = {name: np.array(entry, dtype=float) for name, entry in content.items()}
            if version != FORMAT_VERSION:
                raise InvalidValueError(f"format_version is {version}, this code reads {FORMAT_VERSION}")
            for name, entry in values.items():
                if entry.shape != (len(joints),):
                    raise InvalidValueError(f"{name} has {entry.size} entries; it needs {len(joints)}")
            return cls(joints=joints, **values)
        except (OSError, ValueError, KeyError, TypeError, AttributeError, UnknownNameError) as error:
            raise InvalidValueError(
                f"cannot read the dynamics file '{path}': {error}. Identify again, or correct that entry."
            ) from error


PARAMETERS = tuple(field.name for field in dataclasses.fields(JointDynamics) if field.name != "joints")
"""Names of the parameters of a joint."""


def filter_transition(dynamics: JointDynamics, dt: float) -> Float[np.ndarray, "num_joints 2 3"]:
    """Exact step of every joint's filter: (position, velocity) after it, from those before and the command.

    Without a filter the position is the command.

    Args:
        dynamics: The joints.
        dt: Length of the step [s], in which the command is constant.
    """
    step = np.zeros((len(dynamics.joints), 2, 3))
    step[:, 0, 2] = 1.0
    gain, lookahead = dynamics.filter_gain, dynamics.filter_lookahead
    for j in np.flatnonzero(dynamics.has_filter):
        matrix = expm(dt * np.array(((0.0, 1.0), (-gain[j], -gain[j] * lookahead[j]))))
        step[j, :, :2] = matrix
        step[j, :, 2] = (1.0 - matrix[0, 0], -matrix[1, 0])  # at rest on its command, the filter stays
    return step
