"""The FR3 of Franka Robotics: seven joints, `fr3_flange` at its end."""

from dataclasses import replace
from math import radians
from pathlib import Path

from pixel2catch.robots import ur5e
from pixel2catch.robots.spec import RobotSpec, joint_table

ARM = replace(
    ur5e.ARM,
    joints=joint_table(
        "name lower upper home stiffness damping armature frictionloss effort_limit",
        ("fr3_joint1", -1.2, 1.2, 0.0, 2500.0, 325.0, 0.195, 1.137, 87.0),
        ("fr3_joint2", -1.8361, 1.8361, 0.018, 2500.0, 325.0, 0.195, 1.137, 87.0),
        ("fr3_joint3", -radians(20), radians(20), 0.0, 2500.0, 325.0, 0.195, 1.137, 87.0),
        ("fr3_joint4", -3.0770, -0.1169, -2.357, 2500.0, 325.0, 0.195, 1.137, 87.0),
        ("fr3_joint5", -radians(20), radians(20), 0.0, 2000.0, 260.0, 0.074, 0.763, 12.0),
        ("fr3_joint6", 0.4398, 4.6216, 3.737, 2000.0, 260.0, 0.074, 0.44, 12.0),
        ("fr3_joint7", -radians(20), radians(20), 0.0, 2000.0, 260.0, 0.074, 0.248, 12.0),
        velocity_limit=2.62,
        acceleration_limit=10.0,
    ),
)
"""From base to flange.

Source: limits of joints 2, 4 and 6, torques and speeds of joints 1 to 4: the maker's description;
accelerations: libfranka, rate_limiting.h; armature
and friction: published identification of the arm (MuJoCo Menagerie's figures). Limits of joints 1, 3, 5 and 7
are narrowed to what catching needs, as the release does with the UR5e's pan and wrists, and joints 5 to 7 are
no faster than the others, as the UR5e's wrists are (ours; the maker: 5.26, 4.18 and 5.26 rad/s): the palm
reaches the catch as well and as fast, and exploring turns it less. Start pose: the palm waits 0.6 m before
the base, looking up (ours); servo: ours, scaled from that of UR's shoulder by torque, and damped alike.
Command, gains and noise of actions: as the UR5e's.
"""

FR3 = RobotSpec(
    name="fr3", mjcf=Path(__file__).with_name("fr3.xml"), root="fr3_link0", groups=(ARM,), mount="fr3_flange"
)
