"""The paper's robot: a UR5e with an Allegro hand; and two of them."""

from dataclasses import replace
from math import radians

from pixel2catch.robots.allegro import Handedness, allegro
from pixel2catch.robots.spec import Placed, Quat, RobotSpec, Vec3
from pixel2catch.robots.ur5e import ARM, UR5E, UR5E_OF_RELEASE
from pixel2catch.robots.workcell import TABLE, WorkcellSpec

UR5E_POS: Vec3 = (0.0, 0.0, 0.821)  #: Position of the UR5e's `base_link`. Source: release.

UR5E_QUAT: Quat = (0.0, 0.0, 0.0, 1.0)
"""Orientation of the UR5e's `base_link`: turned by 180° about z. Source: release.

UR's `base_link` is itself turned by 180° about z against the frame that the DH parameters start from. The two
turns cancel: the DH base frame is parallel to the world frame, and pan = π points the arm along +x.
"""

ALLEGRO_POS: Vec3 = (0.0, 0.0097, 0.0074)  #: The Allegro hand's frame in the UR5e's `tool0`. Source: release.

ALLEGRO_QUAT: Quat = (0.5**0.5, 0.0, 0.0, 0.5**0.5)
"""Its orientation there: hand x along y of `tool0`, hand y along its -x. Source: release."""


def ur5e_allegro(handedness: Handedness = "left", arm: RobotSpec = UR5E) -> RobotSpec:
    """A UR5e with an Allegro hand."""
    return arm.holding(allegro(handedness), pos=ALLEGRO_POS, quat=ALLEGRO_QUAT)


def on_paper_table(name: str, robot: RobotSpec) -> WorkcellSpec:
    """A work cell of one robot that stands where the paper's does."""
    return WorkcellSpec(name=name, robots=(Placed(robot=robot, pos=UR5E_POS, quat=UR5E_QUAT),))


UR5E_ALLEGRO = on_paper_table("ur5e_allegro", ur5e_allegro())
"""The paper's robot, with the left hand of the release."""

TURNED = {
    "shoulder_pan_joint": {"lower": radians(90), "upper": radians(270)},
    "wrist_2_joint": {"lower": radians(-130), "upper": radians(-50)},
    "wrist_3_joint": {"lower": radians(90), "upper": radians(270)},
}
"""Limits of arms whose palms turn to each other. Source: ours, within UR's."""

OF_TWO = replace(
    UR5E, groups=(replace(ARM, joints=tuple(replace(j, **TURNED.get(j.name, {})) for j in ARM.joints)),)
)
"""One of two that hold an object between their palms."""

TWO_UR5E_ALLEGRO = WorkcellSpec(
    name="two_ur5e_allegro",
    robots=(
        Placed(robot=ur5e_allegro("left", OF_TWO), pos=(0.15, 0.48, 0.821), quat=UR5E_QUAT, prefix="left_"),
        Placed(
            robot=ur5e_allegro("right", OF_TWO), pos=(0.15, -0.48, 0.821), quat=UR5E_QUAT, prefix="right_"
        ),
    ),
    table=replace(TABLE, size=(0.75, 1.7)),
)
"""Side by side on a longer table, with a left and a right hand.

So near that both palms reach what is thrown to a side, so far apart that arms do not hit each other there.
Source: ours, by scripted catches (experiments/LOG.md).
"""

WORKCELLS = (
    UR5E_ALLEGRO,
    on_paper_table("ur5e_allegro_right", ur5e_allegro("right")),
    on_paper_table("ur5e_allegro_release", ur5e_allegro(arm=UR5E_OF_RELEASE)),
    TWO_UR5E_ALLEGRO,
)
