"""The environment of Gymnasium's registry: `gymnasium.make("pixel2catch/Catch-v1", task="wide")`.

Gymnasium imports this module by the package's entry point, and fills the rest in when it makes one.
"""

from functools import partial
from typing import Any

from gymnasium.envs.registration import register

import pixel2catch

ENVIRONMENT = "pixel2catch/Catch-v1"


def view(kind: str, render_mode: str | None = None, method: str = "single_agent", **options: Any) -> Any:
    """Return a view of environments by its name; options are those of `pixel2catch.make`."""
    return getattr(pixel2catch, kind)(pixel2catch.make(method, **options), render_mode)


def register_all() -> None:
    """Add the environment to Gymnasium's registry: one robot, and robots side by side for `make_vec`."""
    one, several = partial(view, "CatchSingleEnv"), partial(view, "CatchVectorEnv")
    register(ENVIRONMENT, entry_point=one, vector_entry_point=several)
