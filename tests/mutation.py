"""Valid files and messages, changed: by their structure, or by their bytes."""

import copy
import json
import random
from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import yaml

NUMBERS = (0, -1, 10**9, 2**63, 10**400, 0.5, -0.0, 1e308, float("nan"), float("inf"))
TEXTS = ("", "a", "/tmp/own.py", "../..", "\ud800", "\x1b[2J\n", "9" * 5000, "x" * 70_000)
LISTS = ([], {}, [None], [[0.0] * 3] * 3, {"a": 1}, list(range(1000)))
HOSTILE: tuple[Any, ...] = (None, True, *NUMBERS, *TEXTS, *LISTS)
"""What stands in the place of an entry."""

LARGE = (b"\xff" * 4, b"\xff" * 8, b"\0\0\0\x80", b"\x7f\xff\xff\xff")
WORDS = (*LARGE, b"\0" * 4, b"\0\0\0\0\0\0\xf8\x7f", b"\x01\0\0\0")
"""Lengths, offsets and numbers that stand anywhere in a binary file."""


def changed_bytes(data: bytes, rng: random.Random) -> bytes:
    """Bits flipped, words set, parts cut, doubled and moved."""
    content = bytearray(data)
    for _ in range(rng.choice((1, 1, 2, 4, 16))):
        place, size = rng.randrange(len(content) + 1), rng.choice((1, 2, 8, 64))
        match rng.randrange(6):
            case 0 if place < len(content):
                content[place] ^= 1 << rng.randrange(8)
            case 1:
                content[place : place + size] = rng.choice(WORDS)
            case 2:
                del content[place : place + size]
            case 3:
                content[place:place] = content[place : place + size]
            case 4:
                content[place : place + size] = rng.randbytes(size)
            case 5 if rng.random() < 0.3:
                del content[place:]
    return bytes(content)


def _hostile(rng: random.Random) -> Any:
    return copy.deepcopy(rng.choice(HOSTILE))


def changed_value(content: Any, rng: random.Random) -> Any:
    """An entry of lists and mappings exchanged, taken away, added or put one deeper."""
    content = copy.deepcopy(content)
    for _ in range(rng.choice((1, 1, 1, 2, 5))):
        if not (isinstance(content, dict | list) and content):
            return _hostile(rng)
        _change_entry(*_place(content, rng), rng)
    return content


def _place(holder: Any, rng: random.Random) -> tuple[Any, Any]:
    """An entry: its list or mapping, which is not empty, and its number or key."""
    key = rng.choice(list(holder)) if isinstance(holder, dict) else rng.randrange(len(holder))
    inner = holder[key]
    if not (isinstance(inner, dict | list) and inner) or rng.random() < 0.25:
        return holder, key
    return _place(inner, rng)


def _change_entry(holder: Any, key: Any, rng: random.Random) -> None:
    match rng.randrange(5):
        case 0 | 1:
            holder[key] = _hostile(rng)
        case 2:
            del holder[key]
        case 3 if isinstance(holder, dict):
            holder[rng.choice(("x", "format_version", "name"))] = _hostile(rng)
        case _:
            holder[key] = [holder[key]] if rng.random() < 0.5 else {"x": holder[key]}


def changed_json(data: bytes, rng: random.Random) -> bytes:
    """A JSON text with another content, or of another form."""
    deep, start = rng.choice((40, 900, 100_000)), data.find(b"{") + 1
    forms = [
        (b"\xef\xbb\xbf" + data, data.decode().encode("utf-16"), data.replace(b"\n", b"\r\n")),
        (b"[" * deep + b"]" * deep, b'{"a":' * deep, data[:-2] + b',"x":' + b"[" * deep),
        [data[:start] + entry + data[start:] for entry in (b'"a":1,"a":1,', b'"x":1e999,', b'"\\ud800":1,')],
    ]
    return _changed_text(data, json.loads(data), forms, rng)


def changed_yaml(data: bytes, rng: random.Random) -> bytes:
    """A YAML text with another content, or of another form."""
    bomb = b"a: &a [x, x, x]\n"
    bomb += "".join(f"{b}: &{b} [*{a}, *{a}, *{a}]\n" for a, b in pairwise("abcdefghi")).encode()
    ends = (b"\nname: again\n", b"\n---\na: 1", b"\n" + b"[" * 90_000, b"\nx: 0x" + b"f" * 9000)
    forms = [
        (bomb + data, data + bomb, b"&a [*a]"),
        (b"!!python/object/apply:os.system [id]", b"- !!timestamp x", b"? {a: 1}\n: 2", b"%TAG ! x"),
        [data + end for end in ends],
    ]
    return _changed_text(data, yaml.safe_load(data), forms, rng)


def _changed_text(data: bytes, content: Any, forms: Sequence[Sequence[bytes]], rng: random.Random) -> bytes:
    """In half of the cases other content as JSON, which is YAML; else other bytes, or another form."""
    case = rng.randrange(8)
    if case == 0:
        return changed_bytes(data, rng)
    return rng.choice(forms[case - 1]) if case <= 3 else json.dumps(changed_value(content, rng)).encode()
