"""How the fields of commands become options, and how help shows them."""

from dataclasses import is_dataclass, replace
from typing import Annotated, Any, get_args, get_origin

import tyro
from tyro.constructors import ConstructorRegistry, StructConstructorSpec, StructFieldSpec, StructTypeInfo

TASK_MODULES = ("pixel2catch.envs", "pixel2catch.mdp", "pixel2catch.scene", "pixel2catch.camera")
"""Where the classes of the task's fields are."""


def option_rules() -> ConstructorRegistry:
    """Return tyro's rules with ours: short names, no default where there is none, plain flags.

    Fields of nested option classes have no prefix, except those of the task. A flag that is off has no
    counterpart; one that is on has its negation beside it.
    """
    registry, entered = ConstructorRegistry(), list[Any]()

    @registry.struct_rule
    def rule(info: StructTypeInfo) -> StructConstructorSpec | None:
        if not is_dataclass(info.type) or info.type in entered:
            return None
        entered.append(info.type)
        try:
            spec = ConstructorRegistry.get_struct_spec(info)
        finally:
            entered.pop()
        if not isinstance(spec, StructConstructorSpec):
            return None
        is_task = any(part in info.type.__module__ for part in TASK_MODULES)
        return replace(spec, fields=tuple(_option(field, is_task) for field in spec.fields))

    return registry


def _option(field: StructFieldSpec, is_task: bool) -> StructFieldSpec:
    """Return a field with its name and help as an option."""
    kind: Any = field.type
    if (field.name == "dynamics" and is_task) or (field.name == "env" and field.default is None):
        return replace(field, type=tyro.conf.Suppress[tyro.conf.Fixed[kind]])
    declared = get_args(kind)[0] if get_origin(kind) is Annotated else kind
    is_nested = is_dataclass(field.default) or is_dataclass(declared)
    if is_nested and field.name != "env" and not is_task:
        return replace(field, type=Annotated[kind, tyro.conf.arg(name="")])
    if field.default is False:
        kind = tyro.conf.FlagCreatePairsOff[kind]
    if field.default in (None, (), {}) or field.default is False:
        kind = Annotated[kind, tyro.conf.arg(help_behavior_hint="")]
    return replace(field, type=kind)
