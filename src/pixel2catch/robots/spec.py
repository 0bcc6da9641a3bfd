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
    """One driven joint: its task limits, start position and servo.

    Attributes:
        name: Name of the joint and of its actuator.
        lower: Lower limit [rad].
        upper: Upper limit [rad].
        home: Start position [rad], before the reset noise.
        stiffness: Gain on the position error [N·m/rad].
        damping: Gain on the velocity [N·m·s/rad].
        frictionloss: Dry friction [N·m].
        armature: Reflected inertia of the drive [kg·m²].
        effort_limit: Largest torque of the whole servo [N·m].
        velocity_limit: Largest speed [rad/s]. MuJoCo has no such limit: whoever commands the joint keeps it.
    """

    name: str
    lower: float
    upper: float
    home: float
    stiffness: float
    damping: float
    frictionloss: float
    armature: float
    effort_limit: float
    velocity_limit: float


@dataclass(frozen=True, kw_only=True)
class JointGroup:
    """Joints that are commanded alike, by one driver.

    Attributes:
        name: Such as "arm" or "hand"; agents, logs and drivers are named by it.
        role: Whether it carries a palm about, or moves the fingers on one.
        joints: Its joints from the base to the tips.
        command: Whether an action is a change of the measured position, or a position in the joint's range.
        gain_range: Factors on stiffness and damping that an episode draws.
        action_noise: Standard deviation of the noise on each action.
        action_bias: Standard deviation of an error of each action that lasts an episode.
    """

    name: str
    role: Literal["arm", "hand"]
    joints: tuple[JointSpec, ...]
    command: Literal["relative", "absolute"]
    gain_range: Range
    action_noise: float
    action_bias: float


@dataclass(frozen=True, kw_only=True)
class FingerSpec:
    """A finger.

    Attributes:
        name: Its name.
        root: Its first body.
        tip: The site in the middle of its tip.
    """

    name: str
    root: str
    tip: str


@dataclass(frozen=True, kw_only=True)
class PalmSpec:
    """What catches: a palm with fingers.

    Attributes:
        name: Its name.
        site: The site on its surface that shall come near the object.
        body: Its body.
        fingers: Its fingers.
        lower: Corner of a box in the axes of the body that holds palm, fingers and the link that carries
            them, whatever the fingers do [m].
        upper: The other corner [m].
    """

    name: str
    site: str
    body: str
    fingers: tuple[FingerSpec, ...]
    lower: Vec3
    upper: Vec3


@dataclass(frozen=True, kw_only=True)
class RobotSpec:
    """A robot, or a part of one.

    Attributes:
        name: Its name.
        mjcf: Its bodies, joint axes, collision shapes (group 3), what is only seen (group 2) and sites, as
            MJCF. Limits, gains and drives come from `groups`.
        root: The body that everything else of it hangs on.
        groups: Its joints, in MuJoCo's order.
        palms: Its palms.
        mount: The site that carries a tool.
        tool: What it carries, and where in that site's frame.
    """

    name: str
    mjcf: Path
    root: str
    groups: tuple[JointGroup, ...] = ()
    palms: tuple[PalmSpec, ...] = ()
    mount: str = ""
    tool: "Placed | None" = None

    def holding(self, tool: "RobotSpec", pos: Vec3 = (0.0, 0.0, 0.0), quat: Quat = IDENTITY) -> "RobotSpec":
        """The robot with a tool on its mount."""
        return replace(self, name=f"{self.name}_{tool.name}", tool=Placed(robot=tool, pos=pos, quat=quat))

    @property
    def parts(self) -> tuple["RobotSpec", ...]:
        """The robot and what it carries, from the base to the tip."""
        return (self, *(self.tool.robot.parts if self.tool else ()))


@dataclass(frozen=True, kw_only=True)
class Placed:
    """A robot somewhere.

    Attributes:
        robot: The robot.
        pos: Where its root is, in the frame of what carries it [m].
        quat: How its root is turned there.
        prefix: What the names of all its parts begin with, so that there can be several.
    """

    robot: RobotSpec
    pos: Vec3
    quat: Quat = IDENTITY
    prefix: str = ""
