"""Any field of the task on the command line: `--env.sensing.latency-steps 1 3`."""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from pixel2catch.errors import InvalidValueError

if TYPE_CHECKING:
    from pixel2catch.envs.cfg import CatchEnvCfg
    from pixel2catch.evaluation.stress.suite import Setting

FieldOptions = Annotated[
    tyro.conf.UseAppendAction[tuple[tuple[str, ...], ...]], tyro.conf.arg(metavar="FIELD VALUE ...")
]
"""Names of fields of the task, each with its values, such as `("throws.peak-z", "1.5", "1.9")`."""

OF_THE_PROTOCOL = ("objects", "episode")  #: Fields that an evaluation sets itself.


def with_fields(env: "CatchEnvCfg", options: FieldOptions, command: str = "train") -> "CatchEnvCfg":
    """Return a task with other values of some fields; tyro prints help and mistakes, and exits."""
    if not options:
        return env
    task = dataclasses.make_dataclass("Task", [("env", type(env))])
    names = {"help": "--help"}
    found = tyro.cli(
        task,
        args=[arg for name, *values in options for arg in (names.get(name, f"--env.{name}"), *values)],
        default=task(dataclasses.replace(env, dynamics=None)),
        prog=f"pixel2catch {command}",
        description="Fields of the task and their values, without what is given by other options.",
        config=(tyro.conf.AvoidSubcommands, tyro.conf.FlagConversionOff),
    )
    return dataclasses.replace(found.env, dynamics=env.dynamics)


@dataclasses.dataclass(frozen=True, kw_only=True)
class EvaluatedTask:
    """Changes the task of an evaluation: fields of the command line, then what disturbs it."""

    options: FieldOptions  #: The fields and their values.
    command: str  #: The command, for its help.
    robot_model: tuple[Path, ...] = ()  #: Makers' models of parts of the robot, if it shall be simulated so.
    then: "Callable[[CatchEnvCfg], CatchEnvCfg] | None" = None  #: What else changes.

    def __call__(self, env: "CatchEnvCfg") -> "CatchEnvCfg":
        """Return the changed task.

        Raises:
            InvalidValueError: If a field is the protocol's.
        """
        changed = with_fields(env, self.options, self.command)
        for name in OF_THE_PROTOCOL:
            if getattr(changed, name) != getattr(env, name):
                raise InvalidValueError(
                    f"--env.{name} is the protocol's to set in '{self.command}'; name objects by --objects."
                )
        if self.robot_model:
            scene = dataclasses.replace(changed.scene, robot_model=tuple(map(str, self.robot_model)))
            changed = dataclasses.replace(changed, scene=scene)
        return self.then(changed) if self.then else changed


def with_changes(
    setting: "Setting", command: str, options: FieldOptions, robot_model: tuple[Path, ...] = ()
) -> "Setting":
    """A setting of which the task is changed first, if it is: see `EvaluatedTask`."""
    if not options and not robot_model:
        return setting
    then = setting.level.change
    change = EvaluatedTask(options=options, command=command, robot_model=robot_model, then=then)
    return dataclasses.replace(setting, level=dataclasses.replace(setting.level, change=change))
