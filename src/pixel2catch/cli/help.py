"""How options are shown in help."""

from dataclasses import is_dataclass, replace
from typing import Annotated, Any, get_args

import tyro
from tyro.constructors import ConstructorRegistry, StructConstructorSpec, StructFieldSpec, StructTypeInfo


def plain_help() -> ConstructorRegistry:
    """Rules that show no default where an option is just not given, and two flags where one is needed.

    A flag that is off has no counterpart; one that is on has its negation beside it.
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
        return replace(spec, fields=tuple(map(_shown, spec.fields)))

    return registry


def _shown(field: StructFieldSpec) -> StructFieldSpec:
    """A field with what its help needs."""
    kind: Any = field.type
    if field.default is False:
        kind = tyro.conf.FlagCreatePairsOff[kind]
    has_hint = any(getattr(each, "help_behavior_hint", None) for each in get_args(kind))
    if not has_hint and (field.default in (None, ()) or field.default is False):
        kind = Annotated[kind, tyro.conf.arg(help_behavior_hint="")]
    return replace(field, type=kind)
