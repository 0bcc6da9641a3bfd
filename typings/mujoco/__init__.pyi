"""MuJoCo's compiled modules carry no types: everything is untyped here."""

from typing import Any

def __getattr__(name: str) -> Any: ...
