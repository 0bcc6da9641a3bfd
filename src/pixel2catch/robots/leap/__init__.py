"""The right LEAP hand (Shaw, Agarwal and Pathak 2023): three fingers and a thumb of four joints each."""

from dataclasses import replace
from functools import partial
from pathlib import Path

from pixel2catch.robots import allegro
from pixel2catch.robots.spec import FingerSpec, PalmSpec, RobotSpec

_joint = partial(allegro.finger_joint, effort_limit=0.5, velocity_limit=8.0)

FINGERS = ("index", "middle", "ring")

HAND = replace(
    allegro.HAND,
    joints=(
        *(
            _joint(name=f"leap_{finger}_{name}", lower=lower, upper=upper)
            for finger in FINGERS
            for name, lower, upper in (
                ("mcp", -0.314, 2.23),
                ("rot", -0.35, 0.35),
                ("pip", -0.506, 1.885),
                ("dip", -0.366, 2.042),
            )
        ),
        _joint(name="leap_thumb_cmc", lower=-0.349, upper=2.094),
        _joint(name="leap_thumb_axl", lower=-0.349, upper=2.094),
        _joint(name="leap_thumb_mcp", lower=-0.47, upper=2.443),
        _joint(name="leap_thumb_ipl", lower=-1.34, upper=1.88),
    ),
)
"""Four joints of each finger.

Source: limits: public descriptions of the hand, but for the fingers' abduction, which is narrowed to where
they do not press on each other (ours); torque and speed: the servos' data sheet (XL330-M288-T: 0.52 N·m and
10.8 rad/s at 5 V), rounded down; gains, friction and armature: ours, the Allegro hand's. Command, gain ranges
and noise of actions: as the Allegro hand's.
"""

LEAP_RIGHT = RobotSpec(
    name="leap_right",
    mjcf=Path(__file__).with_name("right.xml"),
    root="leap_palm",
    groups=(HAND,),
    palms=(
        PalmSpec(
            name="palm",
            site="leap_palm",
            body="leap_palm",
            fingers=tuple(
                FingerSpec(name=finger, root=f"leap_{finger}_base", tip=f"leap_{finger}_tip")
                for finger in (*FINGERS, "thumb")
            ),
            lower=(-0.25, -0.17, -0.20),
            upper=(0.16, 0.19, 0.10),
            hand=(
                ((-0.161, -0.081, -0.136), (-0.139, 0.091, 0.026)),
                ((-0.156, 0.089, -0.056), (-0.149, 0.101, 0.021)),
                ((-0.151, 0.089, -0.086), (-0.139, 0.111, 0.026)),
                ((-0.156, 0.049, 0.024), (-0.144, 0.081, 0.041)),
                ((-0.151, 0.079, 0.024), (-0.144, 0.091, 0.031)),
                ((-0.146, 0.029, 0.024), (-0.139, 0.091, 0.051)),
                ((-0.141, -0.126, -0.161), (0.131, 0.051, 0.061)),
                ((-0.141, 0.049, -0.126), (-0.134, 0.116, 0.056)),
                ((-0.136, 0.049, -0.146), (0.021, 0.136, 0.061)),
                ((-0.126, -0.116, 0.059), (0.101, 0.101, 0.081)),
            ),
            normal=(0.0, 0.0, -1.0),
        ),
    ),
)
"""The palm is the middle of the surface between fingers and thumb. Box: the model over all joint positions,
and the last link of an arm behind it, rounded up (ours). Boxes about the hand alone: where its parts were in
6,000 random joint positions, cut so that they refuse few poses of the UR5e about its start (ours); one box
would forbid a third of those: its fingers go far."""
