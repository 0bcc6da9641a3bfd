"""Fields of the task as options, `--env.sensing.latency-steps 1 3`, and their defaults."""

import dataclasses
from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import tyro

from pixel2catch.checks import CameraPath, DynamicsPath, RobotModelPath
from pixel2catch.cli.console import say
from pixel2catch.errors import InvalidValueError

if TYPE_CHECKING:
    from pixel2catch.envs.cfg import CatchEnvCfg
    from pixel2catch.evaluation.stress.suite import Change, Setting
    from pixel2catch.policy import LoadedPolicy

PREFIX = "--env."  #: What options that are fields of the task begin with.
HELP = "--env.help"

OF_THE_PROTOCOL = ("objects", "episode", "scene.workcell")  #: Fields that an evaluation sets itself.

TaskFields = tyro.conf.FlagConversionOff[tyro.conf.AvoidSubcommands[Any]]
"""Type of a field for a `CatchEnvCfg`: tyro takes the fields of the default instance. None has no options."""

Given = tyro.conf.Suppress[tyro.conf.Fixed[tuple[str, ...]]]
"""Names of the fields of the task that are given."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class TaskHelp:
    """All fields of the task, as options of commands that train or evaluate."""

    env: TaskFields = None

    @classmethod
    def default_for(cls, _: Sequence[str]) -> "TaskHelp":
        """Return it with the fields of the paper's task."""
        from pixel2catch.envs.cfg import CatchEnvCfg

        return cls(env=CatchEnvCfg())


def given_fields(args: Sequence[str]) -> tuple[str, ...]:
    """Return the names of the task's fields among arguments, such as sensing.latency_steps."""
    options = (arg.removeprefix(PREFIX).partition("=")[0] for arg in args if arg.startswith(PREFIX))
    return tuple(option.replace("-", "_") for option in options)


def default_of(command: Any, args: Sequence[str]) -> Any:
    """Return the instance of a command whose values hold where options are not given; None for its own.

    A command with an attribute `default_for` makes it from the arguments. Where fields of the task are given,
    the field `env` of another command, or of its field `task`, is the paper's task.
    """
    if hasattr(command, "default_for"):
        return command.default_for(args)
    if not (given := given_fields(args)):
        return None
    from pixel2catch.envs.cfg import CatchEnvCfg

    values = {"env": CatchEnvCfg(), "given": given}
    for field in dataclasses.fields(command):
        if field.name == "env":
            return command(**values)
        if field.name == "task":
            return command(task=field.default_factory(**values))  # pyright: ignore[reportCallIssue]
    return None


def with_given(task: Any, source: Any, given: Sequence[str]) -> Any:
    """Return a configuration with the given fields (dotted names) of another one."""
    parts: dict[str, list[str]] = {}
    for name in given:
        first, _, rest = name.partition(".")
        parts.setdefault(first, []).append(rest)
    values = {}
    for name, inner in parts.items():
        old, new = getattr(task, name), getattr(source, name)
        is_whole = "" in inner or not dataclasses.is_dataclass(old)
        values[name] = new if is_whole else with_given(old, new, inner)
    return dataclasses.replace(task, **values)


@dataclasses.dataclass(frozen=True, kw_only=True)
class TaskOptions:
    """Changes of the task of an evaluation."""

    #: Makers' models of arm, hand or both, URDF or MJCF: simulated with their axes, masses and collision
    #: shapes (--env.scene.robot-surface visual: with what is drawn). Default: our models.
    robot_model: tuple[RobotModelPath, ...] = ()
    #: Any field of the task, such as --env.throws.peak-z 1.5 1.9. All fields: --env.help.
    env: TaskFields = None
    given: Given = ()  #: Which of them are given.

    def change(self, task: "CatchEnvCfg", command: str) -> "CatchEnvCfg":
        """Return the changed task; the command is named in errors.

        Raises:
            InvalidValueError: The protocol of evaluations sets a given field itself.
        """
        for name in self.given:
            if name in OF_THE_PROTOCOL or name.partition(".")[0] in OF_THE_PROTOCOL:
                raise InvalidValueError(
                    f"'{command}' sets --env.{name} itself, by the policy and by --objects; leave it out."
                )
        changed = with_given(task, self.env, self.given)
        if self.robot_model:
            scene = dataclasses.replace(changed.scene, robot_model=tuple(map(str, self.robot_model)))
            changed = dataclasses.replace(changed, scene=scene)
        return changed

    def beneath(self, setting: "Setting", command: str) -> "Setting":
        """Return a setting that disturbs the changed task."""
        if not self.given and not self.robot_model:
            return setting
        change = partial(_disturbed, self, command, setting.level.change)
        return dataclasses.replace(setting, level=dataclasses.replace(setting.level, change=change))


@dataclasses.dataclass(frozen=True, kw_only=True)
class SimulatedTask(TaskOptions):
    """What is simulated."""

    #: Dynamics file of the robot that is simulated, as `identify` writes it. Default: the nominal robot, also
    #: for a policy that was trained with a dynamics file.
    dynamics: DynamicsPath | None = None
    #: Camera file of the camera that is simulated, as `calibrate` writes it: what that camera would do to the
    #: policy. Default: the camera that the policy was trained for, known exactly.
    camera: CameraPath | None = None

    def make(self, policy: "LoadedPolicy", command: str, physics_hz: float = 600.0) -> "CatchEnvCfg":
        """Return the task in which a policy acts; print what its camera means."""
        from pixel2catch.evaluation.loading import camera_remark, task_of

        task = self.change(task_of(policy, physics_hz, self.dynamics, self.camera), command)
        for remark in camera_remark(policy, task):
            say(remark)
        return task


def _disturbed(options: TaskOptions, command: str, then: "Change", task: "CatchEnvCfg") -> "CatchEnvCfg":
    return then(options.change(task, command))
