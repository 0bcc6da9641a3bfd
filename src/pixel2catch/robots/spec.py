"""What a robot is: an MJCF file, and beside it what MJCF does not say. Nobody asks for a robot by name.

    arm = RobotSpec(name="my_arm", mjcf=HERE / "my_arm.xml", root="base", groups=(ARM,), mount="flange")
    robot = arm.holding(MY_HAND, pos=(0.0, 0.0, 0.01))

Lengths in metres, angles in radians, quaternions (w, x, y, z).
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

Vec3 = tuple[float, float, float]
Quat = tuple[float, float, float, float]
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
    #: Largest speed [rad/s]. MuJoCo has no such limit: whoever commands the joint keeps it.
    velocity_limit: float


@dataclass(frozen=True, kw_only=True)
class JointGroup:
    """Joints that are commanded alike, by one driver."""

    name: str  #: Such as "arm" or "hand"; agents, logs and drivers are named by it.
    role: Literal["arm", "hand"]  #: Whether it carries a palm about, or moves the fingers on one.
    joints: tuple[JointSpec, ...]  #: Its joints from the base to the tips.
    #: Whether an action is a change of the measured position, or a position in the joint's range.
    command: Literal["relative", "absolute"]
    gain_range: Range  #: Factors on stiffness and damping that an episode draws.
    action_noise: float  #: Standard deviation of the noise on each action.
    action_bias: float  #: Standard deviation of an error of each action that lasts an episode.


@dataclass(frozen=True, kw_only=True)
class FingerSpec:
    """A finger."""

    name: str
    root: str  #: Its first body.
    tip: str  #: The site in the middle of its tip.


@dataclass(frozen=True, kw_only=True)
class PalmSpec:
    """What catches: a palm with fingers."""

    name: str
    site: str  #: The site on its surface that shall come near the object.
    body: str
    fingers: tuple[FingerSpec, ...]
    #: Corner of a box in the axes of the body that holds palm, fingers and the link that carries them,
    #: whatever the fingers do [m].
    lower: Vec3
    upper: Vec3  #: The other corner [m].
    #: Lower and upper corners of boxes that hold palm and fingers alone, which keep away from their arm [m].
    hand: tuple[tuple[Vec3, Vec3], ...] = ()
    normal: Vec3 = (1.0, 0.0, 0.0)  #: Where the palm looks, in the axes of the site.


@dataclass(frozen=True, kw_only=True)
class MeshSource:
    """Where a checkout of the MuJoCo Menagerie has meshes of a robot, which are only seen.

    With all joints at 0 its bodies are where those of the robot are.
    """

    mjcf: str  #: The model there, below the folder of the checkout.
    bodies: tuple[tuple[str, str], ...]  #: Its bodies, and those of the robot that they are.
    pos: Vec3 = (0.0, 0.0, 0.0)  #: Where its root body is in that of the robot, which is parallel [m].


@dataclass(frozen=True, kw_only=True)
class RobotSpec:
    """A robot, or a part of one."""

    name: str
    #: Its bodies, joint axes, collision shapes (group 3), what is only seen (group 2) and sites, as MJCF.
    #: Limits, gains and drives come from `groups`.
    mjcf: Path
    root: str  #: The body that everything else of it hangs on.
    groups: tuple[JointGroup, ...] = ()  #: Its joints, in MuJoCo's order.
    palms: tuple[PalmSpec, ...] = ()
    mount: str = ""  #: The site that carries a tool.
    tool: "Placed | None" = None  #: What it carries, and where in that site's frame.
    meshes: MeshSource | None = None  #: Where to find meshes of it, for pictures.

    def holding(self, tool: "RobotSpec", pos: Vec3 = (0.0, 0.0, 0.0), quat: Quat = IDENTITY) -> "RobotSpec":
        """The robot with a tool on its mount."""
        return replace(self, name=f"{self.name}_{tool.name}", tool=Placed(robot=tool, pos=pos, quat=quat))

    @property
    def parts(self) -> tuple["RobotSpec", ...]:
        """The robot and what it carries, from the base to the tip."""
        return (self, *(self.tool.robot.parts if self.tool else ()))


@dataclass(frozen=True, kw_only=True)
class Placed:
    """A robot somewhere."""

    robot: RobotSpec
    pos: Vec3  #: Where its root is, in the frame of what carries it [m].
    quat: Quat = IDENTITY  #: How its root is turned there.
    prefix: str = ""  #: What the names of all its parts begin with, so that there can be several.
