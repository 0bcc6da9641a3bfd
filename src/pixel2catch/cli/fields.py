"""Any field of the task on the command line: `--env.sensing.latency-steps 1 3`."""

import dataclasses
from functools import partial
from typing import TYPE_CHECKING, Annotated

import tyro

from pixel2catch.checks import CameraPath, DynamicsPath, RobotModelPath, require_valid
from pixel2catch.cli.console import say
from pixel2catch.errors import InvalidValueError

if TYPE_CHECKING:
    from pixel2catch.envs.cfg import CatchEnvCfg
    from pixel2catch.evaluation.stress.suite import Change, Setting
    from pixel2catch.policy import LoadedPolicy

FieldOptions = Annotated[
    tyro.conf.UseAppendAction[tuple[tuple[str, ...], ...]], tyro.conf.arg(metavar="FIELD VALUE ...")
]
"""Names of fields of the task, each with its values, such as `("throws.peak-z", "1.5", "1.9")`."""

OF_THE_PROTOCOL = ("objects", "episode")  #: Fields that an evaluation sets itself.


def with_fields(env: "CatchEnvCfg", options: FieldOptions, command: str = "train") -> "CatchEnvCfg":
    """Return a task with other values of some fields; tyro prints help and mistakes, and exits.

    Raises:
        InvalidValueError: A value is out of range.
    """
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
    require_valid(found.env, "env")
    return dataclasses.replace(found.env, dynamics=env.dynamics)


@dataclasses.dataclass(frozen=True, kw_only=True)
class TaskOptions:
    """What is changed of the task of an evaluation."""

    #: Makers' models of arm, hand or both, URDF or MJCF: simulated with their axes, masses and collision
    #: shapes (--env.scene.robot-surface visual: with what is drawn). Default: our models.
    robot_model: tuple[RobotModelPath, ...] = ()
    #: Any field of the task, also as --env.throws.peak-z 1.5 1.9. All fields: --env.help.
    env: FieldOptions = ()

    def change(self, task: "CatchEnvCfg", command: str) -> "CatchEnvCfg":
        """Return the changed task; the command is named in help and mistakes.

        Raises:
            InvalidValueError: If a field is the protocol's.
        """
        changed = with_fields(task, self.env, command)
        for name in OF_THE_PROTOCOL:
            if getattr(changed, name) != getattr(task, name):
                raise InvalidValueError(
                    f"--env.{name} is the protocol's to set in '{command}'; name objects by --objects."
                )
        if self.robot_model:
            scene = dataclasses.replace(changed.scene, robot_model=tuple(map(str, self.robot_model)))
            changed = dataclasses.replace(changed, scene=scene)
        return changed

    def beneath(self, setting: "Setting", command: str) -> "Setting":
        """A setting that disturbs the changed task, if it is changed."""
        if not self.env and not self.robot_model:
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
        """The task in which a policy of a command is to catch; what its camera means is said."""
        from pixel2catch.evaluation.loading import camera_remark, task_of

        task = self.change(task_of(policy, physics_hz, self.dynamics, self.camera), command)
        for remark in camera_remark(policy, task):
            say(remark)
        return task


def _disturbed(options: TaskOptions, command: str, then: "Change", task: "CatchEnvCfg") -> "CatchEnvCfg":
    return then(options.change(task, command))
