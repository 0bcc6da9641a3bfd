"""What differs between the models of two objects: rows to write into per-environment model fields."""

from dataclasses import dataclass
from functools import cache

import mujoco
import numpy as np
from numpy import ndarray

from pixel2catch.scene.objects import MAX_PARTS, OBJECTS
from pixel2catch.scene.scene import SceneCfg, build_model

GEOM_FIELDS = ("geom_dataid", "geom_pos", "geom_quat", "geom_size", "geom_aabb", "geom_rbound")
BODY_FIELDS = ("body_mass", "body_subtreemass", "body_inertia", "body_ipos", "body_iquat", "body_invweight0")
DOF_FIELDS = ("dof_M0", "dof_length", "dof_invweight0")


@dataclass(frozen=True, kw_only=True)
class ObjectIndices:
    """Where the object is in the arrays of the model."""

    body: int
    geoms: slice  #: Its geoms, one after the other.
    qpos: slice  #: Its position and quaternion in `qpos`.
    dofs: slice  #: Its linear and angular velocity in `qvel`.

    def rows(self, field: str) -> slice:
        """Rows of a model field that belong to the object."""
        if field.startswith("geom_"):
            return self.geoms
        return self.dofs if field.startswith("dof_") else slice(self.body, self.body + 1)


@dataclass(frozen=True, kw_only=True)
class ObjectTable:
    """The object's rows of every model field that depends on the object."""

    names: tuple[str, ...]  #: The objects, in the order of the first axis of each array.
    indices: ObjectIndices  #: Where those rows belong.
    fields: dict[str, ndarray]  #: Field name to array (num_objects, rows, ...).


def object_indices(model: mujoco.MjModel) -> ObjectIndices:
    """Find the object in a model."""
    body = model.body("object").id
    joint = model.joint("object_joint")
    first = int(model.body_geomadr[body])
    qpos, dof = int(joint.qposadr[0]), int(joint.dofadr[0])
    return ObjectIndices(
        body=body, geoms=slice(first, first + MAX_PARTS), qpos=slice(qpos, qpos + 7), dofs=slice(dof, dof + 6)
    )


@cache
def object_table(cfg: SceneCfg) -> ObjectTable:
    """Compile the scene once with each object and read off what differs."""
    models = [build_model(cfg, name) for name in OBJECTS]
    indices = object_indices(models[0])
    fields = {
        field: np.stack([_rows(model, field, indices) for model in models])
        for field in (*GEOM_FIELDS, *BODY_FIELDS, *DOF_FIELDS)
    }
    return ObjectTable(names=tuple(OBJECTS), indices=indices, fields=fields)


def _rows(model: mujoco.MjModel, field: str, indices: ObjectIndices) -> ndarray:
    values = getattr(model, field)
    return np.array(values.reshape(len(values), -1) if values.ndim > 2 else values)[indices.rows(field)]
