"""The Allegro hand of Wonik Robotics: index, middle and ring finger, and a thumb; left or right."""

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Literal

from pixel2catch.robots.spec import FingerSpec, JointGroup, JointSpec, PalmSpec, RobotSpec

Handedness = Literal["left", "right"]

ARMATURE = 1e-3
"""Reflected inertia of a drive [kg·m²].

Source: ours; task and release give none. It is the order of magnitude of a small rotor behind the hand's
reduction of about 1:369, and it keeps a finger struck by the object from being lighter than the object.
"""

finger_joint = partial(
    JointSpec,
    home=0.0,
    stiffness=3.0,
    damping=0.1,
    frictionloss=0.01,
    armature=ARMATURE,
    effort_limit=0.5,
    velocity_limit=7.0,
)
"""A joint of a finger, but for its name and limits."""

HAND = JointGroup(
    name="hand",
    role="hand",
    joints=(
        *(
            finger_joint(name=f"{finger}_joint_{i}", lower=lower, upper=upper)
            for finger in ("index", "middle", "ring")
            for i, lower, upper in ((1, -0.196, 1.610), (2, -0.174, 1.709), (3, -0.227, 1.618))
        ),
        finger_joint(name="thumb_joint_0", lower=0.263, upper=1.396, home=0.263),
        finger_joint(name="thumb_joint_1", lower=-0.105, upper=1.163),
        finger_joint(name="thumb_joint_2", lower=-0.189, upper=1.644),
        finger_joint(name="thumb_joint_3", lower=-0.162, upper=1.719),
    ),
    command="absolute",
    gain_range=(0.7, 1.3),
    action_noise=0.02,
    action_bias=0.005,
)
"""Three joints of each finger (the abduction joint is fixed at 0), four of the thumb.

Source: limits, servo, friction and effort: release; lower limit of thumb joint 0: task (the joint itself
reaches -0.105); speed: public descriptions of the hand. Command: paper, Sec. IV-D; gains and noise of
actions: paper, Table I; bias: release.
"""

PALM = PalmSpec(
    name="palm",
    site="palm",
    body="palm",
    fingers=tuple(
        FingerSpec(name=finger, root=f"{finger}_link_0", tip=f"{finger}_tip")
        for finger in ("index", "middle", "ring", "thumb")
    ),
    lower=(-0.06, -0.18, -0.11),
    upper=(0.15, 0.18, 0.25),
    hand=(((-0.055, -0.18, -0.03), (0.15, 0.075, 0.25)),),
)
"""The point called palm is the centre of the palm's surface (release). Box: the model over all joint
positions of either hand, on the last link of the UR5e, rounded up; and of the left hand alone."""

RIGHT_PALM = replace(PALM, hand=(((-0.055, -0.075, -0.03), (0.15, 0.18, 0.25)),))
"""The same of the right hand, whose thumb is at the other side."""


def allegro(handedness: Handedness = "left") -> RobotSpec:
    """The left hand, as in the release, or its mirror image."""
    return RobotSpec(
        name=f"allegro_{handedness}",
        mjcf=Path(__file__).with_name(f"{handedness}.xml"),
        root="palm",
        groups=(HAND,),
        palms=(PALM if handedness == "left" else RIGHT_PALM,),
    )
