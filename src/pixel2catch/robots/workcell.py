"""A work cell: robots with their places, and a table. All that is simulated, trained and driven is of one."""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal

import mujoco

from pixel2catch.errors import InvalidValueError, UnknownNameError
from pixel2catch.robots.mjcf import read_mjcf
from pixel2catch.robots.spec import JointGroup, JointSpec, PalmSpec, Placed, RobotSpec, Vec3

VISUAL_GROUP = 2  #: Geom group of what is only seen.
COLLISION_GROUP = 3  #: Geom group of everything of a robot that collides.


@dataclass(frozen=True, kw_only=True)
class TableSpec:
    """A solid box that robots stand on."""

    center: Vec3  #: Centre of the top surface, world frame [m].
    size: tuple[float, float]  #: Extent along x and y [m].
    thickness: float  #: Extent along z [m].


TABLE = TableSpec(center=(-0.05, 0.0, 0.81), size=(0.75, 0.75), thickness=0.04)
"""Source: top and centre: release; extent and thickness: ours (the release's prop is not public)."""


@dataclass(frozen=True, kw_only=True)
class PlacedPalm:
    """A palm in a work cell."""

    spec: PalmSpec  #: The palm, by the names of the work cell.
    first: int  #: Column in joint order of the first joint on the way from the world to it.
    stop: int  #: Column after the last.
    groups: tuple[str, ...]  #: Names of the groups of the robot that it belongs to.

    @property
    def carriers(self) -> slice:
        """Columns of the joints that carry it."""
        return slice(self.first, self.stop)


@dataclass(frozen=True, kw_only=True)
class WorkcellSpec:
    """Robots with their places, and the table that they stand on."""

    name: str
    robots: tuple[Placed, ...]  #: The robots; joint order is theirs, one after the other.
    table: TableSpec = field(default_factory=lambda: TABLE)  #: What they stand on.

    def __post_init__(self) -> None:
        """Refuse a robot that can catch nothing, and a name that is taken twice."""
        names = self.joint_names
        for placed in self.robots:
            if not any(part.palms for part in placed.robot.parts):
                raise InvalidValueError(
                    f"'{placed.robot.name}' in work cell '{self.name}' has no palm; give it a hand to hold"
                )
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise InvalidValueError(
                f"the work cell '{self.name}' has several joints '{twice[0]}'; give its robots prefixes"
            )

    @cached_property
    def groups(self) -> tuple[JointGroup, ...]:
        """All joint groups in joint order, by the names of the work cell."""
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
        """All joints: the order of every tensor."""
        return tuple(joint for group in self.groups for joint in group.joints)

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of all joints, in joint order."""
        return tuple(joint.name for joint in self.joints)

    def columns(self, group: str) -> slice:
        """Where the joints of a group are in joint order.

        Raises:
            UnknownNameError: If there is no such group.
        """
        first = 0
        for each in self.groups:
            if each.name == group:
                return slice(first, first + len(each.joints))
            first += len(each.joints)
        raise UnknownNameError("joint group", group, [each.name for each in self.groups])

    @cached_property
    def palms(self) -> tuple[PlacedPalm, ...]:
        """All palms, robot by robot."""
        found, first = [], 0
        for placed in self.robots:
            groups = [group for part in placed.robot.parts for group in part.groups]
            before = first
            for part in placed.robot.parts:
                arms = sum(len(group.joints) for group in part.groups if group.role == "arm")
                found += [
                    PlacedPalm(
                        spec=_prefixed(palm, placed.prefix),
                        first=before,
                        stop=first + arms,
                        groups=tuple(placed.prefix + group.name for group in groups),
                    )
                    for palm in part.palms
                ]
                first += sum(len(group.joints) for group in part.groups)
        return tuple(found)

    def of_role(self, role: Literal["arm", "hand"]) -> tuple[slice, ...]:
        """Columns of the groups of a role."""
        return tuple(self.columns(group.name) for group in self.groups if group.role == role)


def _prefixed(palm: PalmSpec, prefix: str) -> PalmSpec:
    """A palm by the names that it has in a work cell."""
    fingers = tuple(
        replace(f, name=prefix + f.name, root=prefix + f.root, tip=prefix + f.tip) for f in palm.fingers
    )
    return replace(
        palm, name=prefix + palm.name, site=prefix + palm.site, body=prefix + palm.body, fingers=fingers
    )


def parts_of(workcell: WorkcellSpec) -> Iterator[tuple[str, RobotSpec]]:
    """All parts of all robots without their tools, each with what its names begin with."""
    for placed in workcell.robots:
        prefix, part = "", placed
        while part is not None:
            prefix += part.prefix
            yield prefix, replace(part.robot, tool=None)
            part = part.robot.tool


def add_robots(spec: mujoco.MjSpec, workcell: WorkcellSpec, visuals: bool) -> None:
    """Add the robots of a work cell to a scene, with or without what is only seen."""
    for placed in workcell.robots:
        frame = spec.worldbody.add_frame(pos=placed.pos, quat=placed.quat)
        _attach(spec, robot_mjcf(placed.robot, visuals), placed.prefix, frame)


def robot_mjcf(robot: RobotSpec, visuals: bool = True) -> mujoco.MjSpec:
    """The MJCF of a robot with its tools.

    Raises:
        InvalidValueError: If a file cannot be read by `read_mjcf`, or lacks the site that carries the tool.
    """
    spec = read_mjcf(robot.mjcf)
    if not visuals:
        for geom in spec.geoms:
            if geom.group == VISUAL_GROUP:
                spec.delete(geom)
    if robot.tool:
        mount = spec.site(robot.mount)
        if mount is None:
            raise InvalidValueError(f"{robot.mjcf} has no site '{robot.mount}', which should carry a tool")
        at_mount = mount.parent.add_frame(pos=mount.pos, quat=mount.quat)
        at_tool = mount.parent.add_frame(at_mount, pos=robot.tool.pos, quat=robot.tool.quat)
        _attach(spec, robot_mjcf(robot.tool.robot, visuals), robot.tool.prefix, at_tool)
    return spec


def _attach(spec: mujoco.MjSpec, child: mujoco.MjSpec, prefix: str, frame: mujoco.MjsFrame) -> None:
    """Attach with a prefix or none, which MuJoCo advises against, for a scene could not be saved then."""
    passing = "attached/"
    spec.attach(child, prefix=prefix or passing, frame=frame)
    if prefix:
        return
    for element in (*spec.bodies, *spec.joints, *spec.geoms, *spec.sites):
        element.name = element.name.removeprefix(passing)
    for pair in spec.excludes:
        pair.bodyname1, pair.bodyname2 = (
            name.removeprefix(passing) for name in (pair.bodyname1, pair.bodyname2)
        )
