"""The FR3 of Franka Robotics: seven joints, `fr3_flange` at its end."""

from dataclasses import replace
from math import radians
from pathlib import Path

from pixel2catch.robots import ur5e
from pixel2catch.robots.spec import RobotSpec, joint_table

LARGE, SMALL = (2500.0, 325.0, 0.195, 87.0), (2000.0, 260.0, 0.074, 12.0)
NARROW = radians(20)

ARM = replace(
    ur5e.ARM,
    joints=joint_table(
        "name lower upper home stiffness damping armature effort_limit frictionloss travel",
        ("fr3_joint1", -1.2, 1.2, 0.0, *LARGE, 1.137, (-2.7501, 2.7501, 6.0, 0.30)),
        ("fr3_joint2", -1.8361, 1.8361, 0.018, *LARGE, 1.137, (-1.7918, 1.7918, 2.585, 0.20)),
        ("fr3_joint3", -NARROW, NARROW, 0.0, *LARGE, 1.137, (-2.9065, 2.9065, 3.5, 0.20)),
        ("fr3_joint4", -3.0770, -0.1169, -2.357, *LARGE, 1.137, (-3.0481, -0.1458, 4.0, 0.30)),
        ("fr3_joint5", -NARROW, NARROW, 0.0, *SMALL, 0.763, (-2.8101, 2.8101, 17.0, 0.35)),
        ("fr3_joint6", 0.4398, 4.6216, 3.737, *SMALL, 0.44, (0.54092, 4.5205, 5.5, 0.35)),
        ("fr3_joint7", -NARROW, NARROW, 0.0, *SMALL, 0.248, (-3.0196, 3.0196, 17.0, 0.35)),
        velocity_limit=2.62,
        acceleration_limit=10.0,
    ),
)
"""From base to flange.

Source: limits of joints 2, 4 and 6, torques and speeds of joints 1 to 4: the maker's description;
accelerations and travel: libfranka, rate_limiting.h (joint_velocity_limits.h has the law); armature and
friction: published identification of the arm (MuJoCo Menagerie's figures). Limits of joints 1, 3, 5 and 7
are narrowed to what catching needs, as the release does with the UR5e's pan and wrists, and joints 5 to 7 are
no faster than the others, as the UR5e's wrists are (ours; the maker: 5.26, 4.18 and 5.26 rad/s): the palm
reaches the catch as well and as fast, and exploring turns it less. Start pose: the palm waits 0.6 m before
the base, looking up (ours); servo: ours, scaled from that of UR's shoulder by torque, and damped alike.
Command, gains and noise of actions: as the UR5e's.
"""

FR3 = RobotSpec(
    name="fr3", mjcf=Path(__file__).with_name("fr3.xml"), root="fr3_link0", groups=(ARM,), mount="fr3_flange"
)
