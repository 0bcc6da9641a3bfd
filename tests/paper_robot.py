"""The joints of the paper's robot, of which most tests are."""

from pixel2catch.robots.allegro import HAND
from pixel2catch.robots.ur5e import ARM

ARM_JOINTS, HAND_JOINTS = ARM.joints, HAND.joints
JOINTS = (*ARM_JOINTS, *HAND_JOINTS)
