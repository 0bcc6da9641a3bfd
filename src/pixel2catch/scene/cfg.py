"""Configuration of the scene, and its contact parameters."""

from dataclasses import dataclass
from math import sqrt
from typing import Annotated, Literal, TypeVar

from numpy import ndarray
from torch import Tensor

from pixel2catch.checks import PhysicsRate, Share, Within
from pixel2catch.scene.constants import CONTROL_DT, PHYSICS_DT, RGB_CAMERA, CameraSpec
from pixel2catch.workcells.ur5e_allegro import UR5E_ALLEGRO

MAX_OBJECT_SCALE = 1.4  #: Largest scale of objects: the largest object must fit into `OBJECT_BOUND`.

PUSH_OUT = 0.2
"""Share of a penetration that one physics step removes: time constant of 5 steps.

Source: ours, by drops and throws on table and palm (experiments/LOG.md). A larger share decays faster, but
adds up to half of it to the restitution, depending on the penetration at the first step of an impact.
"""

SOLIMP = (0.95, 0.99, 0.001, 0.5, 2.0)
"""MuJoCo's `solimp` of a contact with the object. Source: ours; objects creep with its default."""


@dataclass(frozen=True, kw_only=True)
class SceneCfg:
    """Robots, physics, contacts and camera of the scene."""

    workcell: str = UR5E_ALLEGRO.name  #: Name of the work cell.
    #: Physics steps in a second, a multiple of the control rate. Default: paper.
    physics_hz: PhysicsRate = 1.0 / PHYSICS_DT
    #: Friction cone: elliptic, or pyramidal, which is faster and less accurate.
    cone: Literal["elliptic", "pyramidal"] = "elliptic"
    multiccd: bool = True  #: Whether faces and edges touch in several points, or in one, which is faster.
    engine: str = "mujoco"  #: Physics engine: mujoco, or physx or drake for evaluations.
    visuals: bool = False  #: Whether to add lights, textures and visual geoms.
    camera: CameraSpec = RGB_CAMERA  #: The true camera, which takes pictures; see `SensingCfg.camera`.
    #: Sliding friction of the object; randomised per environment by the release.
    object_friction: Annotated[float, Within(0.0, 5.0)] = 1.0
    object_restitution: Share = 0.25  #: Speed after over speed before an impact; randomised per environment.
    #: Factor on every object's size; its mass stays.
    object_scale: Annotated[float, Within(0.1, MAX_OBJECT_SCALE)] = 1.0

    @property
    def decimation(self) -> int:
        """Return the number of physics steps in a control step."""
        return round(self.physics_hz * CONTROL_DT)

    @property
    def physics_dt(self) -> float:
        """Return the physics time step [s]."""
        return CONTROL_DT / self.decimation


Value = TypeVar("Value", float, ndarray, Tensor)


def contact_solref(
    restitution: Value, physics_dt: float, push_out: Value | float = PUSH_OUT
) -> tuple[Value, Value]:
    """Return the direct `solref` (-k, -b) of a contact with a restitution e.

    A step of length dt changes the normal velocity v at depth p by dt (b |v| + k p). With k = push_out / dt²
    and b = (1 + e - push_out / 2) / dt, the mean velocity after an impact is e |v|, for depths uniform over
    the distance of one step. For e below half of `push_out` the mean is larger: e = 0 gives 0.1.
    """
    stiffness = push_out / physics_dt**2 + 0.0 * restitution
    damping = (1.0 - 0.5 * push_out + restitution) / physics_dt
    return -stiffness, -damping


def restitution_of(solref: ndarray, physics_dt: float) -> float:
    """Return the restitution of a contact with a direct `solref`; 0 for the other form."""
    push_out = -float(solref[0]) * physics_dt**2
    return min(max(-float(solref[1]) * physics_dt - 1.0 + 0.5 * push_out, 0.0), 1.0)


def table_solref(physics_dt: float) -> tuple[float, float]:
    """Return time constant and damping ratio of the table, as stiff as the time step allows.

    A step removes all of a speed and 80 % of a depth. This is not the direct form, as MuJoCo Warp ignores
    priorities between two contacts with direct forms, and the object has one.
    """
    return 2.0 * physics_dt, 1.0 / sqrt(4.0 * 0.8)
