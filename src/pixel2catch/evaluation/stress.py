"""Disturbances of the real world that the paper's training lacks, and which of them a policy was trained on.

Each level is a pure function from a task to a task. The values come from the sources and are not tuned to any
result. A step is a control step of 33 ms.
"""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from math import radians
from typing import Any

from pixel2catch.camera import region
from pixel2catch.checks import require_valid
from pixel2catch.envs.cfg import CatchEnvCfg
from pixel2catch.envs.tasks import LIGHT, OUTSIDE_CAMERA, PEOPLE_ROBOT, PEOPLE_THROWS
from pixel2catch.errors import InvalidValueError, UnknownNameError
from pixel2catch.mdp.dynamics_file import GainRanges
from pixel2catch.mdp.sensing import RELEASE_CAMERA
from pixel2catch.own_files import catalogue
from pixel2catch.workcells import find_workcell

Change = Callable[[CatchEnvCfg], CatchEnvCfg]  #: Returns a changed task; it can be pickled.
AIR_DENSITY = 1.2  #: At 20 °C and 1013 hPa [kg/m³]. Source: ideal gas, rounded.

_SOURCES = """
nominal: the task of training, at a finer physics rate
camera_position: 1 cm: hand-eye calibration with a board (ours); 1 to 3 cm: users' errors of a D435 beside an
    arm (librealsense issue 9784); 4 cm: twice its mean
camera_rotation: 0.5°: a calibration by a few images; 1°, 2°: a mount that is bumped or set by eye (ours)
focal_length: 2 %: two D435 differ by 1.5 % (608.9 px of realsense-ros issue 701, 618.2 px of the release);
    5 %: the maker's tolerance of the field of view, 69° ± 3°
box_bias: motion blur: in 8 ms of exposure an object of 4.5 m/s at 2.5 m moves by 9 px; a box that follows one
    end of the streak is half of that off; 10 px: twice as dark
box_scale: a mask that loses or adds 1.5 px of the rim of an object 15 px wide
edge_noise: twice the paper's 5 px, which are part of the 10
drops: ours; 30 %: background subtraction by KNN lost the object in 7 of 24 synthetic throws
blackout: 6: frames until motion segmentation found a thrown object again, 4 to 6; 3: half
latency: exposure, transfer and SAM 2 (18 to 20 ms on one H100, measured) are 2 to 3 steps; more than 100 ms
    of a D435 alone is librealsense issue 6036; 0: no latency at all; 1, 2: those of training; between whole
    steps: no camera's images fall on control steps
clock_error: ours: images that are stamped as they arrive instead of as they are taken, or by another
    computer's clock: 10 ms: a readout; 20 ms: with half an exposure in a dim room; 40 ms: a frame at 30 Hz in
    a buffer, and more; no stamps: every image is taken to be as old as the mean of the training
gains: 30 %: stiffness of the wrists identified from slow motion is 19 to 35 % off; 50 %: ours
command_delay: servoj's look-ahead time, 0.03 s by default and 0.1 s as often set, minus what the gains lag
latency_and_delay: levels of the two axes above at once, as on a robot; and half a step less of both, between
    whole steps
mass: foam; the lower end of the training | a tennis ball is 56.0 to 59.4 g (ITF rules)
restitution: 0.75: a tennis ball that falls 2.54 m rebounds to 1.35 to 1.47 m (ITF rules), which is 0.73 to
    0.76; 0 and 0.5: the ends of the training; 0.25: its middle
size: ours: the two scales of the training objects differ by 1.12 to 1.2
spin: a hand at 4.5 m/s that turns about the elbow, 0.45 m away | ours: with a flick of the wrist, four turns
    a second
air: density of air at 20 °C (International Standard Atmosphere); the thrower makes up for mean drag
throws: ours: released 1.0 to 1.9 m away; 2.4 to 2.9 in training | ours: released 2.9 to 3.5 m away
    | ours: peak 1.3 to 1.6 m high; 1.6 to 1.9 in training | ours: peak 1.9 to 2.3 m high, the camera at 2.2 m
    | derived: speed 5 % within a thrower (2.4 % in throwing contests, Walsh and Heazlewood; 7 % is the 95th
    percentile of handball players, Int. J. Computer Science in Sport 15/1); 2.5° of angle from a release
    timed to about 10 ms (Hore et al. 1996, J. Neurophysiol. 75, 1013, tennis balls at 3 m; taken as two
    standard deviations) by a hand that turns at 9 rad/s (4.5 m/s on a radius of 0.5 m); released between hip
    and chest, 2 to 3 m away
cameras: the region of `camera.region`, and 1 cm, 0.5° and 1 % of errors of a careful calibration
people: 30 recorded throws of a bottle from 3 to 4 m: `envs.tasks.PEOPLE_THROWS`; aimed: without their
    scatter; all: with the disturbances of the task people
together: levels of the axes above | levels of the axes above | levels of the axes above
    | a careful laboratory: the smallest level of each axis, a third of a blur streak of bias, and air, spin
    and unknown mass, which cannot be avoided. Throws are those of training
"""
"""Source of all levels of an axis, or of each | in their order."""

SOURCES = {
    axis: " ".join(text.split()).split(" | ")
    for axis, text in re.findall(r"^(\w+): (.+(?:\n    .+)*)", _SOURCES, re.MULTILINE)
}


@dataclass(frozen=True)
class FieldChange:
    """Sets fields of parts of a task, given as `(part, {field: value})`."""

    steps: tuple[tuple[str, Mapping[str, Any]], ...] = ()

    def __call__(self, cfg: CatchEnvCfg) -> CatchEnvCfg:
        for name, values in self.steps:
            cfg = replace(cfg, **{name: replace(getattr(cfg, name), **values)})
        return cfg


def part(name: str, **values: Any) -> FieldChange:
    """Return a change of fields of one part of the task, such as its `sensing`."""
    return FieldChange(((name, values),))


def together(*changes: FieldChange) -> FieldChange:
    """Return several changes as one."""
    return FieldChange(tuple(step for change in changes for step in change.steps))


@dataclass(frozen=True, kw_only=True)
class Level:
    """One strength of a disturbance."""

    label: str  #: Its name in tables, without the unit.
    change: Change  #: Its change of the task.
    source: str  #: Source of the number.
    __post_init__ = require_valid


@dataclass(frozen=True, kw_only=True)
class Axis:
    """One kind of disturbance: its name on the command line, the unit of the labels, its strengths."""

    name: str
    unit: str
    levels: tuple[Level, ...]
    __post_init__ = require_valid

    @property
    def settings(self) -> "tuple[Setting, ...]":
        return tuple(Setting(axis=self, level=level) for level in self.levels)


@dataclass(frozen=True, kw_only=True)
class Setting:
    """A level of an axis."""

    axis: Axis
    level: Level

    @property
    def name(self) -> str:
        """Name of its files: letters, digits, dots and hyphens."""
        return f"{self.axis.name}-{self.level.label}".replace(" ", "_").replace("±", "").rstrip("-")

    def changed(self, task: CatchEnvCfg) -> CatchEnvCfg:
        """Return the task at this level; raise InvalidValueError if it changes what an evaluation sets."""
        changed = self.level.change(task)
        for name in ("objects", "episode"):
            if getattr(changed, name, None) not in (None, getattr(task, name)):
                raise InvalidValueError(f"axis '{self.axis.name}' changes {name}; leave that to the command.")
        return changed

    @property
    def title(self) -> str:
        space = "" if self.axis.unit == "°" else " "
        return f"{self.axis.name.replace('_', ' ')} {self.level.label}{space}{self.axis.unit}".strip()


def _as(name: str, values: Any) -> FieldChange:
    """Return the change of a part of the task to the fields in which its class differs from the default."""
    default = type(values)()
    return part(name, **{key: each for key, each in vars(values).items() if each != getattr(default, key)})


def _gains(percent: float) -> FieldChange:
    scale = ((1.0 - percent / 100, 1.0 + percent / 100),)  # of every joint
    return part("randomization", gains=GainRanges(stiffness_scale=scale, damping_scale=scale))


def _mass(grams: float) -> FieldChange:
    return part("randomization", mass_scale=(grams / 30.0, grams / 30.0))


def _latency(steps: float) -> FieldChange:
    return part("sensing", latency_steps=(steps, steps))


def _delay(steps: float) -> FieldChange:
    return part("randomization", command_delay=(steps, steps))


def _sensing(
    field: str, values: Sequence[float], scale: float = 1.0, label: str = "{:g}"
) -> dict[str, FieldChange]:
    """Return a change for every value of a field of the sensors, which is the label's times `scale`."""
    return {label.format(value): part("sensing", **{field: value * scale}) for value in values}


def _axis(name: str, unit: str, changes: Mapping[str, Change]) -> Axis:
    """Return an axis from its changes by label, and `SOURCES`; one source is that of all levels."""
    sources = SOURCES[name] if len(SOURCES[name]) > 1 else SOURCES[name] * len(changes)
    levels = (
        Level(label=label, change=change, source=source)
        for (label, change), source in zip(changes.items(), sources, strict=True)
    )
    return Axis(name=name, unit=unit, levels=tuple(levels))


AIR = part("randomization", air_density=AIR_DENSITY)
HUMAN = part(
    "throws",
    release_x=(2.0, 3.0),
    release_y=(-0.4, 0.4),
    release_z=(0.9, 1.3),
    peak_z=(1.5, 2.0),
    speed_deviation=0.05,
    angle_deviation=radians(2.5),
)
SPIN = part("throws", spin=10.0)
EVERYTHING = together(  # a little of all disturbances
    part(
        "sensing",
        camera_offset=0.01,
        camera_turn=radians(0.5),
        focal_error=0.02,
        box_bias=3.0,
        drop_rate=0.05,
        latency_steps=(1, 3),
    ),
    _gains(30),
    part("randomization", command_delay=(0, 1), mass_scale=(0.5, 2.0)),
    AIR,
    SPIN,
)
THROWS = {
    "near": part("throws", release_x=(1.0, 1.9)),
    "far": part("throws", release_x=(2.9, 3.5)),
    "low": part("throws", peak_z=(1.3, 1.6)),
    "high": part("throws", peak_z=(1.9, 2.3)),
    "human": HUMAN,
}
COMBINED = {
    "camera mount": part("sensing", camera_offset=0.02, camera_turn=radians(1.0), focal_error=0.02),
    "detector": part("sensing", box_bias=5.0, drop_rate=0.15, latency_steps=(2, 4)),
    "flight": together(AIR, HUMAN, SPIN),
    "reality": EVERYTHING,
}
CLOCKS = _sensing("clock_error", (10, 20, 40), 1e-3, "{:g} ms") | {
    "no stamps": part("sensing", unstamped=1.0)
}
BOTH_LATE = {"2.5 and 0.5": together(_latency(2.5), _delay(0.5)), "3 and 1": together(_latency(3), _delay(1))}
RESTITUTIONS = {f"{e:g}": part("randomization", restitution=(e, e)) for e in (0, 0.25, 0.5, 0.75)}
LATENCIES = {f"{steps:g}": _latency(steps) for steps in (0, 1, 1.5, 2, 2.5, 3, 3.5, 4, 5)}

_ANY = part("sensing", any_camera=True, camera=RELEASE_CAMERA)
_CALIBRATED = part("sensing", camera_offset=0.01, camera_turn=radians(0.5), focal_error=0.01)
ANY_CAMERA = {"any": _ANY, "any with errors": together(_ANY, _CALIBRATED)}
_PEOPLE = together(_as("throws", PEOPLE_THROWS), _as("randomization", LIGHT))
OF_PEOPLE = {
    "aimed": together(_PEOPLE, part("throws", speed_deviation=0.0, angle_deviation=0.0)),
    "thrown": _PEOPLE,
    "all": together(
        _as("throws", PEOPLE_THROWS),
        _as("randomization", PEOPLE_ROBOT),
        _as("sensing", replace(OUTSIDE_CAMERA, clock_error=(0.0, 0.05))),
    ),
}

_ALL = (
    _axis("nominal", "", {"": together()}),
    _axis("camera_position", "cm", _sensing("camera_offset", (1, 2, 4), 1e-2)),
    _axis("camera_rotation", "°", _sensing("camera_turn", (0.5, 1, 2), radians(1.0))),
    _axis("focal_length", "%", _sensing("focal_error", (2, 5), 1e-2)),
    _axis("box_bias", "px", _sensing("box_bias", (5, 10))),
    _axis("box_scale", "", _sensing("box_scale", (0.8, 1.2))),
    _axis("edge_noise", "px", {"10": part("sensing", edge_noise=5.0)}),
    _axis("drops", "%", _sensing("drop_rate", (5, 15, 30), 1e-2)),
    _axis("blackout", "steps", _sensing("blackout_steps", (3, 6))),
    _axis("latency", "steps", LATENCIES),
    _axis("clock_error", "", CLOCKS),
    _axis("gains", "%", {f"±{percent}": _gains(percent) for percent in (30, 50)}),
    _axis("command_delay", "", {"1 step": _delay(1), "2 steps": _delay(2)}),
    _axis("latency_and_delay", "steps", BOTH_LATE),
    _axis("mass", "g", {"15": _mass(15), "60": _mass(60)}),
    _axis("restitution", "", RESTITUTIONS),
    _axis("size", "", {f"{scale:g}": part("scene", object_scale=scale) for scale in (0.8, 1.2)}),
    _axis("spin", "rad/s", {"10": SPIN, "25": part("throws", spin=25.0)}),
    _axis("air", "", {f"{grams} g": together(AIR, _mass(grams)) for grams in (30, 15)}),
    _axis("throws", "", THROWS),
    _axis("cameras", "", ANY_CAMERA),
    _axis("people", "", OF_PEOPLE),
    _axis("together", "", COMBINED),
)

AXES: dict[str, Axis] = catalogue(Axis, {axis.name: axis for axis in _ALL})
"""All axes by name, in the order of the tables; those of the user's own files last."""


def select_settings(names: Sequence[str]) -> tuple[Setting, ...]:
    """Return all levels of the named axes, in the order of the tables; without names, of every axis."""
    for name in names:
        if name not in AXES:
            raise UnknownNameError("axis", name, AXES)
    chosen = [axis for axis in AXES.values() if not names or axis.name in names]
    return tuple(setting for axis in chosen for setting in axis.settings)


PARTS = ("scene", "throws", "randomization", "sensing")
"""Parts of a task that are compared; a setting that changes another part is not trained on."""

GRIDS = {"latency_steps": "latency_grid", "command_delay": "command_delay_grid"}
"""Ranges with the field that holds the distance of their values; with 0 any value is drawn."""

BOUNDS = ("spin", "corner_noise", "edge_noise", "initial_joint_noise")
"""Fields that are the upper end of a range from 0."""

SHARES = ("unstamped",)  #: Shares of episodes in which an event happens; any share above 0 covers others.
TOLERANCE = 1e-9  #: Rounding of numbers that were computed from other units.
DEVIATIONS = 3.0  #: Standard deviations up to which the errors of a calibration are compared.


def is_trained_on(task: CatchEnvCfg, change: Change) -> bool:
    """Return whether a change of the nominal task is within the training's task or one of its variants.

    Every episode of the changed task must be one that the training could draw, in all fields in which the
    change differs from the nominal task with the camera of the training. The physics rate does not count.
    """
    nominal = CatchEnvCfg().with_camera(task.sensing.camera)
    changed = change(nominal)
    others = [field.name for field in fields(nominal) if field.name not in PARTS]
    if any(getattr(nominal, name) is not getattr(changed, name) for name in others):
        return False
    workcell = find_workcell(task.scene.workcell)
    same = {"camera": nominal.scene.camera, "physics_hz": nominal.scene.physics_hz}
    changed = replace(changed, scene=replace(changed.scene, **same))
    nominal, changed, trained = (each.for_workcell(workcell) for each in (nominal, changed, task))
    return any(
        all(_is_within(getattr(nominal, p), getattr(changed, p), getattr(variant, p)) for p in PARTS)
        for variant in trained.all_variants
    )


def _is_within(nominal: Any, changed: Any, trained: Any) -> bool:
    """Return whether the fields of a part that differ from the nominal ones are within the trained ones."""
    return all(
        _is_field_within(field.name, changed, trained)
        for field in fields(nominal)
        if getattr(nominal, field.name) != getattr(changed, field.name)
        and field.name not in GRIDS.values()  # they count with their ranges
    )


def _is_field_within(name: str, changed: Any, trained: Any) -> bool:
    """Return whether training can draw all values of one field of a part."""
    inner, outer = getattr(changed, name), getattr(trained, name)
    if name in GRIDS:
        return _is_drawn(inner, getattr(changed, GRIDS[name]), outer, getattr(trained, GRIDS[name]))
    if name in BOUNDS:
        return _is_inside((0.0, inner), (0.0, outer))
    if name == "camera":
        is_known = not region.outside(inner.camera) if trained.any_camera else inner.camera == outer.camera
        errors = (max(inner.pose_std[:3]), max(inner.pose_std[3:]), inner.focal_std or 0.0)
        drawn = (trained.camera_offset, trained.camera_turn, trained.focal_error)
        largest = ((0.0, DEVIATIONS * error) for error in errors)
        return is_known and all(map(_is_inside, largest, drawn))
    if name in SHARES:
        return (outer > 0.0 or inner == 0.0) and (outer < 1.0 or inner == 1.0)
    return _is_inside(inner, outer)


def _is_inside(inner: Any, outer: Any) -> bool:
    """Return whether numbers, ranges or structures of these are within others; other values must be equal."""
    if (drawn := _as_range(inner)) and (known := _as_range(outer)):
        return known[0] - TOLERANCE <= drawn[0] and drawn[1] <= known[1] + TOLERANCE
    if isinstance(inner, tuple) and isinstance(outer, tuple) and len(inner) == len(outer):
        return all(_is_inside(a, b) for a, b in zip(inner, outer, strict=True))
    if is_dataclass(inner) and not isinstance(inner, type) and type(inner) is type(outer):
        return all(_is_inside(getattr(inner, f.name), getattr(outer, f.name)) for f in fields(inner))
    return inner == outer


def _is_drawn(
    inner: tuple[float, float], inner_grid: float, outer: tuple[float, float], outer_grid: float
) -> bool:
    """Return whether all values of one delay are values of another one [control steps]."""
    if not _is_inside(inner, outer) or not outer_grid:
        return _is_inside(inner, outer)
    steps = ((inner[0] - outer[0]) / outer_grid, inner_grid / outer_grid if inner[0] < inner[1] else 1.0)
    return steps[1] > 0.0 and all(abs(each - round(each)) < TOLERANCE for each in steps)


def _as_range(value: Any) -> tuple[float, float] | None:
    """Return a number or a range of numbers as a range; nothing for other values."""
    ends: Any = value if isinstance(value, tuple) and len(value) == 2 else (value, value)
    is_range = all(isinstance(end, int | float) and not isinstance(end, bool) for end in ends)
    return ends if is_range else None
