"""What can be made harder on the page, as data: fields of the task, each with a slider."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from math import radians

from pixel2catch.envs.cfg import CatchEnvCfg
from pixel2catch.evaluation.stress.suite import part

Setting = float | tuple[float, float]  #: A number, or the range from which every throw draws its own.


@dataclass(frozen=True, kw_only=True)
class Disturbance:
    """A field of the task and its slider."""

    label: str  #: What people read, with the unit.
    hint: str  #: What it means, in a sentence.
    part: str  #: Part of the task, such as `sensing`.
    name: str  #: Field of that part: a number or a range.
    largest: float  #: Largest value, in the unit of the label; the least is 0.
    step: float  #: Step of the slider, in that unit.
    scale: float = 1.0  #: The field's unit over the label's.
    others: Mapping[str, float] = field(default_factory=dict)  #: Fields that go with it, where it is changed.

    def of(self, task: CatchEnvCfg) -> Setting:
        """What a task has, in the unit of the label."""
        value = getattr(getattr(task, self.part), self.name)
        return tuple(each / self.scale for each in value) if isinstance(value, tuple) else value / self.scale

    def applied(self, task: CatchEnvCfg, setting: Setting) -> CatchEnvCfg:
        """The task with another setting, in the unit of the label; the task itself if it is the same."""
        if setting == self.of(task):
            return task
        value = (
            tuple(each * self.scale for each in setting)
            if isinstance(setting, tuple)
            else setting * self.scale
        )
        return part(self.part, **{self.name: value, **self.others})(task)


DISTURBANCES = (
    Disturbance(
        label="latency [steps]",
        hint="Control steps of 33 ms between an image and its box; every throw draws its own.",
        part="sensing",
        name="latency_steps",
        largest=5.0,
        step=0.5,
        others={"latency_grid": 0.5},
    ),
    Disturbance(
        label="box noise [px]",
        hint="Largest error of each edge of the box.",
        part="sensing",
        name="corner_noise",
        largest=20.0,
        step=1.0,
    ),
    Disturbance(
        label="missing boxes [%]",
        hint="Share of the images in which the object is not found.",
        part="sensing",
        name="drop_rate",
        largest=60.0,
        step=5.0,
        scale=1e-2,
    ),
    Disturbance(
        label="camera turned [°]",
        hint="Angle between the camera and what the policy takes it for.",
        part="sensing",
        name="camera_turn",
        largest=4.0,
        step=0.25,
        scale=radians(1.0),
    ),
    Disturbance(
        label="camera moved [cm]",
        hint="Distance between the camera and what the policy takes it for.",
        part="sensing",
        name="camera_offset",
        largest=8.0,
        step=0.5,
        scale=1e-2,
    ),
    Disturbance(
        label="command delay [steps]",
        hint="Control steps between a command and its effect; every throw draws its own.",
        part="randomization",
        name="command_delay",
        largest=3.0,
        step=0.5,
        others={"command_delay_grid": 0.5},
    ),
    Disturbance(
        label="restitution",
        hint="Speed after an impact over the speed before; every throw draws its own.",
        part="randomization",
        name="restitution",
        largest=0.8,
        step=0.05,
    ),
    Disturbance(
        label="drag: air [kg/m³]",
        hint="Density of the air that slows the object; real air has 1.2. The thrower makes up for it.",
        part="randomization",
        name="air_density",
        largest=3.6,
        step=0.1,
    ),
)


def disturbed(task: CatchEnvCfg, settings: tuple[Setting, ...]) -> CatchEnvCfg:
    """A task with a setting for each of `DISTURBANCES`."""
    for disturbance, setting in zip(DISTURBANCES, settings, strict=True):
        task = disturbance.applied(task, setting)
    return task


def released_at(task: CatchEnvCfg, pos: tuple[float, float, float]) -> CatchEnvCfg:
    """A task whose throws all begin at one point [m], and still pass the places that they are aimed at."""
    x, y, z = pos
    throws = replace(task.throws, release_x=(x, x), release_y=(y, y), release_z=(z, z))
    return replace(task, throws=throws)
