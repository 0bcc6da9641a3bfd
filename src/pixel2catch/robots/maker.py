"""Manufacturers' models, URDF or MJCF, as the simulated body in place of ours; names do not matter.

Joints are told apart by where their axes are with all at 0, which also says how both roots lie to each other.
Axes, masses and surfaces become the maker's; limits, servos, sites and what policies know of the robot stay.
"""

from dataclasses import dataclass
from functools import cache
from itertools import permutations
from pathlib import Path
from typing import Literal

import mujoco
import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy.spatial.transform import Rotation

from pixel2catch.errors import InvalidValueError
from pixel2catch.robots.chain import quaternion
from pixel2catch.robots.mjcf import read_mjcf
from pixel2catch.robots.spec import RobotSpec
from pixel2catch.robots.workcell import COLLISION_GROUP, WorkcellSpec, add_robots, parts_of, robot_mjcf

Surface = Literal["collision", "visual"]
Pose = Float[ndarray, "4 4"]
Line = tuple[Float[ndarray, "3"], Float[ndarray, "3"]]
"""A point of an axis [m] and its direction, of length 1."""

MOST_ANGLE, MOST_DISTANCE = 0.05, 0.005
"""How far axes may be from ours [rad, m]. Source: ours; makers differ among themselves by up to 1.4 mm."""

MASSLESS = 1e-4  #: What weighs less has no mass in a model [kg].
ARM_LENGTH = 0.1  #: What an error of 1 rad of an axis counts when roots are laid on each other [m].
NUM_STARTS = 4  #: Orders of the chains that are looked at closely, of those that fit roughly.
HULL_POINTS = 250  #: Points that a mesh's convex hull is made of. Source: ours; PhysX takes at most 255.


@dataclass(frozen=True, kw_only=True)
class MakerGeom:
    """A convex shape of a body of ours."""

    body: str
    type: mujoco.mjtGeom
    size: Float[ndarray, "3"]  #: As in MuJoCo [m].
    vertices: Float[ndarray, "num_vertices 3"]  #: Of a mesh [m]; of others none.
    pose: Pose  #: In the frame of the body.
    rgba: tuple[float, ...]


@dataclass(frozen=True, kw_only=True)
class MakerPart:
    """What of a part of a robot is the maker's."""

    bodies: tuple[str, ...]  #: Bodies of ours that it has.
    axes: dict[str, Line]  #: Of each joint of ours, in the frame of its body.
    #: Of each body of ours mass [kg], centre [m] and inertia about it [kg·m²], in its frame; of those that
    #: have no mass there nothing.
    inertials: dict[str, tuple[float, Float[ndarray, "3"], Float[ndarray, "3 3"]]]
    geoms: tuple[MakerGeom, ...]
    distance: float  #: Largest distance of an axis from ours [m].
    angle: float  #: Largest angle of an axis with ours [rad].


def add_maker_bodies(
    spec: mujoco.MjSpec, workcell: WorkcellSpec, files: tuple[str, ...], surface: Surface
) -> None:
    """Exchange the bodies of the robots in a scene for makers' models.

    Raises:
        InvalidValueError: If a file is no model of a part of the robots, or cannot be read.
    """
    _exchange(spec, maker_parts(workcell, files, surface))
    named = {tuple(sorted((pair.bodyname1, pair.bodyname2))) for pair in spec.excludes}
    for pair in _overlapping(workcell, files, surface) - named:
        spec.add_exclude(bodyname1=pair[0], bodyname2=pair[1])


@cache
def maker_parts(
    workcell: WorkcellSpec, files: tuple[str, ...], surface: Surface
) -> dict[tuple[str, str], MakerPart]:
    """The makers' parts by the prefix and name of ours, each file for all that it is a model of.

    Raises:
        InvalidValueError: As `add_maker_bodies`.
    """
    ours = {(prefix, part.name): part for prefix, part in parts_of(workcell)}
    found: dict[tuple[str, str], MakerPart] = {}
    for file in files:
        theirs, problems = _compiled(Path(file), surface), []
        for key, part in ours.items():
            read = _fitted(part, theirs, surface)
            if isinstance(read, str):
                problems.append(f"{part.name}: {read}")
            elif key in found:
                raise InvalidValueError(f"{file} is a second model of {part.name}; name one of each part")
            else:
                found[key] = read
        if len(problems) == len(ours):
            reasons = "; ".join(problems)
            raise InvalidValueError(f"{file} is no model of a part of '{workcell.name}': {reasons}")
    return found


def _fitted(part: RobotSpec, theirs: mujoco.MjModel, surface: Surface) -> MakerPart | str:
    """What is the maker's of a part, or why it is another robot."""
    ours = robot_mjcf(part, visuals=False).compile()
    chains = _chains(ours), _chains(theirs)
    if len(chains[0]) != len(chains[1]):
        return f"it has {len(chains[0])} chains of joints, the file {len(chains[1])}"
    own_axes, their_axes, tries = _axes(ours), _axes(theirs), []
    lines = [own_axes[joint] for chain in chains[0] for joint in chain]
    for order in permutations(range(len(chains[1]))):
        pairs = [(own, chains[1][i]) for own, i in zip(chains[0], order, strict=True)]
        if all(len(own) <= len(other) for own, other in pairs):
            matched = [their_axes[joint] for own, other in pairs for joint in other[-len(own) :]]
            tries.append((*_laid(lines, matched), matched, pairs))
    if not tries:
        return "the file has fewer joints"
    tries.sort(key=lambda each: each[1])
    fits = []
    for start, _, matched, pairs in tries[:NUM_STARTS]:
        root = _refined(lines, matched, start)
        fits.append((*_misfit(lines, matched, root), root, pairs))
    distance, angle, root, pairs = min(fits, key=lambda each: each[0])
    if distance > MOST_DISTANCE or angle > MOST_ANGLE:
        return f"an axis is {1e3 * distance:.0f} mm and {1e3 * angle:.0f} mrad from where it should be"
    return _part(ours, theirs, pairs, root, surface, (distance, angle))


def _part(
    ours: mujoco.MjModel,
    theirs: mujoco.MjModel,
    pairs: list[tuple[list[int], list[int]]],
    root: Pose,
    surface: Surface,
    misfit: tuple[float, float],
) -> MakerPart:
    """Put what moves with each joint of theirs into the body of ours."""
    own, their_axes = _body_poses(ours), _axes(theirs)
    moves = {0: int(ours.body_rootid[ours.jnt_bodyid[0]])}  # what does not move is our root
    roots = [int(theirs.body_parentid[theirs.jnt_bodyid[others[0]]]) for _, others in pairs]
    axes = {}
    for root_body, (joints, others) in zip(roots, pairs, strict=True):
        ahead = int(ours.body_parentid[ours.jnt_bodyid[joints[0]]])
        if roots.count(root_body) == 1:  # a link that is fixed to the palm
            moves[root_body] = ahead
        moves |= {int(theirs.jnt_bodyid[other]): ahead for other in others[: -len(joints)]}
        for joint, other in zip(joints, others[-len(joints) :], strict=True):
            body = int(ours.jnt_bodyid[joint])
            moves[int(theirs.jnt_bodyid[other])] = body
            point, direction = _seen(their_axes[other], np.linalg.inv(own[body]) @ root)
            point = point + direction * (direction @ (ours.jnt_pos[joint] - point))
            axes[ours.joint(joint).name] = point, direction * np.sign(direction @ ours.jnt_axis[joint])
    frames = _body_poses(theirs)
    bodies: dict[int, list[int]] = {}
    for body in range(1, theirs.nbody):
        above = body
        while above not in moves:
            above = int(theirs.body_parentid[above])
        bodies.setdefault(moves[above], []).append(body)
    to_ours = {body: np.linalg.inv(own[body]) @ root for body in bodies}
    geoms = tuple(
        _geom(theirs, geom, ours.body(body).name, to_ours[body] @ frames[theirs.geom_bodyid[geom]])
        for body, members in bodies.items()
        for geom in np.flatnonzero(np.isin(theirs.geom_bodyid, members)).tolist()
        if _is_of(theirs, geom, surface)
    )
    inertials = {
        ours.body(body).name: _inertial(theirs, [(to_ours[body] @ frames[i], i) for i in members])
        for body, members in bodies.items()
        if theirs.body_mass[members].sum() > MASSLESS
    }
    names = tuple(ours.body(body).name for body in bodies)
    distance, angle = misfit
    return MakerPart(
        bodies=names, axes=axes, inertials=inertials, geoms=geoms, distance=distance, angle=angle
    )


def _compiled(path: Path, surface: Surface) -> mujoco.MjModel:
    try:
        spec = read_mjcf(path)
        if path.suffix == ".urdf":  # what has no mass there shall not be filled with water
            for geom in spec.geoms:
                geom.mass = 0.0
        spec.compiler.balanceinertia = True  # the hand's maker publishes impossible ones
        spec.compiler.boundmass, spec.compiler.boundinertia = 1e-6, 1e-12
        model = spec.compile()
    except (OSError, ValueError) as error:
        raise InvalidValueError(f"cannot read the robot model {path}: {error}") from error
    if (model.jnt_type != int(mujoco.mjtJoint.mjJNT_HINGE)).any() or not model.njnt:
        raise InvalidValueError(f"the robot model {path} has other joints than hinges, or none")
    if not any(_is_of(model, geom, surface) for geom in range(model.ngeom)):
        other = "collision" if surface == "visual" else "visual"
        raise InvalidValueError(f"the robot model {path} has no {surface} shapes; take its {other} ones")
    return model


def _is_of(model: mujoco.MjModel, geom: int, surface: Surface) -> bool:
    return bool(model.geom_contype[geom] or model.geom_conaffinity[geom]) == (surface == "collision")


def _chains(model: mujoco.MjModel) -> list[list[int]]:
    """Joints from the root to each last one; those that several have in common are refused as of no chain."""
    joint_of = {int(body): joint for joint, body in enumerate(model.jnt_bodyid)}
    chains: dict[int, list[int]] = {}
    for joint, body in enumerate(model.jnt_bodyid.tolist()):
        under = int(model.body_weldid[model.body_parentid[body]])
        chains[joint] = [*chains.pop(joint_of.get(under, -1), []), joint]
    return list(chains.values())


def _axes(model: mujoco.MjModel) -> list[Line]:
    """The axis of every joint with all joints at 0, seen from the world."""
    poses = _body_poses(model)
    lines = zip(model.jnt_pos, model.jnt_axis, model.jnt_bodyid, strict=True)
    return [_seen((point, direction), poses[body]) for point, direction, body in lines]


def _body_poses(model: mujoco.MjModel) -> Float[ndarray, "nbody 4 4"]:
    data = mujoco.MjData(model)
    data.qpos[:] = 0.0
    mujoco.mj_kinematics(model, data)
    poses = np.tile(np.eye(4), (model.nbody, 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = data.xmat.reshape(-1, 3, 3), data.xpos
    return poses


def _seen(line: Line, pose: Pose) -> Line:
    return pose[:3, :3] @ line[0] + pose[:3, 3], pose[:3, :3] @ line[1]


def _laid(ours: list[Line], theirs: list[Line]) -> tuple[Pose, float]:
    """The pose of their root in ours that lays points of axes on each other, and what is left [m]."""
    points = [np.array([point for point, _ in lines]) for lines in (ours, theirs)]
    centers = [each.mean(axis=0) for each in points]
    turn, left = Rotation.align_vectors(points[0] - centers[0], points[1] - centers[1])[:2]
    pose = np.eye(4)
    pose[:3, :3] = turn.as_matrix()
    pose[:3, 3] = centers[0] - pose[:3, :3] @ centers[1]
    return pose, float(left)


def _refined(ours: list[Line], theirs: list[Line], start: Pose) -> Pose:
    """The pose that lays the axes themselves on each other, wherever their points are."""
    from scipy.optimize import least_squares

    def moved(x: Float[ndarray, "6"]) -> Pose:
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_rotvec(x[:3]).as_matrix() @ start[:3, :3]
        pose[:3, 3] = start[:3, 3] + x[3:]
        return pose

    def gaps(x: Float[ndarray, "6"]) -> Float[ndarray, " gaps"]:
        return np.concatenate([_gap(a, _seen(b, moved(x))) for a, b in zip(ours, theirs, strict=True)])

    return moved(least_squares(gaps, np.zeros(6)).x)


def _gap(ours: Line, theirs: Line) -> Float[ndarray, "6"]:
    away = theirs[0] - ours[0]
    return np.concatenate((away - ours[1] * (ours[1] @ away), ARM_LENGTH * np.cross(ours[1], theirs[1])))


def _misfit(ours: list[Line], theirs: list[Line], root: Pose) -> tuple[float, float]:
    """Largest distance [m] and angle [rad] of an axis of theirs from ours."""
    gaps = np.array([_gap(a, _seen(b, root)) for a, b in zip(ours, theirs, strict=True)])
    sines = np.linalg.norm(gaps[:, 3:], axis=1) / ARM_LENGTH
    return float(np.linalg.norm(gaps[:, :3], axis=1).max()), float(np.arcsin(np.minimum(sines, 1.0)).max())


def _inertial(
    model: mujoco.MjModel, placed: list[tuple[Pose, int]]
) -> tuple[float, Float[ndarray, "3"], Float[ndarray, "3 3"]]:
    """Mass, centre and inertia of bodies together, each with its pose."""
    masses = np.array([model.body_mass[body] for _, body in placed])
    centers = np.array([pose[:3, :3] @ model.body_ipos[body] + pose[:3, 3] for pose, body in placed])
    mass = float(masses.sum())
    center = masses @ centers / mass if mass else centers.mean(axis=0)
    total = np.zeros((3, 3))
    for (pose, body), share, point in zip(placed, masses, centers - center, strict=True):
        axes = np.empty(9)
        mujoco.mju_quat2Mat(axes, model.body_iquat[body])
        turn = pose[:3, :3] @ axes.reshape(3, 3)
        total += turn @ np.diag(model.body_inertia[body]) @ turn.T
        total += share * (point @ point * np.eye(3) - np.outer(point, point))
    return mass, center, total


def _geom(model: mujoco.MjModel, geom: int, body: str, frame: Pose) -> MakerGeom:
    kind, vertices = mujoco.mjtGeom(model.geom_type[geom]), np.zeros((0, 3))
    if kind == mujoco.mjtGeom.mjGEOM_MESH:
        mesh = model.geom_dataid[geom]
        first = model.mesh_vertadr[mesh]
        vertices = model.mesh_vert[first : first + model.mesh_vertnum[mesh]].astype(float)
        outermost = (vertices @ directions(HULL_POINTS).T).argmax(axis=0)  # the farthest in each direction
        vertices = vertices[np.unique(outermost)]
    turn, pose, paint = np.empty(9), np.eye(4), model.geom_matid[geom]
    mujoco.mju_quat2Mat(turn, model.geom_quat[geom])
    pose[:3, :3], pose[:3, 3] = turn.reshape(3, 3), model.geom_pos[geom]
    return MakerGeom(
        body=body,
        type=kind,
        size=np.array(model.geom_size[geom]),
        vertices=vertices,
        pose=frame @ pose,
        rgba=tuple((model.mat_rgba[paint] if paint >= 0 else model.geom_rgba[geom]).tolist()),
    )


def directions(count: int) -> Float[ndarray, "count 3"]:
    """Points spread evenly over the unit sphere, on a golden spiral."""
    z = 1.0 - (2.0 * np.arange(count) + 1.0) / count
    angle, radius = np.pi * (3.0 - np.sqrt(5.0)) * np.arange(count), np.sqrt(1.0 - z**2)
    return np.column_stack((radius * np.cos(angle), radius * np.sin(angle), z))


def _exchange(spec: mujoco.MjSpec, parts: dict[tuple[str, str], MakerPart]) -> None:
    for (prefix, part_name), part in parts.items():
        for name, (point, direction) in part.axes.items():
            joint = spec.joint(prefix + name)
            joint.pos, joint.axis = point, direction
        for name in part.bodies:
            for geom in tuple(spec.body(prefix + name).geoms):
                spec.delete(geom)
        for name, (mass, center, inertia) in part.inertials.items():
            body = spec.body(prefix + name)
            moments, axes = np.linalg.eigh(inertia)
            axes[:, 2] *= np.sign(np.linalg.det(axes))
            body.explicitinertial, body.mass, body.ipos, body.inertia = True, mass, center, moments
            body.iquat = quaternion(axes)
        for number, geom in enumerate(part.geoms):
            name, extra = f"{prefix}{part_name}_maker_{number}", {}
            if len(geom.vertices):
                spec.add_mesh(name=name, uservert=geom.vertices.ravel())
                extra = {"meshname": name}
            spec.body(prefix + geom.body).add_geom(
                name=name,
                type=geom.type,
                size=geom.size,
                pos=geom.pose[:3, 3],
                quat=quaternion(geom.pose[:3, :3]),
                mass=0.0,
                group=COLLISION_GROUP,
                rgba=geom.rgba,
                **extra,
            )


@cache
def _overlapping(workcell: WorkcellSpec, files: tuple[str, ...], surface: Surface) -> set[tuple[str, str]]:
    """Pairs of bodies that touch at the start, where no robot does: hulls fill what is hollow."""
    spec = mujoco.MjSpec()
    add_robots(spec, workcell, visuals=False)
    _exchange(spec, maker_parts(workcell, files, surface))
    model = spec.compile()
    data = mujoco.MjData(model)
    data.qpos[:] = [joint.home for joint in workcell.joints]
    mujoco.mj_forward(model, data)
    bodies = [[model.body(model.geom_bodyid[i]).name for i in contact.geom] for contact in data.contact]
    return {(min(pair), max(pair)) for pair in bodies}
