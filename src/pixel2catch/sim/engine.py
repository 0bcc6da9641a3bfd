"""Other physics engines behind the interface `Simulation`.

A copy of the model in the engine makes every step. MuJoCo receives its positions and speeds and computes
frames, distances, rays and contacts from them. The same code thus measures catches in every engine, and a
difference in success comes from physics.
"""

import copy
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import final

import mujoco
import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray

from pixel2catch.batches import Flags
from pixel2catch.errors import InvalidValueError, NonFiniteError, UnknownNameError
from pixel2catch.sim.batch import BatchSimulation
from pixel2catch.sim.rigid_world import RigidWorld, rigid_world
from pixel2catch.sim.simulation import Distances, Field, Groups, Places, Rays, Simulation

MOST_ENVS = 64  #: Largest number of environments. Source: ours; they step one after the other in one thread.

TOUCH_DISTANCE = 1e-4
"""Distance at which MuJoCo reports a contact [m]. Source: ours: rigid bodies need not overlap; of PhysX's
contact points in a closed hand, 99 % are less than 0.01 mm apart."""

FOLLOWED = (
    *("geom_dataid", "geom_pos", "geom_quat", "geom_size", "geom_friction", "geom_solref"),
    *("body_mass", "body_ipos", "body_iquat", "body_inertia"),
    *("actuator_gainprm", "actuator_biasprm"),
)
"""Model fields that may differ between environments; a copy is built again when one of them changes."""

DERIVED = (
    *("geom_aabb", "geom_rbound", "body_subtreemass", "body_invweight0"),
    *("dof_M0", "dof_length", "dof_invweight0"),
)
"""Model fields that MuJoCo derives from these, and that only MuJoCo uses."""

Positions = Float[ndarray, " nq"]  #: MuJoCo's `qpos`.
Speeds = Float[ndarray, " nv"]  #: MuJoCo's `qvel`, and likewise `qfrc_applied`, forces on the joints.
Targets = Float[ndarray, " nu"]  #: MuJoCo's `ctrl`: targets of the servos [rad].
Wrenches = Float[ndarray, "nbody 6"]  #: MuJoCo's `xfrc_applied`, on the bodies at their centres of mass.


class EngineCopy(ABC):
    """One environment in an engine."""

    @abstractmethod
    def set_state(self, qpos: Positions, qvel: Speeds) -> None:
        """Set positions and speeds, in MuJoCo's coordinates."""

    @abstractmethod
    def step(self, ctrl: Targets, qfrc: Speeds, xfrc: Wrenches) -> None:
        """Advance by one physics step."""

    @abstractmethod
    def read_state(self, qpos: Positions, qvel: Speeds) -> None:
        """Write positions and speeds into these arrays, in MuJoCo's coordinates."""


@final
class EngineSimulation(Simulation):
    """Copies of the model in another engine, on the CPU, in one thread."""

    def __init__(
        self, model: mujoco.MjModel, num_envs: int, make_copy: Callable[[RigidWorld], EngineCopy]
    ) -> None:
        """Create the environments at the model's defaults; the first step builds the copies."""
        super().__init__(model, num_envs, torch.device("cpu"), torch.float64)
        if num_envs > MOST_ENVS:
            raise InvalidValueError(f"num_envs is {num_envs}; outside MuJoCo it is at most {MOST_ENVS}.")
        self._make_copy = make_copy
        self._scratch = copy.copy(model)
        described = copy.copy(model)
        described.geom_margin[:] = TOUCH_DISTANCE
        self._described = BatchSimulation(described, num_envs, num_threads=1)
        self._qpos, self._qvel, self._time, self._force = (
            self._described.bind(name).numpy() for name in ("qpos", "qvel", "time", "actuator_force")
        )
        self._inputs = tuple(
            self._described.bind(name).numpy() for name in ("ctrl", "qfrc_applied", "xfrc_applied")
        )
        self._fields = {name: self._described.expand(name).numpy() for name in FOLLOWED}
        self._built = {name: values.copy() for name, values in self._fields.items()}  # values of the copies
        joints = model.actuator_trnid[:, 0]
        self._reach = model.actuator_ctrlrange.T
        self._driven = model.jnt_qposadr[joints], model.jnt_dofadr[joints]
        rigid_world(model)  # raises if the model is not supported
        self._copies: dict[int, EngineCopy] = {}  # by environment, built at the first step
        self._known = np.full_like(self._state(), np.nan)  # state of the copies
        self._torque = np.zeros_like(self._force)

    def bind(self, field: str) -> Field:
        return self._described.bind(field)

    def expand(self, field: str) -> Field:
        if not self.can_expand(field):
            raise UnknownNameError("model field of another engine", field, (*FOLLOWED, *DERIVED))
        return self._described.expand(field)

    def can_expand(self, field: str) -> bool:
        """Return whether the engine uses a field or does not need it; it would ignore any other field."""
        return field in FOLLOWED or field in DERIVED

    def step(self, mask: Flags | None = None) -> None:
        self._rebuild()
        self._push_state()
        self._torque[:] = self._servo_torque()
        ctrl, qfrc, xfrc = np.clip(self._inputs[0], *self._reach), *self._inputs[1:]
        for i, each in self._copies.items():
            each.step(ctrl[i], qfrc[i], xfrc[i])
            each.read_state(self._qpos[i], self._qvel[i])
        self._known[:] = self._state()
        self._time += self.model.opt.timestep
        self.forward()

    def forward(self, mask: Flags | None = None) -> None:
        self._described.forward(mask)
        self._force[:] = self._torque

    def ray(self, origin: Places, directions: Rays, groups: Groups, mask: Flags | None = None) -> Distances:
        return self._described.ray(origin, directions, groups, mask)

    def check(self) -> None:
        """Raise if the engine diverged."""
        if lost := int((~np.isfinite(self._state())).any(axis=1).sum()):
            raise NonFiniteError(f"{lost} of {self.num_envs} environments have NaN or infinity in the state")

    def close(self) -> None:
        self._copies.clear()

    def _state(self) -> Float[ndarray, "num_envs _"]:
        return np.concatenate((self._qpos, self._qvel), axis=1)

    def _servo_torque(self) -> Float[ndarray, "num_envs nu"]:
        """Return the torques of the servos in the present state, by MuJoCo's law [N·m]."""
        positions, speeds = self._driven
        gain, bias = self._fields["actuator_gainprm"], self._fields["actuator_biasprm"]
        torque = gain[..., 0] * np.clip(self._inputs[0], *self._reach)
        torque += bias[..., 1] * self._qpos[:, positions] + bias[..., 2] * self._qvel[:, speeds]
        return np.clip(torque, *self.model.actuator_forcerange.T)

    def _push_state(self) -> None:
        """Copy states that were written since the last step to the engine."""
        is_written = (self._state() != self._known).any(axis=1)
        for i in np.flatnonzero(is_written).tolist():
            self._copies[i].set_state(self._qpos[i], self._qvel[i])

    def _rebuild(self) -> None:
        """Build missing copies, and copies whose model fields were written."""
        is_stale = np.array([i not in self._copies for i in range(self.num_envs)])
        for name, values in self._fields.items():
            if not np.array_equal(values, self._built[name]):
                is_stale |= (values != self._built[name]).reshape(self.num_envs, -1).any(axis=1)
        for i in np.flatnonzero(is_stale).tolist():
            for name, values in self._fields.items():
                getattr(self._scratch, name)[:] = values[i]
                self._built[name][i] = values[i]
            self._copies[i] = self._make_copy(rigid_world(self._scratch))
            self._known[i] = np.nan
