"""A work cell: robots with their poses, and a table."""

from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from io import BytesIO
from pathlib import Path
from typing import Annotated, Literal
from xml.etree import ElementTree

import mujoco

from pixel2catch.checks import NOT_EMPTY, require_valid
from pixel2catch.errors import InvalidValueError, UnknownNameError
from pixel2catch.files import read_bytes, reading
from pixel2catch.robots.spec import JointGroup, JointSpec, PalmSpec, Placed, RobotSpec, Vec3

VISUAL_GROUP = 2  #: Geom group of visual geoms, which do not collide.
COLLISION_GROUP = 3  #: Geom group of the robots' collision geoms.

MOST_MJCF = 2**24  #: Largest size of a model file [bytes]; robots have about 10,000. Source: ours.
MOST_ELEMENTS, MOST_NESTED = 20_000, 64
"""Largest number of elements of a model, and largest depth. Source: ours; an arm with a hand: 500 and 15."""

GROWING = ("include", "replicate", "composite", "flexcomp")
"""Elements that create other elements or read other files. They are refused."""


@dataclass(frozen=True, kw_only=True)
class TableSpec:
    """A solid box under the robots."""

    center: Vec3  #: Centre of the top surface, world frame [m].
    size: tuple[float, float]  #: Extent along x and y [m].
    thickness: float  #: Extent along z [m].


TABLE = TableSpec(center=(-0.05, 0.0, 0.81), size=(0.75, 0.75), thickness=0.04)
"""Source: top and centre: release; extent and thickness: ours (the release's prop is not public)."""


@dataclass(frozen=True, kw_only=True)
class PlacedPalm:
    """A palm in a work cell."""

    spec: PalmSpec  #: The palm, with the names of the work cell.
    carriers: slice = field(hash=False)  #: Columns, in joint order, of the joints that carry it.
    groups: tuple[str, ...]  #: Names of the joint groups of its robot.


@dataclass(frozen=True, kw_only=True)
class WorkcellSpec:
    """Robots with their poses, and the table under them."""

    name: str
    robots: Annotated[tuple[Placed, ...], NOT_EMPTY]  #: In joint order: the joints of the first, then ...
    table: TableSpec = field(default_factory=lambda: TABLE)  #: The table under them.

    def __post_init__(self) -> None:
        require_valid(self)
        names = self.joint_names
        for placed in self.robots:
            if not any(part.palms for part in placed.robot.parts):
                raise InvalidValueError(f"'{placed.robot.name}' in '{self.name}' has no palm; give a hand.")
        if twice := sorted({name for name in names if names.count(name) > 1}):
            raise InvalidValueError(f"joint '{twice[0]}' is twice in '{self.name}'; give robots prefixes.")

    @cached_property
    def groups(self) -> tuple[JointGroup, ...]:
        """Return all joint groups in joint order, with the names of the work cell."""
        return tuple(
            replace(
                group,
                name=placed.prefix + group.name,
                joints=tuple(replace(joint, name=placed.prefix + joint.name) for joint in group.joints),
            )
            for placed in self.robots
            for part in placed.robot.parts
            for group in part.groups
        )

    @cached_property
    def joints(self) -> tuple[JointSpec, ...]:
        """Return all joints in joint order, the order of the columns of every tensor."""
        return tuple(joint for group in self.groups for joint in group.joints)

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Return the names of all joints, in joint order."""
        return tuple(joint.name for joint in self.joints)

    def columns(self, group: str) -> slice:
        """Return the columns of a joint group."""
        names = [each.name for each in self.groups for _ in each.joints]
        if group not in names:
            raise UnknownNameError("joint group", group, dict.fromkeys(names))
        return slice(names.index(group), names.index(group) + names.count(group))

    @cached_property
    def palms(self) -> tuple[PlacedPalm, ...]:
        """Return all palms, robot by robot."""
        found, first = [], 0
        for placed in self.robots:
            parts, before = placed.robot.parts, first
            groups = tuple(placed.prefix + group.name for part in parts for group in part.groups)
            for part in parts:
                roles = [group.role for group in part.groups for _ in group.joints]
                carriers = slice(before, first + roles.count("arm"))
                specs = [_prefixed(palm, placed.prefix) for palm in part.palms]
                found += [PlacedPalm(spec=spec, carriers=carriers, groups=groups) for spec in specs]
                first += len(roles)
        return tuple(found)

    def of_role(self, role: Literal["arm", "hand"]) -> tuple[slice, ...]:
        """Return the columns of each group of a role."""
        return tuple(self.columns(group.name) for group in self.groups if group.role == role)


def _prefixed(palm: PalmSpec, prefix: str) -> PalmSpec:
    fingers = tuple(
        replace(f, name=prefix + f.name, root=prefix + f.root, tip=prefix + f.tip) for f in palm.fingers
    )
    return replace(
        palm, name=prefix + palm.name, site=prefix + palm.site, body=prefix + palm.body, fingers=fingers
    )


def add_robots(spec: mujoco.MjSpec, workcell: WorkcellSpec, visuals: bool) -> None:
    """Add the robots of a work cell to a scene, with or without visual geoms."""
    for placed in workcell.robots:
        frame = spec.worldbody.add_frame(pos=placed.pos, quat=placed.quat)
        _attach(spec, robot_mjcf(placed.robot, visuals), placed.prefix, frame)
    for palm in (placed.spec for placed in workcell.palms):
        if spec.site(palm.site) is None:
            raise InvalidValueError(f"palm '{palm.name}': its MJCF has no site '{palm.site}'; add the site.")


def robot_mjcf(robot: RobotSpec, visuals: bool = True) -> mujoco.MjSpec:
    """Return the MJCF of a robot with its tools."""
    spec = read_mjcf(robot.mjcf)
    if not visuals:
        for geom in spec.geoms:
            if geom.group == VISUAL_GROUP:
                spec.delete(geom)
    if robot.tool:
        mount = spec.site(robot.mount)
        if mount is None:
            raise InvalidValueError(f"{robot.mjcf} has no site '{robot.mount}' for the tool; add the site.")
        at_mount = mount.parent.add_frame(pos=mount.pos, quat=mount.quat)
        at_tool = mount.parent.add_frame(at_mount, pos=robot.tool.pos, quat=robot.tool.quat)
        _attach(spec, robot_mjcf(robot.tool.robot, visuals), robot.tool.prefix, at_tool)
    return spec


def _attach(spec: mujoco.MjSpec, child: mujoco.MjSpec, prefix: str, frame: mujoco.MjsFrame) -> None:
    """Attach with or without a prefix; MuJoCo cannot save a scene attached with an empty prefix."""
    temporary = "attached/"
    spec.attach(child, prefix=prefix or temporary, frame=frame)
    if prefix:
        return
    for element in (*spec.bodies, *spec.joints, *spec.geoms, *spec.sites):
        element.name = element.name.removeprefix(temporary)
    for pair in spec.excludes:
        names = pair.bodyname1, pair.bodyname2
        pair.bodyname1, pair.bodyname2 = (name.removeprefix(temporary) for name in names)


def read_mjcf(path: Path) -> mujoco.MjSpec:
    """Read an MJCF file. Raise InvalidValueError if it cannot be read, or `require_simple` refuses it."""
    with reading("model", path, "Write MJCF, as for MuJoCo."):
        require_simple(read_bytes(path, MOST_MJCF))
        return mujoco.MjSpec.from_file(str(path))


@lru_cache(maxsize=8)  # scenes with different objects share their robots
def require_simple(content: bytes) -> None:
    """Refuse an MJCF or URDF model that is too large or too deep, creates elements, or has a `%`.

    MuJoCo 4.0.0 uses the name of an unknown class as the format of its error message: `%p` prints addresses,
    `%n` ends the process. Source: tried with `class="c%p-%p"`.
    """
    if b"<!DOCTYPE" in content:
        raise InvalidValueError("it declares a document type or entities; remove them")
    depth, num_elements = 0, 0
    try:
        for event, element in ElementTree.iterparse(BytesIO(content), ("start", "end")):
            depth += 1 if event == "start" else -1
            num_elements += event == "start"
            if depth > MOST_NESTED or num_elements > MOST_ELEMENTS:
                raise InvalidValueError(f"it has more than {MOST_ELEMENTS} elements, or {MOST_NESTED} levels")
            if any("%" in value for value in element.attrib.values()):
                raise InvalidValueError(f"element '{element.tag}' has a '%', a format of MuJoCo; rename it")
            if element.tag in GROWING:
                raise InvalidValueError(f"'{element.tag}' makes elements that are unchecked; list them")
    except (ElementTree.ParseError, LookupError) as error:
        raise InvalidValueError(f"it is not XML ({error})") from error
