"""Meshes of the robots for pictures, from a checkout of the MuJoCo Menagerie; nothing collides with them."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
from jaxtyping import Float

from pixel2catch.errors import InvalidValueError
from pixel2catch.robots.mjcf import read_mjcf
from pixel2catch.robots.poses import pose_matrix, quaternion
from pixel2catch.robots.spec import MeshSource, RobotSpec
from pixel2catch.robots.workcell import VISUAL_GROUP, WorkcellSpec, parts_of, robot_mjcf

Pose = Float[np.ndarray, "4 4"]


@dataclass(frozen=True, kw_only=True)
class SeenMesh:
    """A mesh of another model."""

    body: str  #: The body that it belongs to there.
    file: Path
    pose: Pose  #: In that body's frame.
    rgba: tuple[float, ...]


def require_meshes(workcell: WorkcellSpec, folder: Path) -> None:
    """Refuse a folder that lacks a model of the robots, before anything is simulated.

    Raises:
        InvalidValueError: If it does, or if no robot of the work cell is known to have meshes there.
    """
    known = [part.meshes.mjcf for _, part in parts_of(workcell) if part.meshes]
    if not known:
        raise InvalidValueError(
            f"no meshes are known of the robots of '{workcell.name}'; leave --meshes out."
        )
    for name in known:
        if not (folder / name).is_file():
            raise InvalidValueError(
                f"there are no meshes in '{folder}': it lacks {name}. Name a checkout of "
                "github.com/google-deepmind/mujoco_menagerie; robot_descriptions keeps one in "
                "~/.cache/robot_descriptions/mujoco_menagerie."
            )


def add_meshes(spec: mujoco.MjSpec, workcell: WorkcellSpec, folder: Path) -> None:
    """Exchange what is only seen of the robots of a scene for the meshes of a checkout.

    Raises:
        InvalidValueError: As `require_meshes`, or if a model there cannot be read.
    """
    require_meshes(workcell, folder)
    for prefix, part in parts_of(workcell):
        if part.meshes:
            _dress(spec, prefix, part, part.meshes, folder)


def _dress(spec: mujoco.MjSpec, prefix: str, part: RobotSpec, source: MeshSource, folder: Path) -> None:
    """Exchange what is seen of one part."""
    meshes, theirs = _seen_meshes(folder / source.mjcf)
    ours = _body_poses(robot_mjcf(part))
    bodies = dict(source.bodies)
    for name in set(bodies.values()):
        for geom in tuple(spec.body(prefix + name).geoms):
            if geom.group == VISUAL_GROUP:
                spec.delete(geom)
    theirs_root = next(name for name, body in source.bodies if body == part.root)
    to_root = (
        ours[part.root] @ pose_matrix(source.pos, (1.0, 0.0, 0.0, 0.0)) @ np.linalg.inv(theirs[theirs_root])
    )
    for number, mesh in enumerate(meshes):
        body = bodies[mesh.body]
        pose = np.linalg.inv(ours[body]) @ to_root @ theirs[mesh.body] @ mesh.pose
        name = f"{prefix}{part.name}_mesh_{number}"
        spec.add_mesh(
            name=name, file=str(mesh.file.resolve()), inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
        )
        spec.body(prefix + body).add_geom(
            type=mujoco.mjtGeom.mjGEOM_MESH,
            meshname=name,
            pos=pose[:3, 3],
            quat=quaternion(pose[:3, :3]),
            rgba=mesh.rgba,
            mass=0.0,
            group=VISUAL_GROUP,
            contype=0,
            conaffinity=0,
        )


def _seen_meshes(path: Path) -> tuple[list[SeenMesh], Mapping[str, Pose]]:
    """The meshes of a model that are only seen, and the poses of its bodies with all joints at 0."""
    try:
        spec = read_mjcf(path)
        folder = path.parent / spec.meshdir
        found = [
            SeenMesh(
                body=geom.parent.name,
                file=folder / spec.mesh(geom.meshname).file,
                pose=pose_matrix(geom.pos, geom.quat),
                rgba=tuple((spec.material(geom.material) if geom.material else geom).rgba.tolist()),
            )
            for geom in spec.geoms
            if geom.type == mujoco.mjtGeom.mjGEOM_MESH and geom.group == VISUAL_GROUP
        ]
        for element in (*spec.geoms, *spec.meshes):
            spec.delete(element)
        return found, _body_poses(spec)
    except (OSError, ValueError) as error:
        raise InvalidValueError(f"cannot read the meshes of {path}: {error}") from error


def _body_poses(spec: mujoco.MjSpec) -> dict[str, Pose]:
    spec.compiler.boundmass, spec.compiler.boundinertia = 1e-3, 1e-9  # it may have lost what has mass
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    return {model.body(i).name: pose_matrix(data.xpos[i], data.xquat[i]) for i in range(model.nbody)}
