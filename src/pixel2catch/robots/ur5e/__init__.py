"""The UR5e of Universal Robots: six joints, `tool0` at its flange."""

from dataclasses import replace
from math import pi, radians
from pathlib import Path

from pixel2catch.robots.spec import JointGroup, RobotSpec, joint_table

ARM = JointGroup(
    name="arm",
    role="arm",
    joints=joint_table(
        "name lower upper home stiffness damping frictionloss armature effort_limit",
        ("shoulder_pan_joint", radians(120), radians(240), pi, 2504.0, 342.0, 0.51, 0.16, 150.0),
        ("shoulder_lift_joint", -2 * pi, 2 * pi, -0.6 * pi, 2848.0, 353.0, 0.42, 0.15, 150.0),
        ("elbow_joint", -pi, pi, 2 / 3 * pi, 2536.0, 343.0, 0.40, 0.14, 150.0),
        ("wrist_1_joint", radians(120), 2 * pi, pi, 1681.0, 234.0, 0.30, 0.23, 28.0),
        ("wrist_2_joint", radians(-110), radians(-90), -pi / 2, 2243.0, 279.0, 0.30, 0.20, 28.0),
        ("wrist_3_joint", radians(160), radians(200), pi, 2066.0, 202.0, 0.25, 0.21, 28.0),
        velocity_limit=2.79253,
    ),
    command="relative",
    gain_range=(0.8, 1.2),
    action_noise=0.03,
    action_bias=0.01,
)
"""From base to flange.

Source: start pose, limits and speed: release (its limits of pan and wrists are whole degrees); shoulder lift,
elbow and the upper limit of wrist 1: UR; servo, friction and armature: identified (release); effort: UR
(joint_limits.yaml of its ROS 2 description). Differs: the release allows 200 N·m, `UR5E_OF_RELEASE`. Command:
paper, Sec. IV-D; gains and noise of actions: paper, Table I; bias: release.
"""

UR5E = RobotSpec(
    name="ur5e", mjcf=Path(__file__).with_name("ur5e.xml"), root="base_link", groups=(ARM,), mount="tool0"
)

UR5E_OF_RELEASE = replace(
    UR5E, groups=(replace(ARM, joints=tuple(replace(joint, effort_limit=200.0) for joint in ARM.joints)),)
)
"""With the release's largest torques; of the wrists they are seven times UR's."""
