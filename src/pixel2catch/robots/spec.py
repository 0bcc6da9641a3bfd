"""Specification of a robot: an MJCF file, and the values that MJCF does not hold.

    arm = RobotSpec(name="my_arm", mjcf=HERE / "my_arm.xml", root="base", groups=(ARM,), mount="flange")
    robot = arm.holding(MY_HAND, pos=(0.0, 0.0, 0.01))

Lengths in metres, angles in radians, quaternions (w, x, y, z).
"""

from dataclasses import dataclass, replace
from math import inf
from pathlib import Path
from typing import Annotated, Any, Literal

from pixel2catch.checks import UNIT_LENGTH, Within

Vec3 = tuple[float, float, float]
Quat = tuple[float, float, float, float]
End = Annotated[float, Within(-inf, inf)]  #: End of a joint's travel [rad]; infinite without one.
Range = tuple[float, float]

IDENTITY: Quat = (1.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True, kw_only=True)
class JointSpec:
    """One driven joint: its task limits, start position and servo."""

    name: str  #: Name of the joint and of its actuator.
    lower: float  #: Lower limit [rad].
    upper: float  #: Upper limit [rad].
    home: float  #: Start position [rad], before the reset noise.
    stiffness: float  #: Gain on the position error [N·m/rad].
    damping: float  #: Gain on the velocity [N·m·s/rad].
    frictionloss: float  #: Dry friction [N·m].
    armature: float  #: Reflected inertia of the drive [kg·m²].
    effort_limit: float  #: Largest torque of the whole servo [N·m].
    velocity_limit: float  #: Largest speed [rad/s]. MuJoCo has no such limit; actions and servo keep it.
    #: Largest acceleration of a command [rad/s²]; simulated commands keep it as the servo does.
    acceleration_limit: Annotated[float, Within(0.0, inf, is_open=True)] = inf
    #: Ends of the travel [rad], deceleration a [rad/s²], offset [rad/s]: at a distance d from an end, speeds
    #: of commands towards it are at most √(2 a d) - offset. Simulated if there is an `acceleration_limit`.
    travel: tuple[End, End, float, float] = (-inf, inf, 1.0, 0.0)


def joint_table(columns: str, *rows: tuple[Any, ...], **common: Any) -> tuple[JointSpec, ...]:
    """Return joints from rows with the values of these fields; the other fields are common to all."""
    return tuple(JointSpec(**dict(zip(columns.split(), row, strict=True)), **common) for row in rows)


@dataclass(frozen=True, kw_only=True)
class JointGroup:
    """Joints with the same kind of command and one driver."""

    name: str  #: Such as "arm" or "hand"; agents, logs and drivers have the same name.
    role: Literal["arm", "hand"]  #: Whether it carries a palm, or moves the fingers of one.
    joints: tuple[JointSpec, ...]  #: Its joints from base to tip.
    #: Whether an action is a change of the measured position, or a position in the range of the joint.
    command: Literal["relative", "absolute"]
    gain_range: Range  #: Range of the factors on stiffness and damping, drawn for each episode.
    action_noise: float  #: Standard deviation of the noise on each action, drawn for each step.
    action_bias: float  #: Standard deviation of the error of each action, drawn for each episode.


@dataclass(frozen=True, kw_only=True)
class FingerSpec:
    """A finger."""

    name: str
    root: str  #: Name of its first body.
    tip: str  #: Name of the site at the centre of its tip.


@dataclass(frozen=True, kw_only=True)
class PalmSpec:
    """A palm with fingers."""

    name: str
    site: str  #: Name of the site at the centre of the palm's surface.
    body: str
    fingers: tuple[FingerSpec, ...]
    #: Lower corner of a box, frame of the body, that contains palm, fingers at every position, and the link
    #: that carries them [m].
    lower: Vec3
    upper: Vec3  #: Upper corner of that box [m].
    #: Lower and upper corners of boxes about palm and fingers alone; the servo keeps them off the arm [m].
    hand: tuple[tuple[Vec3, Vec3], ...] = ()
    normal: Vec3 = (1.0, 0.0, 0.0)  #: Direction out of the palm, frame of the site.


@dataclass(frozen=True, kw_only=True)
class RobotSpec:
    """A robot, or a part of one."""

    name: str
    #: Bodies, joint axes, collision geoms (group 3), visual geoms (group 2) and sites. Limits, gains and
    #: drives come from `groups`.
    mjcf: Path
    root: str  #: Name of its root body.
    groups: tuple[JointGroup, ...] = ()  #: Its joints, in MuJoCo's order.
    palms: tuple[PalmSpec, ...] = ()
    mount: str = ""  #: Name of the site that carries a tool.
    tool: "Placed | None" = None  #: The tool, and its pose in the frame of that site.

    def holding(self, tool: "RobotSpec", pos: Vec3 = (0.0, 0.0, 0.0), quat: Quat = IDENTITY) -> "RobotSpec":
        """Return the robot with a tool on its mount."""
        return replace(self, name=f"{self.name}_{tool.name}", tool=Placed(robot=tool, pos=pos, quat=quat))

    @property
    def parts(self) -> tuple["RobotSpec", ...]:
        """Return the robot and its tools, from base to tip."""
        return (self, *(self.tool.robot.parts if self.tool else ()))


@dataclass(frozen=True, kw_only=True)
class Placed:
    """A robot with its pose."""

    robot: RobotSpec
    pos: Vec3  #: Position of its root in the parent frame [m].
    quat: Annotated[Quat, UNIT_LENGTH] = IDENTITY  #: Orientation of its root in the parent frame.
    prefix: str = ""  #: Prefix of all its names, so that a work cell can hold several.
