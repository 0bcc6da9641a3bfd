"""Ranges and orders of every number of the configuration: each has one, and is checked by name."""

import copy
import math
import re
import typing
from collections.abc import Iterator
from dataclasses import fields, is_dataclass, replace
from typing import Any, get_args, get_origin

import pytest

from pixel2catch.checks import Within, require_valid
from pixel2catch.cli.main import COMMANDS, load_command, parse
from pixel2catch.envs.cfg import CatchEnvCfg, TaskVariant
from pixel2catch.envs.tasks import TASKS
from pixel2catch.errors import InvalidValueError
from pixel2catch.evaluation.protocol import EvaluationCfg
from pixel2catch.evaluation.stress import select_settings
from pixel2catch.learning.config import PRESETS, TrainCfg
from pixel2catch.learning.experiment import Experiment
from pixel2catch.robots.joint_dynamics import JointDynamics
from pixel2catch.workcells import workcells

COUPLED = (
    *("scene.physics_hz", "variants.share", "quat", "width", "height", "distortion", "pose_covariance"),
)
"""Ends of names whose values must also fit others; only values beyond their ranges are tried."""

WHOLE = (
    *("hover_steps", "max_steps", "rest_steps", "width", "height", "num_envs", "seed", "transitions"),
    *("rollout_steps", "epochs", "mini_batches", "hidden"),
)
"""Ends of names of whole numbers."""

NOMINAL = CatchEnvCfg()
VARIANT = TaskVariant(
    share=0.5, throws=NOMINAL.throws, randomization=NOMINAL.randomization, sensing=NOMINAL.sensing
)
EXPERIMENT = Experiment(env=replace(NOMINAL, variants=(VARIANT,)), train=TrainCfg())


def numbers_of(kind: Any, path: str, bounds: Within | None = None) -> Iterator[tuple[str, Within | None]]:
    """Yield the names of the numbers in a type, and the range of each.

    Names are paths of fields; entries of unlike kinds have their places in brackets.
    """
    if hasattr(kind, "__metadata__"):
        ranges = [each for each in kind.__metadata__ if isinstance(each, Within)]
        yield from numbers_of(kind.__origin__, path, ranges[0] if ranges else bounds)
    elif kind in (int, float):
        yield path, bounds
    elif is_dataclass(kind) and kind is not JointDynamics:  # its arrays check themselves
        for name, each in typing.get_type_hints(kind, include_extras=True).items():
            yield from numbers_of(each, f"{path}.{name}" if path else name)
    else:
        is_listed = get_origin(kind) is tuple and len(get_args(kind)) == 5
        for index, each in enumerate(get_args(kind)):
            yield from numbers_of(each, f"{path}[{index}]" if is_listed else path, bounds)


BOUNDS = {
    name: (each.low, each.high)
    for name, each in numbers_of(Experiment, "")
    if each and (not name.startswith("env.variants.") or name == "env.variants.share")
}
ENV = {name.removeprefix("env."): each for name, each in BOUNDS.items() if name.startswith("env.")}


@pytest.mark.parametrize("name", ["experiment", *COMMANDS])
def test_every_number_has_a_finite_range(name: str):
    for path, bounds in numbers_of(Experiment if name == "experiment" else load_command(name), ""):
        assert bounds, path
        assert math.isfinite(bounds.low), path
        assert math.isfinite(bounds.high), path


def value_at(value: Any, path: str) -> Any:
    for name in path.replace("[", ".").replace("]", "").split("."):
        value = value[int(name)] if name.isdigit() else getattr(value[0] if name == "share" else value, name)
    return value


def with_value(whole: Any, path: str, value: Any) -> Any:
    """A copy of a tree of dataclasses and tuples with another value, of any type."""
    if not path:
        return value
    name, _, rest = path.replace("[", ".").replace("]", "").partition(".")
    if isinstance(whole, tuple):
        index = int(name) if name.isdigit() else 0
        inner = with_value(whole[index], rest if name.isdigit() else path, value)
        return (*whole[:index], inner, *whole[index + 1 :])
    changed = copy.copy(whole)
    object.__setattr__(changed, name, with_value(getattr(whole, name), rest, value))
    return changed


def shaped(path: str, number: float) -> Any:
    """The number as a value of the field, which may be a tuple of equal numbers."""
    if path == "train.rewards":
        return {"arm.success": number}
    number = round(number) if path.endswith(WHOLE) and math.isfinite(number) else number

    def fill(like: Any) -> Any:
        return tuple(map(fill, like)) or (number,) if isinstance(like, tuple) else number

    return fill(((1.0, 1.0),) if ".gains." in path else value_at(EXPERIMENT, path))


def changed(path: str, value: Any) -> None:
    require_valid(with_value(EXPERIMENT, path, value))


@pytest.mark.parametrize("path", BOUNDS)
def test_a_number_beyond_its_range_is_refused_by_name(path: str):
    low, high = BOUNDS[path]
    name = path.partition("[")[0].replace("variants.", "variants[0].")
    for number in (low - max(abs(low), 1), high + max(abs(high), 1), 1e300, math.nan, math.inf, -math.inf):
        with pytest.raises(InvalidValueError, match=rf"^{re.escape(name)}[a-z.]* is .* must be "):
            changed(path, shaped(path, number))


@pytest.mark.parametrize("path", [f"env.{name}" for name in ENV if not name.endswith(COUPLED)])
def test_a_number_within_its_range_is_taken(path: str):
    low, high = BOUNDS[path]
    for number in (low, 0.5 * (low + high), high):
        changed(path, shaped(path, number))


OTHER = {
    "name": "mine",
    "engine": "physx",
    "cone": "pyramidal",
    "workcell": "ur5e_leap",
    "objects": ("cross",),
}
"""Other values of fields that are no numbers, by the ends of their names."""

NO_OPTIONS = ("scene.camera", "scene.visuals", "scene.object_friction", "scene.object_restitution")
"""`sensing.camera` is this camera, too; the others do nothing in a task."""


def options(value: Any, name: str) -> Iterator[str]:
    """Yield every field of a configuration but the dynamics as an option with its values."""
    if is_dataclass(value):
        for field in fields(value):
            place = f"{name}.{field.name}"
            if not place.endswith((*NO_OPTIONS, "dynamics", "variants", "pose_covariance")):
                yield from options(getattr(value, field.name), place)
    else:
        entries = value if isinstance(value, tuple) else (value,)
        yield name
        yield from (str(part) for each in entries for part in (each if isinstance(each, tuple) else (each,)))


def test_every_field_of_a_task_is_an_option(capsys: pytest.CaptureFixture[str]):
    """Numbers are in the middle of their ranges, flags are turned round."""
    env: Any = NOMINAL
    for path, (low, high) in ENV.items():
        if not path.endswith(COUPLED) and not path.startswith(NO_OPTIONS):
            env = with_value(env, path, shaped(f"env.{path}", 0.5 * (low + high)))
    for option in [*options(NOMINAL, "")]:
        path, end = option[1:], option.rpartition(".")[2]
        if end == "any_camera":  # excludes a camera
            continue
        if option.startswith(".") and (end in OTHER or isinstance(value_at(NOMINAL, path), bool)):
            env = with_value(env, path, OTHER.get(end, not value_at(NOMINAL, path)))
    assert parse(["train", "--device", "cpu", *options(env, "--env")]).env == env
    with pytest.raises(SystemExit):
        parse(["train", "--device", "cpu", "--env.help"])
    assert "--env.sensing.latency-steps" in capsys.readouterr().out


ORDERED = {
    "throws": "release_x release_y release_z aim_x aim_y aim_z peak_z hover_steps speed_deviation "
    "angle_deviation",
    "randomization": "mass_scale restitution friction command_delay push_out air_density side_force",
    "randomization.gains": "stiffness_scale damping_scale",
    "sensing": "latency_steps camera_offset camera_turn focal_error box_bias noise_scale drop_rate "
    "blackout_steps image_period clock_error stamp_jitter",
}
"""Fields whose first number is at most the second."""


@pytest.mark.parametrize("path", [f"{of}.{name}" for of, names in ORDERED.items() for name in names.split()])
def test_the_smaller_number_comes_first(path: str):
    low, high = ENV.get(path, (0.9, 0.95))
    pair = ((high, low),) if "gains" in path else (high, low)
    with pytest.raises(InvalidValueError, match=rf"env\.{path} is .* smaller number first"):
        changed(f"env.{path}", pair)


@pytest.mark.parametrize(
    ("path", "value"),
    [
        ("scene.physics_hz", 100.0),
        ("scene.physics_hz", "120"),
        ("throws.spin", True),
        ("throws.hover_steps", (1.5, 2)),
        ("throws.release_x", [2.4, 2.9]),
        ("throws.release_x", (2.4, 2.6, 2.9)),
        ("sensing.drop_rate", None),
        ("objects", ()),
        ("objects", "cube_s"),
        ("throws", None),
        ("scene.cone", "round"),
        ("scene.camera.quat", (1.0, 1.0, 0.0, 0.0)),
    ],
)
def test_a_value_of_another_kind_is_refused(path: str, value: Any):
    with pytest.raises(InvalidValueError, match=rf"env\.{path} "):
        changed(f"env.{path}", value)


def test_a_bad_value_of_a_variant_is_named():
    with pytest.raises(InvalidValueError, match=r"env\.variants\[0\]\.throws\.spin is -1"):
        changed("env.variants[0].throws.spin", -1.0)


def test_an_evaluation_refuses_bad_values_of_its_task():
    with pytest.raises(InvalidValueError, match=r"throws\.spin is -1"):
        EvaluationCfg(objects=("cube_s",), task=replace(NOMINAL, throws=replace(NOMINAL.throws, spin=-1.0)))


def test_tasks_work_cells_disturbances_and_presets_are_valid():
    for declared in (*TASKS.values(), *workcells().values()):
        require_valid(declared)
    for setting in select_settings(()):
        require_valid(setting.level.change(TASKS["nominal"]))
    for experiment in PRESETS.values():
        require_valid(experiment)
