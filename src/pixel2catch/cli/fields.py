"""How the fields of commands become options; those of the task, `--env.sensing.latency-steps 1 3`, too."""

import dataclasses
import re
from collections.abc import Sequence
from dataclasses import is_dataclass, replace
from functools import partial
from itertools import takewhile
from typing import TYPE_CHECKING, Annotated, Any, get_args, get_origin

import tyro
from tyro.constructors import ConstructorRegistry, StructConstructorSpec, StructFieldSpec, StructTypeInfo

from pixel2catch.checks import CameraPath, DynamicsPath
from pixel2catch.cli.console import say
from pixel2catch.errors import InvalidValueError

if TYPE_CHECKING:
    from pixel2catch.envs.cfg import CatchEnvCfg
    from pixel2catch.evaluation.stress import Change, Setting
    from pixel2catch.policy import Policy

TASK_MODULES = ("pixel2catch.envs", "pixel2catch.mdp", "pixel2catch.scene", "pixel2catch.camera")
"""Where the classes of the task's fields are."""

FIXED = {"CatchEnvCfg": "dynamics", "SceneCfg": "camera visuals object_friction object_restitution"}
"""Fields that are no options, by their classes: another option gives them, or they do nothing in a task."""

LOSSES = (
    *("schedule", "kl_target", "discount", "gae_lambda", "ratio_clip", "value_clip"),
    *("value_loss_scale", "entropy_scale", "gradient_clip"),
)
"""Options of the losses and of their gradients."""
HIDDEN = (
    *LOSSES,
    *("report_seconds", "slurm", "start_transitions", "teacher_share", "final_teacher_weight"),
    *("final_learning_rate", "staggered", "checkpoint_seconds"),
)
"""Options of `train` that --help leaves out and --help-all has."""

GROUPS = {
    "task": ("task", "workcell", "dynamics", "camera", "rewards", "physics_stages"),
    "learner": (
        *("rollout_steps", "epochs", "mini_batches", "staggered", "learning_rate", "final_learning_rate"),
        *("hidden", "initial_log_std", "start", "start_transitions", *LOSSES),
    ),
    "imitation": ("teacher", "teacher_share", "final_teacher_weight"),
    "machine": ("device", "slurm", "num_envs", "fuse", "wandb", "checkpoint_seconds", "report_seconds"),
}
"""Options of `train` by the group in which its help has them; the others come first."""

GROUPED = ("Train", "TrainCfg")  #: Names of the classes whose options have these groups.


def option_rules(*, is_brief: bool = True) -> ConstructorRegistry:
    """Return tyro's rules with ours: short names, no default where there is none, plain flags, groups.

    Fields of nested option classes have no prefix, except those of the task. A flag that is off has no
    counterpart; one that is on has its negation beside it. With brief rules, `train` has no `HIDDEN` options,
    and of the help of the others only the first sentence and the default.
    """
    registry, entered, groups = ConstructorRegistry(), list[Any](), dict[Any, StructConstructorSpec]()

    @registry.struct_rule
    def rule(info: StructTypeInfo) -> StructConstructorSpec | None:
        if info.type in groups:
            return groups[info.type]
        if not is_dataclass(info.type) or info.type in entered:
            return None
        entered.append(info.type)
        try:
            spec = ConstructorRegistry.get_struct_spec(info)
        finally:
            entered.pop()
        if not isinstance(spec, StructConstructorSpec):
            return None
        is_task = info.type.__module__.startswith(TASK_MODULES)
        fixed = FIXED.get(info.type.__name__, "").split()
        fields = tuple(_option(field, is_task, field.name in fixed) for field in spec.fields)
        if info.type.__name__ not in GROUPED:
            return replace(spec, fields=fields)
        fields = tuple(map(_brief, fields)) if is_brief else fields
        return _grouped(replace(spec, fields=fields), groups)

    return registry


def _option(field: StructFieldSpec, is_task: bool, is_fixed: bool) -> StructFieldSpec:
    """Return a field with its name and help as an option."""
    kind: Any = field.type
    if is_fixed or (field.name == "env" and field.default is None):
        return replace(field, type=tyro.conf.Suppress[tyro.conf.Fixed[kind]])
    declared = get_args(kind)[0] if get_origin(kind) is Annotated else kind
    is_nested = is_dataclass(field.default) or is_dataclass(declared)
    if is_nested and field.name != "env" and not is_task:
        return replace(field, type=Annotated[kind, tyro.conf.arg(name="")])
    if field.default is False:
        kind = tyro.conf.FlagCreatePairsOff[kind]
    hint = "" if field.default in (None, (), {}) or field.default is False else None
    kind = Annotated[kind, tyro.conf.arg(help_behavior_hint=hint, prefix_name=is_task)]
    return replace(field, type=kind)


def _brief(field: StructFieldSpec) -> StructFieldSpec:
    """Return an option with the first sentence of its help and the default; hide those of `HIDDEN`."""
    kind: Any = tyro.conf.Suppress[field.type] if field.name in HIDDEN else field.type
    text = field.helptext() if callable(field.helptext) else field.helptext
    first, *others = re.split(r"(?<=\.)\s+(?=[A-Z])", text or "")
    shown = [first, *(each for each in others if each.startswith("Default:"))]
    return replace(field, type=kind, helptext=" ".join(shown))


def _grouped(spec: StructConstructorSpec, groups: dict[Any, StructConstructorSpec]) -> StructConstructorSpec:
    """Return a specification whose fields are in classes of their own, by `GROUPS`, added to `groups`."""
    title_of = {name: title for title, names in GROUPS.items() for name in names}
    parts: dict[str, list[StructFieldSpec]] = {}
    for field in spec.fields:
        parts.setdefault(title_of.get(field.name, ""), []).append(field)
    fields = []
    for title in (each for each in GROUPS if each in parts):
        kind: Any = type(title, (), {})
        groups[kind] = StructConstructorSpec(instantiate=dict, fields=tuple(parts[title]))
        kind = Annotated[kind, tyro.conf.arg(name=title, prefix_name=False)]
        fields.append(StructFieldSpec(name=f"{title} options", type=kind, default=tyro.MISSING, helptext=""))

    def instantiate(**values: Any) -> Any:
        inner = [values.pop(name) for name in [*values] if name.endswith(" options")]
        return spec.instantiate(**values, **{key: each for part in inner for key, each in part.items()})

    return StructConstructorSpec(instantiate=instantiate, fields=(*fields, *parts[""]))


PREFIX = "--env."  #: What options that are fields of the task begin with.

OF_THE_PROTOCOL = ("name", "objects", "episode", "value_sees_parameters")  #: Not from --env in evaluations.

TaskFields = tyro.conf.FlagConversionOff[tyro.conf.AvoidSubcommands[Any]]
"""Type of a field for a `CatchEnvCfg`: tyro takes the fields of the default instance. None has no options."""

Given = tyro.conf.Suppress[tyro.conf.Fixed[tuple[str, ...]]]
"""Names of the fields of the task that are given."""


def given_options(args: Sequence[str]) -> list[tuple[str, list[str]]]:
    """Return options with what stands behind each; as for the parser, `_` is `-`, and `--` ends them."""
    found: list[tuple[str, list[str]]] = []
    for arg in takewhile(lambda arg: arg != "--", args):
        if arg.startswith("--"):
            name, sign, value = arg.partition("=")
            found.append((name.replace("_", "-"), [value] if sign else []))
        elif found:
            found[-1][1].append(arg)
    return found


def require_once(args: Sequence[str]) -> None:
    """Raise InvalidValueError for an option that is given twice, or a reward term."""
    options = [option for option in given_options(args) if option[0] != "--sweep"]
    terms = [term for name, values in options if name == "--rewards" for term in values[::2]]
    names = [name for name, _ in options] + terms
    if twice := next((name for name in names if names.count(name) > 1), None):
        raise InvalidValueError(f"{twice} is given twice; leave out one of them.")


def default_of(command: Any, args: Sequence[str]) -> Any:
    """Return the instance of a command whose values hold where options are not given; None for its own.

    A command with an attribute `default_for` makes it from the arguments. Where fields of the task are given,
    the `SimulatedTask` of another command has the paper's task.
    """
    if hasattr(command, "default_for"):
        return command.default_for(args)
    options = (name for name, _ in given_options(args) if name.startswith(PREFIX))
    given = tuple(name.removeprefix(PREFIX).replace("-", "_") for name in options)
    if not given or SimulatedTask not in (field.default_factory for field in dataclasses.fields(command)):
        return None
    from pixel2catch.envs.cfg import CatchEnvCfg

    return command(task=SimulatedTask(env=CatchEnvCfg(), given=given))


def with_given(task: Any, source: Any, given: Sequence[str]) -> Any:
    """Return a configuration with the given fields (dotted names) of another one."""
    parts: dict[str, list[str]] = {}
    for name in given:
        first, _, rest = name.partition(".")
        parts.setdefault(first, []).append(rest)
    values = {}
    for name, inner in parts.items():
        old, new = getattr(task, name), getattr(source, name)
        is_whole = "" in inner or not is_dataclass(old)
        values[name] = new if is_whole else with_given(old, new, inner)
    return replace(task, **values)


@dataclasses.dataclass(frozen=True, kw_only=True)
class SimulatedTask:
    """What is simulated."""

    #: Any field of the task, such as --env.throws.peak-z 1.5 1.9. All fields: --env.help.
    env: TaskFields = None
    given: Given = ()  #: Which of them are given.
    #: Dynamics file of the robot that is simulated, as `identify` writes it. Default: the nominal robot, also
    #: for a policy that was trained with a dynamics file.
    dynamics: DynamicsPath | None = None
    #: Camera file of the camera that is simulated, as `calibrate` writes it: what that camera would do to the
    #: policy. Default: the camera that the policy was trained for, known exactly.
    camera: CameraPath | None = None

    def change(self, task: "CatchEnvCfg") -> "CatchEnvCfg":
        """Return the task with the files' robot and camera, and the given fields.

        Raises:
            InvalidValueError: The protocol of evaluations sets a given field itself, or the work cell has
                other joints than the policy's.
        """
        for name in self.given:
            if name.partition(".")[0] in OF_THE_PROTOCOL:
                raise InvalidValueError(f"the policy and --objects set --env.{name}; leave it out.")
        from pixel2catch.workcells import find_workcell

        task = task.with_files(self.dynamics, self.camera)
        changed = with_given(task, self.env, self.given)
        ours, theirs = (find_workcell(each.scene.workcell) for each in (task, changed))
        if ours.joint_names != theirs.joint_names:
            raise InvalidValueError(
                f"the joints of work cell '{theirs.name}' are not the policy's, those of '{ours.name}'; "
                "leave out --env.scene.workcell, or give a work cell with the same joints."
            )
        return replace(changed, scene=replace(changed.scene, camera=changed.sensing.camera.camera))

    def beneath(self, setting: "Setting") -> "Setting":
        """Return a setting that disturbs the changed task."""
        change = partial(self._disturbed, setting.level.change)
        return replace(setting, level=replace(setting.level, change=change))

    def _disturbed(self, then: "Change", task: "CatchEnvCfg") -> "CatchEnvCfg":
        return then(self.change(task))

    def make(self, policy: "Policy", name: str = "") -> "CatchEnvCfg":
        """Return the task in which a policy acts; print what its camera means, behind a name."""
        from pixel2catch.evaluation.loading import camera_remark, task_of

        task = self.change(task_of(policy))
        for remark in camera_remark(policy, task):
            say(f"{name}{remark}")
        return task
