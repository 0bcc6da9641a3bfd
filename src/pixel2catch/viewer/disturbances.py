"""What can be made harder on the page, as data: fields of the task, each with a slider."""

from dataclasses import dataclass, replace
from math import radians

from pixel2catch.envs.cfg import CatchEnvCfg
from pixel2catch.evaluation.stress.suite import part

Setting = float | tuple[float, float]  #: A number, or the range from which every throw draws its own.


@dataclass(frozen=True, kw_only=True)
class Disturbance:
    """A field of the task and its slider."""

    label: str  #: What people read, with the unit.
    part: str  #: Part of the task, such as `sensing`.
    name: str  #: Field of that part: a number or a range.
    largest: float  #: Largest value, in the unit of the label; the least is 0.
    step: float  #: Step of the slider, in that unit.
    scale: float  #: The field's unit over the label's.
    #: Field with the distance of the values that are drawn, which is then the step; none if empty.
    grid: str

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
        grid = {self.grid: self.step} if self.grid else {}
        return part(self.part, **{self.name: value}, **grid)(task)


HINTS = {
    "latency [steps]": "Control steps of 33 ms between an image and its box; every throw draws its own.",
    "box noise [px]": "Largest error of each edge of the box.",
    "missing boxes [%]": "Share of the images in which the object is not found.",
    "camera turned [°]": "Angle between the camera and what the policy takes it for.",
    "camera moved [cm]": "Distance between the camera and what the policy takes it for.",
    "command delay [steps]": "Control steps between a command and its effect; every throw draws its own.",
    "restitution": "Speed after an impact over the speed before; every throw draws its own.",
    "drag: air [kg/m³]": "Density of the air that slows the object; real air has 1.2. "
    "The thrower makes up for it.",
}
"""What each disturbance means, in a sentence."""

DISTURBANCES = tuple(
    Disturbance(label=label, part=part, name=name, largest=largest, step=step, scale=scale, grid=grid)
    for label, part, name, largest, step, scale, grid in (
        ("latency [steps]", "sensing", "latency_steps", 5.0, 0.5, 1.0, "latency_grid"),
        ("box noise [px]", "sensing", "corner_noise", 20.0, 1.0, 1.0, ""),
        ("missing boxes [%]", "sensing", "drop_rate", 60.0, 5.0, 1e-2, ""),
        ("camera turned [°]", "sensing", "camera_turn", 4.0, 0.25, radians(1.0), ""),
        ("camera moved [cm]", "sensing", "camera_offset", 8.0, 0.5, 1e-2, ""),
        ("command delay [steps]", "randomization", "command_delay", 3.0, 0.5, 1.0, "command_delay_grid"),
        ("restitution", "randomization", "restitution", 0.8, 0.05, 1.0, ""),
        ("drag: air [kg/m³]", "randomization", "air_density", 3.6, 0.1, 1.0, ""),
    )
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
