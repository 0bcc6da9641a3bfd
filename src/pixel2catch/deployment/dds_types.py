"""ROS messages as DDS knows them: their names, their description for discovery, and samples that stay bytes.

cyclonedds would take 36 ms to encode an image by its description; here that is only announced, and messages
pass as they are (`messages` encodes and decodes them).
"""

from functools import cache
from typing import Any

from cyclonedds.idl import make_idl_struct, types
from rosbags.interfaces import Nodetype
from rosbags.typesys.store import Typestore

from pixel2catch.deployment.cdr import STORE

PLAIN_TYPES = {
    "bool": bool,
    "string": str,
    "byte": types.byte,
    "char": types.uint8,
    "float32": types.float32,
    "float64": types.float64,
} | {f"{sign}int{bits}": getattr(types, f"{sign}int{bits}") for sign in ("", "u") for bits in (8, 16, 32, 64)}
"""The types of fields that are no messages. Source: ROS 2's mapping to IDL."""


@cache
def dds_type(name: str, store: Typestore = STORE) -> Any:
    """Describe a message to DDS: `sensor_msgs/msg/Image` is `sensor_msgs::msg::dds_::Image_`.

    Args:
        name: ROS type.
        store: Where it is defined.

    Returns:
        A type of cyclonedds, made from bytes, which are its attribute `cdr`.
    """
    package, kind, short = name.split("/")
    fields = {field: _field_type(description, store) for field, description in store.fielddefs[name][1]}
    made: Any = make_idl_struct(f"{short}_", f"{package}.{kind}.dds_.{short}_", fields, dataclassify=False)
    # Not by a base class: DDS would announce that as a base of the message.
    made.__init__ = _take_bytes
    made.serialize = _give_bytes
    made.deserialize = classmethod(_of_bytes)
    made.deserialize_key = classmethod(_of_bytes)
    return made


def _take_bytes(sample: Any, cdr: bytes) -> None:
    sample.cdr = cdr


def _give_bytes(sample: Any, **_: Any) -> bytes:
    return sample.cdr


def _of_bytes(kind: Any, data: bytes, **_: Any) -> Any:
    return kind(data)


def type_hash(name: str) -> bytes:
    """What an endpoint says of its message's definition, so that ROS 2 (from Jazzy on) can compare."""
    return f"typehash={STORE.hash_rihs01(name)};".encode()


def _field_type(description: Any, store: Typestore) -> Any:
    kind, content = description
    if kind == Nodetype.BASE:
        return PLAIN_TYPES[content[0]]
    if kind == Nodetype.NAME:
        return dds_type(content, store)
    if kind == Nodetype.ARRAY:
        return types.array[_field_type(content[0], store), content[1]]
    return types.sequence[_field_type(content[0], store)]
