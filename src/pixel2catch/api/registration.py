"""The environment of Gymnasium's registry: `gymnasium.make("pixel2catch/Catch-v1", task="wide")`.

Gymnasium imports this module by the package's entry point, and fills the rest in when it makes one.
"""

from typing import TYPE_CHECKING, Any

from gymnasium.envs.registration import register

if TYPE_CHECKING:
    from pixel2catch.api.views import CatchSingleEnv, CatchVectorEnv

ENVIRONMENT = "pixel2catch/Catch-v1"


def single(render_mode: str | None = None, method: str = "single_agent", **options: Any) -> "CatchSingleEnv":
    """Return one robot; options are those of `pixel2catch.make`."""
    from pixel2catch import CatchSingleEnv, make

    return CatchSingleEnv(make(method, **options), render_mode)


def vector(render_mode: str | None = None, method: str = "single_agent", **options: Any) -> "CatchVectorEnv":
    """Return robots side by side, for `gymnasium.make_vec`; likewise."""
    from pixel2catch import CatchVectorEnv, make

    return CatchVectorEnv(make(method, **options), render_mode)


def register_all() -> None:
    """Add the environment to Gymnasium's registry."""
    register(ENVIRONMENT, entry_point=single, vector_entry_point=vector)
