"""The joints of the paper's robot, of which most tests are."""

from pixel2catch.robots.allegro import HAND
from pixel2catch.robots.ur5e import ARM

ARM_JOINTS, HAND_JOINTS = ARM.joints, HAND.joints
JOINTS = (*ARM_JOINTS, *HAND_JOINTS)

OWN_CELL = """
from dataclasses import replace

from pixel2catch.workcells.ur5e_allegro import UR5E_ALLEGRO

(robot,) = UR5E_ALLEGRO.robots
WORKCELLS = (replace(UR5E_ALLEGRO, name="mine", robots=(replace(robot, pos=(0.1, 0.0, 0.821)),)),)
"""
"""A file of a work cell of one's own: the paper's, 10 cm further ahead."""
