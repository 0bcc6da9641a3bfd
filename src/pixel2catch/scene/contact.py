"""Contact of the object: restitution as the damping of MuJoCo's direct `solref`."""

import math
from typing import TypeVar

from numpy import ndarray
from torch import Tensor

PUSH_OUT = 0.2
"""Share of a penetration that is removed in one physics step: it decays with a time constant of 5 steps.

Source: ours, `benchmarks/contact_quality.py`. More decays faster, but an object that is found deep in the
surface is then thrown out: a restitution is met up to half of this share, by where in a step the impact
falls.
"""

SOLIMP = (0.95, 0.99, 0.001, 0.5, 2.0)
"""Impedance of a contact with the object. Source: ours; MuJoCo's default lets an object creep in the hand."""


Value = TypeVar("Value", float, ndarray, Tensor)


def contact_solref(restitution: Value, physics_dt: float) -> tuple[Value, Value]:
    """Stiffness and damping of a contact, as the two negative numbers of a direct `solref`.

    A step changes the normal velocity v at depth p by dt (b |v| + k p). With b = (1 + e - PUSH_OUT / 2) / dt
    and k = PUSH_OUT / dt², and depths spread evenly over the way of one step, the mean velocity after the
    impact is e |v|.

    Args:
        restitution: e, speed after over speed before the impact; a number, or an array or tensor of them.
        physics_dt: Physics time step [s].

    Returns:
        (-k, -b), each like `restitution`.
    """
    stiffness = PUSH_OUT / physics_dt**2 + 0.0 * restitution
    damping = (1.0 - 0.5 * PUSH_OUT + restitution) / physics_dt
    return -stiffness, -damping


def table_solref(physics_dt: float) -> tuple[float, float]:
    """Time constant and damping ratio of the table, as stiff as a step allows: the arm is strong.

    Of a speed and a depth, a step removes all of the one and 80 % of the other. Not the direct form: of two
    direct ones MuJoCo Warp takes the smaller numbers, whatever the priorities, and the object has one.
    """
    return 2.0 * physics_dt, 1.0 / math.sqrt(4.0 * 0.8)
