"""The Allegro hand as a chain of bodies: boxes for palm and links, capsules for the last links.

Hand frame: z to the fingertips, x out of the palm; the fingers curl towards x. The left hand has its index
finger at negative y; the right hand is its mirror image in y. Numbers: release, equal to the public
descriptions of the hand.
"""

from dataclasses import dataclass, replace
from math import cos, radians, sin
from typing import Literal

import mujoco

from pixel2catch.robot.constants import HAND_MOUNT_POS, HAND_MOUNT_QUAT, PALM_POS, Quat, Vec3
from pixel2catch.robot.ur5e import ROBOT_GROUP, Capsule, add_capsule, set_inertial

Handedness = Literal["left", "right"]

DARK_RGBA = (0.13, 0.13, 0.14, 1.0)
TIP_RGBA = (0.88, 0.87, 0.84, 1.0)

PALM_BOX_POS: Vec3 = (-0.0091, 0.0, 0.0475)
PALM_BOX_SIZE: Vec3 = (0.0204, 0.0565, 0.0475)
"""Centre and half-extents of the palm [m]; the front is at x = 0.0113, the height of the point called palm.

Source: public descriptions of the hand, moved by 0.2 mm so that the front passes through that point.
"""

PALM_MASS = 0.58


SECTION = (0.0196, 0.0275)
"""Thickness and width of every link of a finger [m]. Source: the maker's description of the hand."""

TIP_RADIUS = 0.012
"""Radius of the sphere at the end of a finger [m]. Source: the maker's description of the hand."""

TIP_MASS = 0.0168
"""What that sphere has of the mass of the last link [kg]. Source: the maker's description of the hand."""


@dataclass(frozen=True, kw_only=True)
class Block:
    """The box that the maker's description of the hand gives a link for its shape.

    Attributes:
        center: Its centre in the frame of the link [m].
        size: Its extents [m].
    """

    center: Vec3
    size: Vec3


@dataclass(frozen=True, kw_only=True)
class HandLink:
    """One link of a finger of the left hand.

    Attributes:
        pos: Position in the parent link [m].
        quat: Orientation in the parent link.
        axis: Axis of its joint; None for the welded first link of index, middle and ring finger.
        length: Distance to the next link's joint, or to the centre of the fingertip's sphere, along z [m].
        mass: Mass [kg].
        housing: Its block, where that is not of the length and the section of a finger.
        has_tip: Whether it ends in the fingertip's sphere.
    """

    pos: Vec3
    quat: Quat = (1.0, 0.0, 0.0, 0.0)
    axis: Vec3 | None = (0.0, 1.0, 0.0)
    length: float
    mass: float
    housing: Block | None = None
    has_tip: bool = False

    @property
    def block(self) -> Block:
        """The box of the link."""
        return self.housing or Block(center=(0.0, 0.0, self.length / 2), size=(*SECTION, self.length))


def _finger(y: float, z: float, tilt: float) -> tuple[HandLink, ...]:
    """Index, middle or ring finger with its root at (0, y, z) [m], tilted by `tilt` about x [rad]."""
    root = HandLink(
        pos=(0, y, z), quat=(cos(tilt / 2), sin(tilt / 2), 0, 0), axis=None, length=0.0164, mass=0.0119
    )
    return (
        root,
        HandLink(pos=(0, 0, 0.0164), length=0.0540, mass=0.065),
        HandLink(pos=(0, 0, 0.0540), length=0.0384, mass=0.0355),
        HandLink(pos=(0, 0, 0.0384), length=0.0267, mass=0.0264, has_tip=True),
    )


THUMB_HOUSING = Block(center=(-0.0179, -0.009, 0.0145), size=(0.0358, 0.034, 0.0455))
"""Box of the thumb's first link, left hand. Source: the maker's description of the hand."""

LEFT_HAND: dict[str, tuple[HandLink, ...]] = {
    "index": _finger(-0.0435, 0.0935, radians(5)),
    "middle": _finger(0.0, 0.0957, 0.0),
    "ring": _finger(0.0435, 0.0935, radians(-5)),
    "thumb": (
        HandLink(
            pos=(-0.0182, -0.0193, 0.0490),
            quat=(0.47771, 0.52133, -0.52133, 0.47771),
            axis=(1, 0, 0),
            length=0.0399,
            mass=0.0176,
            housing=THUMB_HOUSING,
        ),
        HandLink(pos=(-0.027, -0.005, 0.0399), axis=(0, 0, -1), length=0.0177, mass=0.0119),
        HandLink(pos=(0, 0, 0.0177), length=0.0514, mass=0.038),
        HandLink(pos=(0, 0, 0.0514), length=0.0423, mass=0.0556, has_tip=True),
    ),
}
"""Links of each finger from the palm to the tip. Source: release; cross-checked with public descriptions."""


def mirror_pos(pos: Vec3) -> Vec3:
    """Mirror image of a point in the xz plane."""
    return (pos[0], -pos[1], pos[2])


def mirror_quat(quat: Quat) -> Quat:
    """Mirror image of a rotation in the xz plane."""
    return (quat[0], -quat[1], quat[2], -quat[3])


def mirror_axis(axis: Vec3) -> Vec3:
    """Axis about which the mirror image turns by the same angle."""
    return (-axis[0], axis[1], -axis[2])


def mirror_link(link: HandLink) -> HandLink:
    """The same link of the other hand."""
    housing = link.housing
    return replace(
        link,
        pos=mirror_pos(link.pos),
        quat=mirror_quat(link.quat),
        axis=None if link.axis is None else mirror_axis(link.axis),
        housing=housing and Block(center=mirror_pos(housing.center), size=housing.size),
    )


def hand_links(handedness: Handedness) -> dict[str, tuple[HandLink, ...]]:
    """Links of every finger of the left or the right hand."""
    if handedness == "left":
        return LEFT_HAND
    return {finger: tuple(mirror_link(link) for link in links) for finger, links in LEFT_HAND.items()}


def add_hand(wrist: mujoco.MjsBody, flange: Vec3, handedness: Handedness) -> mujoco.MjsBody:
    """Mount the hand on the arm's last link, whose `tool0` is at `flange`, and return the body `palm`."""
    pos: Vec3 = (flange[0] + HAND_MOUNT_POS[0], flange[1] + HAND_MOUNT_POS[1], flange[2] + HAND_MOUNT_POS[2])
    palm = wrist.add_body(name="palm", pos=pos, quat=HAND_MOUNT_QUAT, gravcomp=1.0)
    palm.add_site(name="palm", pos=PALM_POS, size=(0.004, 0.004, 0.004), group=4)
    palm.add_geom(
        name="palm",
        type=mujoco.mjtGeom.mjGEOM_BOX,
        pos=PALM_BOX_POS,
        size=PALM_BOX_SIZE,
        mass=PALM_MASS,
        rgba=DARK_RGBA,
        group=3,
    )
    for finger, links in hand_links(handedness).items():
        _add_finger(palm, finger, links)
    return palm


def _add_finger(palm: mujoco.MjsBody, finger: str, links: tuple[HandLink, ...]) -> None:
    """Add the links of a finger, and the site in the middle of its tip at the end of the chain."""
    body = palm
    for i, link in enumerate(links):
        body = body.add_body(name=f"{finger}_link_{i}", pos=link.pos, quat=link.quat, gravcomp=1.0)
        if link.axis is not None:
            body.add_joint(name=f"{finger}_joint_{i}", axis=link.axis)
        _set_link_inertial(body, link)
        _add_link_shape(body, link)
    body.add_site(name=f"{finger}_tip", pos=(0, 0, links[-1].length), size=(0.004, 0.004, 0.004), group=4)


def _set_link_inertial(body: mujoco.MjsBody, link: HandLink) -> None:
    """A block of even density and, at the end of a finger, a sphere.

    That is what the maker's table of inertias is made of, but it gives them about a corner of the block with
    the joint as the centre of mass: no body has those. Ours are about the true centre.
    """
    (x, y, z), (cx, cy, cz) = link.block.size, link.block.center
    tip = TIP_MASS if link.has_tip else 0.0
    block, gap = link.mass - tip, link.length - cz
    across = block * tip / link.mass * gap**2
    ball = 0.4 * tip * TIP_RADIUS**2
    inertia: Vec3 = (
        block / 12 * (y * y + z * z) + ball + across,
        block / 12 * (x * x + z * z) + ball + across,
        block / 12 * (x * x + y * y) + ball,
    )
    set_inertial(body, link.mass, (cx, cy, cz + tip / link.mass * gap), inertia)


def _add_link_shape(body: mujoco.MjsBody, link: HandLink) -> None:
    """A capsule for the last link, which is wider in the middle than its tip only by 1.5 mm; else its box.

    Two parallel capsules instead of a box are no faster and touch the palm; a box and a sphere for the last
    link cost 4 to 10 % of a step and move no metric of a catch.
    """
    if link.has_tip:
        capsule = Capsule(start=(0, 0, 0), end=(0, 0, link.length), radius=TIP_RADIUS)
        add_capsule(body, body.name, capsule, mass=0.0, rgba=TIP_RGBA)
        return
    x, y, z = link.block.size
    body.add_geom(
        name=body.name,
        type=mujoco.mjtGeom.mjGEOM_BOX,
        pos=link.block.center,
        size=(x / 2, y / 2, z / 2),
        mass=0.0,
        rgba=DARK_RGBA,
        group=ROBOT_GROUP,
    )
