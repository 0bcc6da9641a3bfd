"""A UR5e with a LEAP hand."""

from pixel2catch.robots.leap import LEAP_RIGHT
from pixel2catch.robots.ur5e import UR5E
from pixel2catch.workcells.ur5e_allegro import on_paper_table

WORKCELLS = (
    on_paper_table(
        "ur5e_leap", UR5E.holding(LEAP_RIGHT, pos=(-0.028, -0.0115, 0.11), quat=(0.5, 0.5, -0.5, 0.5))
    ),
)
"""The fingers lead on from the flange; the palm looks up at the start, as the Allegro hand's does (ours)."""
