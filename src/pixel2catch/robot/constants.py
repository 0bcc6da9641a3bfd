"""Numbers of the robot, the table and the camera, each with its source.

Lengths in metres, angles in radians, quaternions (w, x, y, z). World frame: z up, x from the robot towards
the thrower. "paper" is Pixel2Catch (RA-L 2026), "release" its published configuration, "UR" the DH parameters
and masses that Universal Robots publishes for the UR5e.
"""

from dataclasses import dataclass
from math import pi, radians
from typing import Literal

Vec3 = tuple[float, float, float]
Quat = tuple[float, float, float, float]
ArmEffort = Literal["maker", "release"]

GRAVITY = 9.81
"""Standard value, as MuJoCo's default [m/s²]."""

PHYSICS_DT = 1.0 / 120.0
"""Physics time step [s]. Source: paper, 120 Hz."""

DECIMATION = 4
"""Physics steps in a control step. Source: paper."""

CONTROL_DT = DECIMATION * PHYSICS_DT
"""Control time step [s]: the policy runs at 30 Hz. Source: paper."""


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


def _arm(
    name: str,
    limits: tuple[float, float],
    home: float,
    gains: tuple[float, float],
    loss: tuple[float, float],
    effort: float,
) -> JointSpec:
    """Make an arm joint from (lower, upper), home, (stiffness, damping), (friction, armature) and torque."""
    return JointSpec(
        name=name,
        lower=limits[0],
        upper=limits[1],
        home=home,
        stiffness=gains[0],
        damping=gains[1],
        frictionloss=loss[0],
        armature=loss[1],
        effort_limit=effort,
        velocity_limit=2.79253,
    )


def _hand(name: str, lower: float, upper: float, home: float = 0.0) -> JointSpec:
    """Make a hand joint; the servo is the same in all of them."""
    return JointSpec(
        name=name,
        lower=lower,
        upper=upper,
        home=home,
        stiffness=3.0,
        damping=0.1,
        frictionloss=0.01,
        armature=HAND_ARMATURE,
        effort_limit=0.5,
        velocity_limit=7.0,
    )


HAND_ARMATURE = 1e-3
"""Reflected inertia of a hand drive [kg·m²].

Source: ours; task and release give none. It is the order of magnitude of a small rotor behind the hand's
reduction of about 1:369, and it keeps a finger struck by the object from being lighter than the object.
"""

ARM_JOINTS: tuple[JointSpec, ...] = (
    _arm("shoulder_pan_joint", (radians(120), radians(240)), pi, (2504.0, 342.0), (0.51, 0.16), 150.0),
    _arm("shoulder_lift_joint", (-2 * pi, 2 * pi), -0.6 * pi, (2848.0, 353.0), (0.42, 0.15), 150.0),
    _arm("elbow_joint", (-pi, pi), 2 / 3 * pi, (2536.0, 343.0), (0.40, 0.14), 150.0),
    _arm("wrist_1_joint", (radians(120), 2 * pi), pi, (1681.0, 234.0), (0.30, 0.23), 28.0),
    _arm("wrist_2_joint", (radians(-110), radians(-90)), -pi / 2, (2243.0, 279.0), (0.30, 0.20), 28.0),
    _arm("wrist_3_joint", (radians(160), radians(200)), pi, (2066.0, 202.0), (0.25, 0.21), 28.0),
)
"""Arm joints from base to flange.

Source: start pose, limits and speed: release (its limits of pan and wrists are whole degrees); shoulder lift,
elbow and the upper limit of wrist 1: UR; servo, friction and armature: identified (release); effort: UR
(joint_limits.yaml of its ROS 2 description). Differs: the release allows 200 N·m, `effort_limits`.
"""

HAND_JOINTS: tuple[JointSpec, ...] = (
    *(
        _hand(f"{finger}_joint_{i}", lower, upper)
        for finger in ("index", "middle", "ring")
        for i, lower, upper in ((1, -0.196, 1.610), (2, -0.174, 1.709), (3, -0.227, 1.618))
    ),
    _hand("thumb_joint_0", 0.263, 1.396, home=0.263),
    _hand("thumb_joint_1", -0.105, 1.163),
    _hand("thumb_joint_2", -0.189, 1.644),
    _hand("thumb_joint_3", -0.162, 1.719),
)
"""Hand joints: three of each finger (the abduction joint is fixed at 0), four of the thumb.

Source: limits, servo, friction and effort: release; lower limit of thumb joint 0: task (the joint itself
reaches -0.105); speed: public descriptions of the Allegro hand.
"""

SPEED_MARGIN = 0.9
"""Share of a joint's speed limit that is asked for; the rest is for the pull of the other joints (ours)."""

JOINTS = (*ARM_JOINTS, *HAND_JOINTS)
"""All controlled joints: the joint order of every tensor."""

RELEASE_ARM_EFFORT = 200.0
"""Largest torque of every joint of the arm [N·m]. Source: release; of the wrists it is seven times UR's."""


def effort_limits(arm_effort: ArmEffort) -> tuple[float, ...]:
    """Largest torques of all joints, with those of the arm by its maker or by the release [N·m]."""
    return tuple(
        RELEASE_ARM_EFFORT if arm_effort == "release" and joint in ARM_JOINTS else joint.effort_limit
        for joint in JOINTS
    )


FINGERS = ("index", "middle", "ring", "thumb")
"""Names of the fingers; bodies, sites and sensors are named by them."""

ROBOT_BASE_POS: Vec3 = (0.0, 0.0, 0.821)
"""Position of `base_link`. Source: release."""

ROBOT_BASE_QUAT: Quat = (0.0, 0.0, 0.0, 1.0)
"""Orientation of `base_link`: turned by 180° about z. Source: release.

UR's `base_link` is itself turned by 180° about z against the frame that the DH parameters start from. The two
turns cancel: the DH base frame is parallel to the world frame, and pan = π points the arm along +x.
"""

UR5E_DH: tuple[tuple[float, float, float], ...] = (
    (0.1625, 0.0, pi / 2),
    (0.0, -0.425, 0.0),
    (0.0, -0.3922, 0.0),
    (0.1333, 0.0, pi / 2),
    (0.0997, 0.0, -pi / 2),
    (0.0996, 0.0, 0.0),
)
"""Standard DH parameters (d [m], a [m], alpha [rad]) of the six joints. Source: UR."""

UR5E_LINK_MASSES = (3.761, 8.058, 2.846, 1.37, 1.3, 0.365)
"""Masses of the six moving links [kg]. Source: UR."""

UR5E_LINK_COMS: tuple[Vec3, ...] = (
    (0.0, -0.00193, 0.1625 - 0.02561),
    (-0.2125, 0.0, 0.11336),
    (-0.2422, 0.0, 0.0265),
    (0.0, -0.01634, 0.1333 - 0.0018),
    (0.0, 0.01634, 0.0997 - 0.0018),
    (0.0, 0.0, 0.0996 - 0.001159),
)
"""Centres of mass of the six moving links, in the frames of our bodies [m].

Source: UR, its ROS 2 description of the UR5e (physical_parameters.yaml). Its frames are parallel to ours, but
those of shoulder and wrists lie further along their axes, by d of the row.
"""

UR5E_LINK_INERTIAS: tuple[Vec3, ...] = (
    (0.0102675, 0.0102675, 0.00666),
    (0.0151074, 0.13388583541666665, 0.13388583541666665),
    (0.004095, 0.03120936758333333, 0.03120936758333333),
    (0.0025599, 0.0025599, 0.0021942),
    (0.0025599, 0.0025599, 0.0021942),
    (9.890414008333333e-05, 9.890414008333333e-05, 1.321171875e-04),
)
"""Inertias of the six moving links about their centres of mass, along the axes of our bodies [kg·m²].

Source: UR, as of the centres of mass; there they are those of cylinders.
"""

HAND_MOUNT_POS: Vec3 = (0.0, 0.0097, 0.0074)
"""Hand frame in the flange frame `tool0`. Source: release."""

HAND_MOUNT_QUAT: Quat = (0.5**0.5, 0.0, 0.0, 0.5**0.5)
"""Orientation of the hand frame in `tool0`: hand x along its y, hand y along its -x. Source: release."""

PALM_POS: Vec3 = (0.0113, 0.0, 0.0526)
"""The point called palm, the centre of the palm's surface, in the hand frame. Source: release."""


@dataclass(frozen=True, kw_only=True)
class TableSpec:
    """A solid box that the robot stands on.

    Attributes:
        center: Centre of the top surface, world frame [m].
        size: Extent along x and y [m].
        thickness: Extent along z [m].
    """

    center: Vec3
    size: tuple[float, float]
    thickness: float


TABLE = TableSpec(center=(-0.05, 0.0, 0.81), size=(0.75, 0.75), thickness=0.04)
"""Source: top and centre: release; extent and thickness: ours (the release's prop is not public)."""


PIXEL_CENTER = 0.5
"""The middle of the first pixel in image coordinates, along u and v [px]; ROS and OpenCV call it 0."""


@dataclass(frozen=True, kw_only=True)
class CameraSpec:
    """A pinhole camera.

    Attributes:
        width: Image width [px].
        height: Image height [px].
        fx: Focal length along x [px].
        fy: Focal length along y [px].
        cx: Column of the optical axis [px].
        cy: Row of the optical axis [px].
        pos: Position of the optical centre, world frame [m].
        quat: Orientation of the optical frame in the world: z along the optical axis, x to the right, y down.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    pos: Vec3
    quat: Quat


def quat_multiply(a: Quat, b: Quat) -> Quat:
    """Compose two rotations: first `b`, then `a`."""
    aw, ax, ay, az = a
    bw, bx, by, bz = b
    return (
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    )


FORWARD_TO_OPTICAL: Quat = (0.5, -0.5, 0.5, -0.5)
"""Optical frame (z forward, x right, y down) in a frame with x forward, y left, z up."""

RGB_CAMERA = CameraSpec(
    width=640,
    height=480,
    fx=618.163,
    fy=618.468,
    cx=328.451,
    cy=246.513,
    pos=(-0.39, 0.01, 2.2),
    quat=quat_multiply((0.96814764, 0.0, 0.25038000, 0.0), FORWARD_TO_OPTICAL),
)
"""The RGB camera behind and above the robot. Source: release (there with x forward and z up)."""
