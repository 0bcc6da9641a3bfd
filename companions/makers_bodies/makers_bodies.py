"""Write a work cell with manufacturers' models, URDF or MJCF, in place of the package's bodies.

Joints are matched by the positions of their axes with all angles at 0, not by names; the match gives the pose
of the maker's root. Axes, masses and surfaces become the maker's. Limits, servos and sites stay.
"""

import argparse
import sys
from collections import Counter
from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass, replace
from itertools import permutations
from pathlib import Path
from typing import Literal
from xml.etree import ElementTree

import mujoco
import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

import pixel2catch as p2c
from pixel2catch.files import read_bytes
from pixel2catch.robots.poses import (
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
from pixel2catch.robots.spec import Placed, RobotSpec
from pixel2catch.robots.workcell import COLLISION_GROUP, MOST_MJCF, read_mjcf, require_simple, robot_mjcf

Surface = Literal["collision", "visual"]
Line = tuple[Float[ndarray, "3"], Float[ndarray, "3"]]
"""A point of an axis [m] and its direction, of length 1."""

MOST_ANGLE, MOST_DISTANCE = 0.05, 0.005
"""Largest deviation of an axis from ours [rad, m]. Source: ours; makers' models differ by up to 1.4 mm."""

MASSLESS = 1e-4  #: A body that weighs less has no mass in a model [kg].
ARM_LENGTH = 0.1  #: Weight of an angular error of an axis against its distance in the fit of roots [m/rad].
HULL_POINTS = 250  #: Points of a mesh's convex hull. Source: ours; PhysX accepts at most 255.
NUM_POSES = 200  #: Compared joint positions, drawn within the limits.
MESH_ENDINGS = (".stl", ".obj", ".msh")  #: Mesh formats that MuJoCo reads.
MESH_SIZES = (1e-3, 2.0)  #: Smallest and largest radius of the mesh of a link [m]. Source: ours.

URDF_COMPILER = {"strippath": "false", "fusestatic": "false", "discardvisual": "false"}
"""Compiler settings for a URDF: keep all links, mesh paths and visual shapes."""

CELL = '''"""The work cell {name} with makers' bodies."""

from dataclasses import replace
from pathlib import Path

import pixel2catch as p2c

ours = p2c.find_workcell("{name}")
robots = []
for number, placed in enumerate(ours.robots):
    parts = placed.robot.parts
    robot = replace(
        placed.robot,
        mjcf=Path(__file__).with_name(f"robot_{{number}}.xml"),
        groups=tuple(group for part in parts for group in part.groups),
        palms=tuple(palm for part in parts for palm in part.palms),
        tool=None,
    )
    robots.append(replace(placed, robot=robot))
makers = replace(ours, name="{name}_makers", robots=tuple(robots))
'''


@dataclass(frozen=True, kw_only=True)
class Match:
    """A maker's model laid over one part of a robot, all angles at 0."""

    ours: mujoco.MjModel
    theirs: mujoco.MjModel
    joints: tuple[tuple[list[int], list[int]], ...]  #: Joints of each chain from base to tip: ours, theirs.
    root: Pose  #: Their root in the frame of ours.
    distance: float  #: Largest distance of an axis from ours [m].
    angle: float  #: Largest angle between an axis and ours [rad].


def write_workcell(
    files: Sequence[Path], out: Path, name: str = "ur5e_allegro", surface: Surface = "collision"
) -> list[str]:
    """Write `workcell.py` and a model of each robot into a folder; return lines that say what differs.

    Raises:
        Pixel2CatchError: A file is no model of a part of the robots, or cannot be read.
    """
    models = {file: read_model(file, surface) for file in files}
    used, texts, lines = set[Path](), list[str](), list[str]()
    for placed in p2c.find_workcell(name).robots:
        ours, theirs = robot_mjcf(placed.robot).compile(), robot_mjcf(placed.robot)
        for part in placed.robot.parts:
            found = {file: matched(_compiled(part), model) for file, model in models.items()}
            matches = {file: match for file, match in found.items() if isinstance(match, Match)}
            if len(matches) > 1:
                raise p2c.Pixel2CatchError(f"{' and '.join(map(str, matches))} are models of {part.name}.")
            for match in matches.values():
                exchange(theirs, match, surface, f"{part.name}_maker")
                off = f"{1e3 * match.distance:.2f} mm and {1e3 * match.angle:.2f} mrad"
                lines.append(f"{placed.prefix}{part.name}: axes differ by at most {off}")
            used |= matches.keys()
        _exclude_overlaps(theirs, placed)
        texts.append(theirs.to_xml())
        off = 1e3 * tool_difference(ours, theirs.compile(), placed)
        lines.append(f"{placed.prefix}palm and tips differ by at most {off:.2f} mm")
    _require_used(models, used, name)
    out.mkdir(parents=True, exist_ok=True)
    for number, text in enumerate(texts):
        (out / f"robot_{number}.xml").write_text(text, encoding="utf-8")
    (out / "workcell.py").write_text(CELL.format(name=name), encoding="utf-8")
    return lines


def _compiled(part: RobotSpec) -> mujoco.MjModel:
    return robot_mjcf(replace(part, tool=None), visuals=False).compile()


def _require_used(models: Mapping[Path, mujoco.MjModel], used: Set[Path], name: str) -> None:
    """Raise with the reasons if a file is no model of any part."""
    parts = {part.name: part for placed in p2c.find_workcell(name).robots for part in placed.robot.parts}
    for file in models.keys() - used:
        why = "; ".join(f"{each}: {matched(_compiled(part), models[file])}" for each, part in parts.items())
        raise p2c.Pixel2CatchError(f"{file} is no model of a part of '{name}': {why}.")


def read_model(path: Path, surface: Surface) -> mujoco.MjModel:
    """Return the compiled model of a URDF or MJCF file; meshes are searched in all folders above it."""
    try:
        spec = _read_urdf(path, surface) if path.suffix.lower() == ".urdf" else read_mjcf(path)
        spec.compiler.balanceinertia = True  # the hand's maker publishes inertias that no body can have
        spec.compiler.boundmass, spec.compiler.boundinertia = 1e-6, 1e-12
        model = spec.compile()
    except (OSError, ValueError) as error:
        raise p2c.Pixel2CatchError(f"the robot model {path} cannot be read: {error}.") from error
    if (model.jnt_type != int(mujoco.mjtJoint.mjJNT_HINGE)).any() or not model.njnt:
        raise p2c.Pixel2CatchError(f"the robot model {path} has no hinges or other joints; use hinges only.")
    if not any(_is_of(model, geom, surface) for geom in range(model.ngeom)):
        raise p2c.Pixel2CatchError(f"the robot model {path} has no {surface} shapes; use its other shapes.")
    for geom in range(model.ngeom):
        size, is_mesh = model.geom_rbound[geom], model.geom_type[geom] == int(mujoco.mjtGeom.mjGEOM_MESH)
        if is_mesh and _is_of(model, geom, surface) and not MESH_SIZES[0] <= size <= MESH_SIZES[1]:
            mesh = (
                f"the mesh of link '{model.body(model.geom_bodyid[geom]).name}' has a radius of {size:.3g} m"
            )
            fix = 'give its scale in metres, for millimetres: scale="0.001 0.001 0.001"'
            raise p2c.Pixel2CatchError(f"{path}: {mesh}; {fix}.")
    return model


def _read_urdf(path: Path, surface: Surface) -> mujoco.MjSpec:
    """Read a URDF with the paths of its meshes, without shapes of the other surface."""
    content = read_bytes(path, MOST_MJCF)
    require_simple(content)
    root, compiler = ElementTree.fromstring(content), ElementTree.Element("compiler")
    for own in root.findall("mujoco"):  # MuJoCo reads one block
        compiler.attrib |= dict(pair for each in own.iter("compiler") for pair in each.items())
        root.remove(own)
    compiler.attrib |= URDF_COMPILER
    ElementTree.SubElement(root, "mujoco").append(compiler)
    other = "visual" if surface == "collision" else "collision"
    for link in root.iter("link"):
        for shape in link.findall(other):
            link.remove(shape)
        for mesh in link.iterfind(f"{surface}/geometry/mesh"):
            if not (file := mesh.get("filename", "")).lower().endswith(MESH_ENDINGS):
                place = f"the {surface} shape of link '{link.get('name')}' is '{file}'"
                raise ValueError(f"{place}; convert it to {' or '.join(MESH_ENDINGS)}")
    spec = mujoco.MjSpec.from_string(ElementTree.tostring(root, encoding="unicode"))
    folder = path.parent.resolve()
    _find_meshes(spec, (folder / compiler.get("meshdir", ""), folder, *folder.parents))
    return spec


def _find_meshes(spec: mujoco.MjSpec, folders: Sequence[Path]) -> None:
    for geom in spec.geoms:
        geom.mass = 0.0  # MuJoCo would derive masses from shapes, at the density of water
    for mesh in spec.meshes:
        file = Path(mesh.file.partition("://")[2] or mesh.file)
        tried = [above / each for above in folders for each in (file, Path(*file.parts[1:]))]
        found = next((each for each in tried if each.is_file()), None)
        if found is None:
            raise ValueError(f"there is no mesh '{mesh.file}' in {folders[1]} or above; copy it there")
        mesh.file = str(found)


def _is_of(model: mujoco.MjModel, geom: int, surface: Surface) -> bool:
    return bool(model.geom_contype[geom] or model.geom_conaffinity[geom]) == (surface == "collision")


def matched(ours: mujoco.MjModel, theirs: mujoco.MjModel) -> Match | str:
    """Return a maker's model laid over a part, or the reason why it is another robot."""
    chains, others = _chains(ours), _chains(theirs)
    if len(chains) != len(others):
        return f"it has {len(chains)} chains of joints, the file has {len(others)}"
    own_axes, their_axes, found = _axes(ours), _axes(theirs), list[Match]()
    lines = [own_axes[joint] for chain in chains for joint in chain]
    for order in permutations(others):
        if any(len(chain) > len(other) for chain, other in zip(chains, order, strict=True)):
            continue
        pairs = tuple((a, b[-len(a) :]) for a, b in zip(chains, order, strict=True))
        root, distance, angle = _laid(lines, [their_axes[joint] for _, joints in pairs for joint in joints])
        found.append(Match(ours=ours, theirs=theirs, joints=pairs, root=root, distance=distance, angle=angle))
    if not found:
        return "the file has fewer joints"
    best = min(found, key=lambda each: each.distance)
    if best.distance > MOST_DISTANCE or best.angle > MOST_ANGLE:
        return f"an axis is off by {1e3 * best.distance:.0f} mm and {1e3 * best.angle:.0f} mrad"
    return best


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


def _laid(ours: list[Line], theirs: list[Line]) -> tuple[Pose, float, float]:
    """Return the pose of their root in ours that aligns axes, and the largest errors [m, rad].

    Points of the axes give the start; the axes themselves, independent of these points, give the result.
    """
    points = [np.array([point for point, _ in lines]) for lines in (ours, theirs)]
    centers = [each.mean(axis=0) for each in points]
    turn = Rotation.align_vectors(points[0] - centers[0], points[1] - centers[1])[0]

    def root(x: Float[ndarray, "6"]) -> Pose:
        rotation = (Rotation.from_rotvec(x[:3]) * turn).as_matrix()
        return pose_of(centers[0] - turn.apply(centers[1]) + x[3:], rotation)

    def gaps(x: Float[ndarray, "6"]) -> Float[ndarray, "num_axes 6"]:
        pairs = zip(ours, (_seen(line, root(x)) for line in theirs), strict=True)
        return np.array([_gap(own, other) for own, other in pairs])

    best = least_squares(lambda x: gaps(x).ravel(), np.zeros(6)).x
    away, sines = gaps(best)[:, :3], np.linalg.norm(gaps(best)[:, 3:], axis=1) / ARM_LENGTH
    distance, angle = np.linalg.norm(away, axis=1).max(), np.arcsin(np.minimum(sines, 1.0)).max()
    return root(best), float(distance), float(angle)


def _gap(ours: Line, theirs: Line) -> Float[ndarray, "6"]:
    away = theirs[0] - ours[0]
    return np.concatenate((away - ours[1] * (ours[1] @ away), ARM_LENGTH * np.cross(ours[1], theirs[1])))


def exchange(spec: mujoco.MjSpec, match: Match, surface: Surface, name: str) -> None:
    """Replace the bodies of a part in the model of a robot; names of new shapes begin with `name`."""
    ours, theirs = match.ours, match.theirs
    own, frames = _body_poses(ours), _body_poses(theirs)
    for line, joint in _their_axes(match, own):
        added = spec.joint(ours.joint(joint).name)
        added.pos, added.axis = line
    target, number = _targets(match), 0
    for body in sorted(set(target)):
        members = [each for each in range(1, theirs.nbody) if target[each] == body]
        replaced, to_ours = spec.body(ours.body(body).name), np.linalg.inv(own[body]) @ match.root
        for geom in tuple(replaced.geoms):
            spec.delete(geom)
        if theirs.body_mass[members].sum() > MASSLESS:
            each = [inertial_of(theirs, member, to_ours @ frames[member]) for member in members]
            replaced.mass, replaced.ipos, inertia = combined(each)
            replaced.inertia, axes = principal_axes(inertia)
            replaced.explicitinertial, replaced.iquat = True, quaternion(axes)
        for geom in np.flatnonzero(np.isin(theirs.geom_bodyid, members)).tolist():
            if _is_of(theirs, geom, surface):
                frame = to_ours @ frames[theirs.geom_bodyid[geom]]
                _add_geom(spec, replaced, f"{name}_{number}", theirs, geom, frame)
                number += 1


def _their_axes(match: Match, own: Float[ndarray, "nbody 4 4"]) -> list[tuple[Line, int]]:
    """Return the maker's axis of each of our joints in the frame of our body, and the joint."""
    ours, found = match.ours, list[tuple[Line, int]]()
    lines = _axes(match.theirs)
    for joint, other in (pair for each in match.joints for pair in zip(*each, strict=True)):
        point, direction = _seen(lines[other], np.linalg.inv(own[ours.jnt_bodyid[joint]]) @ match.root)
        point = point + direction * (direction @ (ours.jnt_pos[joint] - point))
        found.append(((point, direction * np.sign(direction @ ours.jnt_axis[joint])), joint))
    return found


def _targets(match: Match) -> list[int]:
    """Return our body for each of the maker's bodies, by the joint that moves it.

    Bodies before the first joint of one chain alone belong to our body before that chain.
    """
    ours, theirs, moved, above = match.ours, match.theirs, dict[int, int](), Counter[int]()
    for own, other in match.joints:
        ahead, body = int(ours.body_parentid[ours.jnt_bodyid[own[0]]]), int(theirs.jnt_bodyid[other[0]])
        while body := int(theirs.body_parentid[body]):
            above[body] += 1
            moved[body] = ahead
    moved = {body: ahead for body, ahead in moved.items() if above[body] == 1}
    for own, other in match.joints:
        moved |= zip(theirs.jnt_bodyid[other].tolist(), ours.jnt_bodyid[own].tolist(), strict=True)
    target = [int(ours.body_rootid[ours.jnt_bodyid[0]])]
    for body in range(1, theirs.nbody):
        target.append(moved[body] if body in moved else target[theirs.body_parentid[body]])
    return target


def _add_geom(
    spec: mujoco.MjSpec, body: mujoco.MjsBody, name: str, model: mujoco.MjModel, geom: int, frame: Pose
) -> None:
    """Add a shape of a maker's body to our body; a mesh becomes the convex hull of some of its points."""
    vertices, material, mesh = vertices_of(model, geom), model.geom_matid[geom], {}
    pose = frame @ pose_matrix(model.geom_pos[geom], model.geom_quat[geom])
    if len(vertices):
        chosen = vertices[np.unique((vertices @ sphere_points(HULL_POINTS).T).argmax(axis=0))]
        spec.add_mesh(name=name, uservert=chosen.ravel())
        mesh = {"meshname": name}
    body.add_geom(
        name=name,
        type=mujoco.mjtGeom(model.geom_type[geom]),
        size=model.geom_size[geom],
        pos=pose[:3, 3],
        quat=quaternion(pose[:3, :3]),
        mass=0.0,
        group=COLLISION_GROUP,
        rgba=model.mat_rgba[material] if material >= 0 else model.geom_rgba[geom],
        **mesh,
    )


def _exclude_overlaps(spec: mujoco.MjSpec, placed: Placed) -> None:
    """Exclude pairs of bodies that touch at the start only because convex hulls fill hollows."""
    model = spec.compile()
    data = mujoco.MjData(model)
    groups = (group for part in placed.robot.parts for group in part.groups)
    data.qpos[:] = [joint.home for group in groups for joint in group.joints]
    mujoco.mj_forward(model, data)
    pairs = {tuple(sorted(model.geom_bodyid[contact.geom].tolist())) for contact in data.contact}
    for one, other in sorted(pairs):
        spec.add_exclude(bodyname1=model.body(one).name, bodyname2=model.body(other).name)


def tool_difference(ours: mujoco.MjModel, theirs: mujoco.MjModel, placed: Placed) -> float:
    """Return the largest distance between the same sites, palm and finger tips, in both models [m]."""
    groups = (group for part in placed.robot.parts for group in part.groups)
    low, high = np.array([(j.lower, j.upper) for group in groups for j in group.joints]).T
    worst, data = 0.0, [mujoco.MjData(model) for model in (ours, theirs)]
    for joint_pos in np.random.default_rng(0).uniform(low, high, (NUM_POSES, len(low))):
        for model, each in zip((ours, theirs), data, strict=True):
            each.qpos[:] = joint_pos
            mujoco.mj_kinematics(model, each)
        worst = max(worst, float(np.linalg.norm(data[0].site_xpos - data[1].site_xpos, axis=1).max()))
    return worst


def main() -> None:
    """Write the work cell; print what differs, and the next command."""
    parser = argparse.ArgumentParser(description="Write a work cell with makers' models of arm and hand.")
    parser.add_argument("files", type=Path, nargs="+", help="URDF or MJCF of arm, hand or both")
    parser.add_argument("--out", type=Path, required=True, help="folder of the work cell")
    parser.add_argument("--workcell", default="ur5e_allegro", help="name of the package's work cell")
    parser.add_argument(
        "--visual", action="store_true", help="drawn shapes collide, not the collision shapes"
    )
    args = parser.parse_args()
    try:
        surface: Surface = "visual" if args.visual else "collision"
        lines = write_workcell(args.files, args.out, args.workcell, surface)
    except p2c.Pixel2CatchError as error:
        sys.exit(f"error: {error}")
    print("\n".join(lines))
    file, name = args.out / "workcell.py", f"{args.workcell}_makers"
    print(f"wrote it; to evaluate: pixel2catch --import {file} evaluate --env.scene.workcell {name}")


if __name__ == "__main__":
    main()
