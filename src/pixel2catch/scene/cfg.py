"""What can be chosen about the scene."""

from dataclasses import dataclass

from pixel2catch.errors import InvalidValueError
from pixel2catch.scene.constants import CONTROL_DT, PHYSICS_DT, RGB_CAMERA, CameraSpec
from pixel2catch.scene.contact import SOLIMP
from pixel2catch.workcells.ur5e_allegro import UR5E_ALLEGRO

MAX_OBJECT_SCALE = 1.4
"""Of the largest object's 6.75 cm, that stays within `scene.OBJECT_BOUND`."""


@dataclass(frozen=True, kw_only=True)
class SceneCfg:
    """What can be chosen about the scene."""

    workcell: str = UR5E_ALLEGRO.name  #: Name of the work cell, or a Python file that defines `WORKCELLS`.
    #: Physics steps in a second, a multiple of the control rate. Default: paper.
    physics_hz: float = 1.0 / PHYSICS_DT
    visuals: bool = False  #: Whether to add lights, textures and what is only seen.
    camera: CameraSpec = RGB_CAMERA  #: What pictures are taken by.
    #: Sliding friction of the object; randomised per environment by the release.
    object_friction: float = 1.0
    object_restitution: float = 0.25  #: Speed after over speed before an impact; randomised per environment.
    #: Impedance of a contact with the object.
    object_solimp: tuple[float, float, float, float, float] = SOLIMP
    object_scale: float = 1.0  #: Factor on every object's size; its mass stays.

    def __post_init__(self) -> None:
        """Refuse a size without room, and a rate that does not divide a control step into physics steps."""
        if not 0.0 < self.object_scale <= MAX_OBJECT_SCALE:
            raise InvalidValueError(
                f"object_scale is {self.object_scale:g}; it must be in (0, {MAX_OBJECT_SCALE}]"
            )
        steps = self.physics_hz * CONTROL_DT
        if steps < 0.5 or abs(steps - round(steps)) > 1e-6:
            raise InvalidValueError(
                f"physics_hz is {self.physics_hz:g}; it must be a multiple of the control rate, "
                f"{1 / CONTROL_DT:g} Hz"
            )

    @property
    def decimation(self) -> int:
        """Physics steps in a control step."""
        return round(self.physics_hz * CONTROL_DT)

    @property
    def physics_dt(self) -> float:
        """Physics time step [s]."""
        return CONTROL_DT / self.decimation
