"""A Franka FR3 with an Allegro hand."""

from pixel2catch.robots.allegro import allegro
from pixel2catch.robots.fr3 import FR3
from pixel2catch.robots.spec import Placed
from pixel2catch.robots.workcell import WorkcellSpec

WORKCELLS = (
    WorkcellSpec(
        name="fr3_allegro",
        robots=(Placed(robot=FR3.holding(allegro(), pos=(0.0, 0.0, 0.0095)), pos=(0.1, 0.0, 0.81)),),
    ),
)
"""The hand's frame sits 9.5 mm above the flange, the least that an adapter takes. The base stands as far
forward as the palm needs to be under every throw and look up there (ours)."""
