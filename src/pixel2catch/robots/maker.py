"""Manufacturers' models, URDF or MJCF, simulated in place of the package's models.

Joints are matched by the positions of their axes with all angles at 0, not by names; the match gives the pose
of the maker's root. Axes, masses and surfaces become the maker's. Limits, servos and sites stay, and so does
the kinematic model of the policies.
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
from pixel2catch.robots.poses import (
    Inertial,
    Pose,
    combined,
    inertial_of,
    pose_matrix,
    pose_of,
    principal_axes,
    quaternion,
    sphere_points,
    vertices_of,
)
from pixel2catch.robots.spec import RobotSpec
from pixel2catch.robots.workcell import (
    COLLISION_GROUP,
    WorkcellSpec,
    add_robots,
    parts_of,
    read_mjcf,
    robot_mjcf,
)

Surface = Literal["collision", "visual"]
Line = tuple[Float[ndarray, "3"], Float[ndarray, "3"]]
"""A point of an axis [m] and its direction, of length 1."""

MOST_ANGLE, MOST_DISTANCE = 0.05, 0.005
"""Largest deviation of an axis from ours [rad, m]. Source: ours; makers' models differ by up to 1.4 mm."""

MASSLESS = 1e-4  #: A body that weighs less has no mass in a model [kg].
ARM_LENGTH = 0.1  #: Weight of an angular error of an axis against its distance in the fit of roots [m/rad].
NUM_STARTS = 4
"""Number of assignments of the maker's chains to ours that are refined: those of the least rough error."""

HULL_POINTS = 250  #: Points of a mesh's convex hull. Source: ours; PhysX accepts at most 255.


@dataclass(frozen=True, kw_only=True)
class MakerGeom:
    """A convex shape of a maker's model, on a body of our model."""

    body: str
    type: mujoco.mjtGeom
    size: Float[ndarray, "3"]  #: As in MuJoCo [m].
    vertices: Float[ndarray, "num_vertices 3"]  #: Vertices of a mesh [m]; empty for other shapes.
    pose: Pose  #: In the frame of the body.
    rgba: tuple[float, ...]


@dataclass(frozen=True, kw_only=True)
class MakerPart:
    """The maker's values of one part of a robot."""

    bodies: tuple[str, ...]  #: Names of our bodies that it covers.
    axes: dict[str, Line]  #: Axis of each of our joints, in the frame of its body.
    inertials: dict[str, Inertial]  #: Mass properties of our bodies, in their frames, without massless ones.
    geoms: tuple[MakerGeom, ...]
    distance: float  #: Largest distance of an axis from ours [m].
    angle: float  #: Largest angle between a joint axis of the maker and ours [rad].


def add_maker_bodies(
    spec: mujoco.MjSpec, workcell: WorkcellSpec, files: tuple[str, ...], surface: Surface
) -> None:
    """Replace the bodies of the robots in a scene by makers' models; raise as `maker_parts` does."""
    _exchange(spec, maker_parts(workcell, files, surface))
    named = {tuple(sorted((pair.bodyname1, pair.bodyname2))) for pair in spec.excludes}
    for pair in _overlapping(workcell, files, surface) - named:
        spec.add_exclude(bodyname1=pair[0], bodyname2=pair[1])


@cache
def maker_parts(
    workcell: WorkcellSpec, files: tuple[str, ...], surface: Surface
) -> dict[tuple[str, str], MakerPart]:
    """Return the makers' parts by prefix and name of our part; one file may match several parts.

    Raises:
        InvalidValueError: A file is no model of a part of the robots, or cannot be read.
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
                raise InvalidValueError(f"{file} is a second model of {part.name}; give one for each part.")
            else:
                found[key] = read
        if len(problems) == len(ours):
            reasons = "; ".join(problems)
            raise InvalidValueError(f"{file} is no model of a part of '{workcell.name}': {reasons}.")
    return found


def _fitted(part: RobotSpec, theirs: mujoco.MjModel, surface: Surface) -> MakerPart | str:
    """Return the maker's values of a part, or the reason why the file is another robot."""
    ours = robot_mjcf(part, visuals=False).compile()
    chains = _chains(ours), _chains(theirs)
    if len(chains[0]) != len(chains[1]):
        return f"it has {len(chains[0])} chains of joints, the file has {len(chains[1])}"
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
        return f"an axis is off by {1e3 * distance:.0f} mm and {1e3 * angle:.0f} mrad"
    return _part(ours, theirs, pairs, root, surface, (distance, angle))


def _part(
    ours: mujoco.MjModel,
    theirs: mujoco.MjModel,
    pairs: list[tuple[list[int], list[int]]],
    root: Pose,
    surface: Surface,
    misfit: tuple[float, float],
) -> MakerPart:
    """Assign the maker's bodies to ours by the joint that moves them."""
    own, their_axes = _body_poses(ours), _axes(theirs)
    moves = {0: int(ours.body_rootid[ours.jnt_bodyid[0]])}  # fixed bodies belong to our root
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
        ours.body(body).name: combined([inertial_of(theirs, i, to_ours[body] @ frames[i]) for i in members])
        for body, members in bodies.items()
        if theirs.body_mass[members].sum() > MASSLESS
    }
    names = tuple(ours.body(body).name for body in bodies)
    return MakerPart(
        bodies=names, axes=axes, inertials=inertials, geoms=geoms, distance=misfit[0], angle=misfit[1]
    )


def _compiled(path: Path, surface: Surface) -> mujoco.MjModel:
    try:
        spec = read_mjcf(path)
        if path.suffix == ".urdf":  # MuJoCo would derive masses from shapes, at the density of water
            for geom in spec.geoms:
                geom.mass = 0.0
        spec.compiler.balanceinertia = True  # the hand's maker publishes inertias that no body can have
        spec.compiler.boundmass, spec.compiler.boundinertia = 1e-6, 1e-12
        model = spec.compile()
    except (OSError, ValueError) as error:
        raise InvalidValueError(f"the robot model {path} cannot be read: {error}.") from error
    if (model.jnt_type != int(mujoco.mjtJoint.mjJNT_HINGE)).any() or not model.njnt:
        raise InvalidValueError(f"the robot model {path} has no hinges or other joints; use hinges only.")
    if not any(_is_of(model, geom, surface) for geom in range(model.ngeom)):
        other = "collision" if surface == "visual" else "visual"
        raise InvalidValueError(f"the robot model {path} has no {surface} shapes; use its {other} shapes.")
    return model


def _is_of(model: mujoco.MjModel, geom: int, surface: Surface) -> bool:
    return bool(model.geom_contype[geom] or model.geom_conaffinity[geom]) == (surface == "collision")


def _chains(model: mujoco.MjModel) -> list[list[int]]:
    """Return the joints from the root to each tip; a joint shared by chains belongs to one of them only."""
    joint_of = {int(body): joint for joint, body in enumerate(model.jnt_bodyid)}
    chains: dict[int, list[int]] = {}
    for joint, body in enumerate(model.jnt_bodyid.tolist()):
        under = int(model.body_weldid[model.body_parentid[body]])
        chains[joint] = [*chains.pop(joint_of.get(under, -1), []), joint]
    return list(chains.values())


def _axes(model: mujoco.MjModel) -> list[Line]:
    """Return the axis of every joint in the world, with all joints at 0."""
    poses = _body_poses(model)
    lines = zip(model.jnt_pos, model.jnt_axis, model.jnt_bodyid, strict=True)
    return [_seen((point, direction), poses[body]) for point, direction, body in lines]


def _body_poses(model: mujoco.MjModel) -> Float[ndarray, "nbody 4 4"]:
    data = mujoco.MjData(model)
    data.qpos[:] = 0.0
    mujoco.mj_kinematics(model, data)
    return np.array([pose_of(pos, rotation) for pos, rotation in zip(data.xpos, data.xmat, strict=True)])


def _seen(line: Line, pose: Pose) -> Line:
    return pose[:3, :3] @ line[0] + pose[:3, 3], pose[:3, :3] @ line[1]


def _laid(ours: list[Line], theirs: list[Line]) -> tuple[Pose, float]:
    """Return the pose of their root in ours that aligns points of the axes, and the residual [m]."""
    points = [np.array([point for point, _ in lines]) for lines in (ours, theirs)]
    centers = [each.mean(axis=0) for each in points]
    turn, left = Rotation.align_vectors(points[0] - centers[0], points[1] - centers[1])[:2]
    rotation = turn.as_matrix()
    return pose_of(centers[0] - rotation @ centers[1], rotation), float(left)


def _refined(ours: list[Line], theirs: list[Line], start: Pose) -> Pose:
    """Return the pose that aligns the axes themselves, independent of the points along them."""
    from scipy.optimize import least_squares

    def moved(x: Float[ndarray, "6"]) -> Pose:
        return pose_of(start[:3, 3] + x[3:], Rotation.from_rotvec(x[:3]).as_matrix() @ start[:3, :3])

    def gaps(x: Float[ndarray, "6"]) -> Float[ndarray, " gaps"]:
        return np.concatenate([_gap(a, _seen(b, moved(x))) for a, b in zip(ours, theirs, strict=True)])

    return moved(least_squares(gaps, np.zeros(6)).x)


def _gap(ours: Line, theirs: Line) -> Float[ndarray, "6"]:
    away = theirs[0] - ours[0]
    return np.concatenate((away - ours[1] * (ours[1] @ away), ARM_LENGTH * np.cross(ours[1], theirs[1])))


def _misfit(ours: list[Line], theirs: list[Line], root: Pose) -> tuple[float, float]:
    """Return the largest distance [m] and angle [rad] of their axes from ours."""
    gaps = np.array([_gap(a, _seen(b, root)) for a, b in zip(ours, theirs, strict=True)])
    sines = np.linalg.norm(gaps[:, 3:], axis=1) / ARM_LENGTH
    return float(np.linalg.norm(gaps[:, :3], axis=1).max()), float(np.arcsin(np.minimum(sines, 1.0)).max())


def _geom(model: mujoco.MjModel, geom: int, body: str, frame: Pose) -> MakerGeom:
    vertices = vertices_of(model, geom)
    if len(vertices):
        vertices = vertices[np.unique((vertices @ sphere_points(HULL_POINTS).T).argmax(axis=0))]
    material = model.geom_matid[geom]
    return MakerGeom(
        body=body,
        type=mujoco.mjtGeom(model.geom_type[geom]),
        size=np.array(model.geom_size[geom]),
        vertices=vertices,
        pose=frame @ pose_matrix(model.geom_pos[geom], model.geom_quat[geom]),
        rgba=tuple((model.mat_rgba[material] if material >= 0 else model.geom_rgba[geom]).tolist()),
    )


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
            moments, axes = principal_axes(inertia)
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
    """Return pairs of bodies that touch at the start only because convex hulls fill hollows."""
    spec = mujoco.MjSpec()
    add_robots(spec, workcell, visuals=False)
    _exchange(spec, maker_parts(workcell, files, surface))
    model = spec.compile()
    data = mujoco.MjData(model)
    data.qpos[:] = [joint.home for joint in workcell.joints]
    mujoco.mj_forward(model, data)
    bodies = [[model.body(model.geom_bodyid[i]).name for i in contact.geom] for contact in data.contact]
    return {(min(pair), max(pair)) for pair in bodies}
