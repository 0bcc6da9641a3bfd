"""Imports skrl as a single process does; to be imported before anything else that imports skrl.

In a process that torchrun started, importing skrl starts a process group, over NCCL on whatever device. The
group here is that of `workers.py`; skrl is told nothing of it.
"""

import importlib
import os

WORLD_SIZE = "WORLD_SIZE"
"""Where torchrun writes the number of processes, and skrl reads it. Source: skrl (`skrl/__init__.py`)."""

_world_size = os.environ.pop(WORLD_SIZE, None)
try:
    importlib.import_module("skrl")
finally:
    if _world_size is not None:
        os.environ[WORLD_SIZE] = _world_size
