"""Warp's arrays carry their element types only at run time: everything is untyped here."""

from typing import Any

def __getattr__(name: str) -> Any: ...
