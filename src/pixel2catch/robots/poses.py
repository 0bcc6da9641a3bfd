"""Poses as homogeneous matrices, mass properties of rigid bodies, vertices of meshes."""

from collections.abc import Sequence

import mujoco
import numpy as np
from jaxtyping import Float
from numpy import ndarray

Pose = Float[ndarray, "4 4"]
"""A frame in another frame: rotation and position [m] as a homogeneous matrix."""

Inertial = tuple[float, Float[ndarray, "3"], Float[ndarray, "3 3"]]
"""Mass [kg], centre of mass [m] and inertia about that centre [kg·m²]."""


def rotation_matrix(quat: Sequence[float] | ndarray) -> Float[ndarray, "3 3"]:
    """Return the rotation matrix of a unit quaternion (w, x, y, z)."""
    rotation = np.empty(9)
    mujoco.mju_quat2Mat(rotation, np.asarray(quat, dtype=float))
    return rotation.reshape(3, 3)


def quaternion(rotation: Float[ndarray, "3 3"]) -> Float[ndarray, "4"]:
    """Return the quaternion (w, x, y, z) of a rotation matrix."""
    quat = np.empty(4)
    mujoco.mju_mat2Quat(quat, rotation.ravel())
    return quat


def pose_of(pos: ndarray, rotation: ndarray) -> Pose:
    """Return the pose of a position [m] and a rotation matrix, (3, 3) or flat."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation.reshape(3, 3), pos
    return pose


def pose_matrix(pos: Sequence[float] | ndarray, quat: Sequence[float] | ndarray) -> Pose:
    """Return the pose of a position [m] and a quaternion (w, x, y, z) of any length."""
    return pose_of(np.asarray(pos), rotation_matrix(np.asarray(quat, dtype=float) / np.linalg.norm(quat)))


def inertial_of(model: mujoco.MjModel, body: int, pose: Pose) -> Inertial:
    """Return the mass properties of a body of a model, seen from the frame in which it has this pose."""
    axes = pose[:3, :3] @ rotation_matrix(model.body_iquat[body])
    center = pose[:3, :3] @ model.body_ipos[body] + pose[:3, 3]
    return float(model.body_mass[body]), center, axes @ np.diag(model.body_inertia[body]) @ axes.T


def vertices_of(model: mujoco.MjModel, geom: int) -> Float[ndarray, "num_vertices 3"]:
    """Return the vertices of a mesh geom [m]; none for other geoms."""
    if model.geom_type[geom] != mujoco.mjtGeom.mjGEOM_MESH:
        return np.zeros((0, 3))
    mesh = model.geom_dataid[geom]
    first = model.mesh_vertadr[mesh]
    return model.mesh_vert[first : first + model.mesh_vertnum[mesh]].astype(float)


def combined(bodies: Sequence[Inertial]) -> Inertial:
    """Return the mass properties of several bodies as one, in their common frame."""
    masses = np.array([mass for mass, _, _ in bodies])
    centers = np.array([center for _, center, _ in bodies])
    mass = float(masses.sum())
    center = masses @ centers / mass if mass else centers.mean(axis=0)
    total = np.zeros((3, 3))
    for share, arm, (_, _, inertia) in zip(masses, centers - center, bodies, strict=True):
        total += inertia + share * (arm @ arm * np.eye(3) - np.outer(arm, arm))
    return mass, center, total


def principal_axes(inertia: Float[ndarray, "3 3"]) -> tuple[Float[ndarray, "3"], Float[ndarray, "3 3"]]:
    """Return principal moments of inertia, and the right-handed axes as columns."""
    moments, axes = np.linalg.eigh(inertia)
    axes[:, 2] *= np.sign(np.linalg.det(axes))
    return moments, axes


def sphere_points(count: int) -> Float[ndarray, "count 3"]:
    """Return points on the unit sphere, on a golden spiral, each for an equal area."""
    k = np.arange(count) + 0.5
    height = 1 - 2 * k / count
    angle = np.pi * (1 + np.sqrt(5)) * k
    ring = np.sqrt(1 - height**2)
    return np.column_stack((ring * np.cos(angle), ring * np.sin(angle), height))
