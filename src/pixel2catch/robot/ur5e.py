"""The UR5e as a chain of bodies with capsules for its links.

Body i stands at the end of the DH chain of its predecessors and turns about its own z axis, so that a child
is placed by (a, 0, d) and Rx(α) of its parent's row. Dimensions of the tubes are ours; masses, centres of
mass and inertias are UR's.
"""

from dataclasses import dataclass
from math import cos, sin

import mujoco

from pixel2catch.robot.constants import (
    ARM_JOINTS,
    ROBOT_BASE_POS,
    ROBOT_BASE_QUAT,
    UR5E_DH,
    UR5E_LINK_COMS,
    UR5E_LINK_INERTIAS,
    UR5E_LINK_MASSES,
    Quat,
    Vec3,
)

ROBOT_GROUP = 3
"""Geom group of everything of the robot that collides."""

TUBE_RGBA = (0.78, 0.79, 0.80, 1.0)
FLANGE_RGBA = (0.35, 0.36, 0.38, 1.0)


@dataclass(frozen=True, kw_only=True)
class Capsule:
    """A capsule between two points of a link's frame.

    Attributes:
        start: First centre [m].
        end: Second centre [m].
        radius: Radius [m].
    """

    start: Vec3
    end: Vec3
    radius: float


LINKS: tuple[tuple[str, tuple[Capsule, ...]], ...] = (
    ("shoulder_link", (Capsule(start=(0, 0, 0.06), end=(0, -0.045, 0.1625), radius=0.06),)),
    (
        "upper_arm_link",
        (Capsule(start=(0, 0, 0.136), end=(-0.425, 0, 0.136), radius=0.055),),
    ),
    (
        "forearm_link",
        (
            Capsule(start=(0, 0, 0.007), end=(-0.36, 0, 0.007), radius=0.045),
            Capsule(start=(0, 0, 0.02), end=(0, 0, 0.08), radius=0.05),
        ),
    ),
    ("wrist_1_link", (Capsule(start=(0, 0, 0.02), end=(0, 0, 0.1333), radius=0.042),)),
    ("wrist_2_link", (Capsule(start=(0, 0, 0.02), end=(0, 0, 0.0997), radius=0.042),)),
    ("wrist_3_link", (Capsule(start=(0, 0, 0.045), end=(0, 0, 0.0626), radius=0.037),)),
)
"""Links from the shoulder to the flange with their collision capsules. Source: ours: approximate sizes."""

BASE_CAPSULE = Capsule(start=(0, 0, 0.02), end=(0, 0, 0.03), radius=0.07)
"""Foot of the arm in `base_link`."""


def add_arm(spec: mujoco.MjSpec) -> mujoco.MjsBody:
    """Add the arm to the world and return its last link, on which `tool0` sits."""
    base = spec.worldbody.add_body(name="base_link", pos=ROBOT_BASE_POS, quat=ROBOT_BASE_QUAT)
    add_capsule(base, "base_link", BASE_CAPSULE, mass=0.0, rgba=TUBE_RGBA)
    parent, pos, quat = base, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)
    inertial = zip(UR5E_LINK_MASSES, UR5E_LINK_COMS, UR5E_LINK_INERTIAS, strict=True)
    for (name, capsules), joint, of_mass, row in zip(LINKS, ARM_JOINTS, inertial, UR5E_DH, strict=True):
        body = parent.add_body(name=name, pos=pos, quat=quat, gravcomp=1.0)
        body.add_joint(name=joint.name, axis=(0, 0, 1))
        set_inertial(body, *of_mass)
        for i, capsule in enumerate(capsules):
            rgba = FLANGE_RGBA if name == "wrist_3_link" else TUBE_RGBA
            add_capsule(body, name if i == 0 else f"{name}_{i}", capsule, mass=0.0, rgba=rgba)
        parent, (pos, quat) = body, dh_pose(row)
    parent.add_site(name="tool0", pos=pos, quat=quat, size=(0.004, 0.004, 0.004), group=4)
    return parent


def dh_pose(row: tuple[float, float, float]) -> tuple[Vec3, Quat]:
    """Pose of the next joint's frame after the turn about z: translation (a, 0, d), rotation by α about x."""
    d, a, alpha = row
    return (a, 0.0, d), (cos(alpha / 2), sin(alpha / 2), 0.0, 0.0)


def set_inertial(body: mujoco.MjsBody, mass: float, center: Vec3, inertia: Vec3) -> None:
    """Give a body its mass [kg], centre of mass [m] and inertia about it, along the body's axes [kg·m²]."""
    body.explicitinertial = True
    body.mass, body.ipos, body.iquat, body.inertia = mass, center, (1, 0, 0, 0), inertia


def add_capsule(
    body: mujoco.MjsBody, name: str, capsule: Capsule, *, mass: float, rgba: tuple[float, ...]
) -> mujoco.MjsGeom:
    """Add a colliding capsule to a body."""
    return body.add_geom(
        name=name,
        type=mujoco.mjtGeom.mjGEOM_CAPSULE,
        fromto=(*capsule.start, *capsule.end),
        size=(capsule.radius, 0, 0),
        mass=mass,
        rgba=rgba,
        group=ROBOT_GROUP,
    )
