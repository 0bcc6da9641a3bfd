"""What can be chosen about the scene, and the contacts that follow from it."""

from dataclasses import dataclass
from math import sqrt
from typing import Annotated, Literal, TypeVar

from numpy import ndarray
from torch import Tensor

from pixel2catch.checks import InOrder, PhysicsRate, Share, Within
from pixel2catch.robots.maker import Surface
from pixel2catch.scene.constants import CONTROL_DT, PHYSICS_DT, RGB_CAMERA, CameraSpec
from pixel2catch.workcells.ur5e_allegro import UR5E_ALLEGRO

Cone = Literal["elliptic", "pyramidal"]

MAX_OBJECT_SCALE = 1.4  #: Of the 14 cm to the end of the largest object, within `scene.OBJECT_BOUND`.

PUSH_OUT = 0.2
"""Share of a penetration that is removed in one physics step: it decays with a time constant of 5 steps.

Source: ours, `benchmarks/contact_quality.py`. More decays faster, but an object that is found deep in the
surface is then thrown out: a restitution is met up to half of this share, by where in a step the impact
falls.
"""

SOLIMP = (0.95, 0.99, 0.001, 0.5, 2.0)
"""Impedance of a contact with the object. Source: ours; MuJoCo's default lets an object creep in the hand."""


Impedance = Annotated[
    tuple[
        Annotated[float, Within(1e-4, 0.9999)],
        Annotated[float, Within(1e-4, 0.9999)],
        Annotated[float, Within(1e-6, 0.1)],
        Annotated[float, Within(0.01, 0.99)],
        Annotated[float, Within(1.0, 10.0)],
    ],
    InOrder(),
]
"""MuJoCo's `solimp`: least and largest impedance, width [m], midpoint and power."""


@dataclass(frozen=True, kw_only=True)
class SceneCfg:
    """What can be chosen about the scene."""

    workcell: str = UR5E_ALLEGRO.name  #: Name of the work cell, or a Python file that defines `WORKCELLS`.
    #: Physics steps in a second, a multiple of the control rate. Default: paper.
    physics_hz: PhysicsRate = 1.0 / PHYSICS_DT
    cone: Cone = "elliptic"  #: Friction cone: elliptic, as it is, or pyramidal, which is computed faster.
    #: Whether faces and edges touch in several points, as they do, or in one, which is computed faster.
    multiccd: bool = True
    engine: str = "mujoco"  #: Whose physics it is: mujoco, or another to judge policies by, such as physx.
    #: Makers' models, URDF or MJCF, one for each part of the robot that shall be simulated by it. Default:
    #: our models.
    robot_model: tuple[str, ...] = ()
    robot_surface: Surface = "collision"  #: What of these touches: their collision shapes, or what is drawn.
    visuals: bool = False  #: Whether to add lights, textures and what is only seen.
    camera: CameraSpec = RGB_CAMERA  #: What pictures are taken by.
    #: Sliding friction of the object; randomised per environment by the release.
    object_friction: Annotated[float, Within(0.0, 5.0)] = 1.0
    #: Speed after over speed before an impact; randomised per environment.
    object_restitution: Share = 0.25
    object_solimp: Impedance = SOLIMP  #: Impedance of a contact with the object.
    #: Factor on every object's size; its mass stays.
    object_scale: Annotated[float, Within(0.1, MAX_OBJECT_SCALE)] = 1.0

    @property
    def decimation(self) -> int:
        """Physics steps in a control step."""
        return round(self.physics_hz * CONTROL_DT)

    @property
    def physics_dt(self) -> float:
        """Physics time step [s]."""
        return CONTROL_DT / self.decimation


Value = TypeVar("Value", float, ndarray, Tensor)


def contact_solref(
    restitution: Value, physics_dt: float, push_out: Value | float = PUSH_OUT
) -> tuple[Value, Value]:
    """Stiffness and damping of a contact, as the two negative numbers (-k, -b) of a direct `solref`.

    A step of length dt changes the normal velocity v at depth p by dt (b |v| + k p). With k = push_out / dt²
    and b = (1 + e - push_out / 2) / dt, and depths spread evenly over the way of one step, the mean velocity
    after the impact is e |v|: e, the restitution, is a number, or an array or tensor of them.

    Below half of `push_out` that does not hold: an impact that a step finds deep rebounds by up to so much,
    one that it finds shallow needs a second step and does so then. A restitution of 0 is 0.1 in the mean.
    """
    stiffness = push_out / physics_dt**2 + 0.0 * restitution
    damping = (1.0 - 0.5 * push_out + restitution) / physics_dt
    return -stiffness, -damping


def restitution_of(solref: ndarray, physics_dt: float) -> float:
    """The restitution of a contact with a direct `solref`; 0 of any other form."""
    push_out = -float(solref[0]) * physics_dt**2
    return min(max(-float(solref[1]) * physics_dt - 1.0 + 0.5 * push_out, 0.0), 1.0)


def table_solref(physics_dt: float) -> tuple[float, float]:
    """Time constant and damping ratio of the table, as stiff as a step allows: the arm is strong.

    Of a speed and a depth, a step removes all of the one and 80 % of the other. Not the direct form: of two
    direct ones MuJoCo Warp takes the smaller numbers, whatever the priorities, and the object has one.
    """
    return 2.0 * physics_dt, 1.0 / sqrt(4.0 * 0.8)
