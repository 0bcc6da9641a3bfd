"""Catch thrown objects with an arm and a hand from one RGB camera: what other Python code builds on.

    import pixel2catch as p2c

    env = p2c.make("proposed", num_envs=64)
    policy = p2c.load_policy("proposed")
    actions = policy.act(env.reset().policy)

Everything is imported where it is first used: `import pixel2catch` alone loads nothing.
"""

import ast
import os
import sys
from pathlib import Path
from types import FunctionType
from typing import TYPE_CHECKING, Any

#: Whether idle threads of PyTorch, which was imported before, wait in a loop; see `api.threads`.
WAITS_IN_A_LOOP = "torch" in sys.modules and "OMP_WAIT_POLICY" not in os.environ

# Idle threads of PyTorch, which reads this when imported, sleep: in a loop they take the cores from physics.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

if TYPE_CHECKING:
    from pixel2catch.agents import (
        AgentSpec as AgentSpec,
        agents_of as agents_of,
        sharing as sharing,
        together as together,
    )
    from pixel2catch.api.calls import (
        evaluate as evaluate,
        load_policy as load_policy,
        make as make,
        train as train,
    )
    from pixel2catch.api.views import (
        CatchParallelEnv as CatchParallelEnv,
        CatchSingleEnv as CatchSingleEnv,
        CatchVectorEnv as CatchVectorEnv,
    )
    from pixel2catch.camera.pinhole import nominal_projection as nominal_projection
    from pixel2catch.envs import actuators as actuators, world as world
    from pixel2catch.envs.catch_env import CatchEnv as CatchEnv
    from pixel2catch.envs.cfg import CatchEnvCfg as CatchEnvCfg
    from pixel2catch.envs.tasks import find_task as find_task
    from pixel2catch.errors import Pixel2CatchError as Pixel2CatchError
    from pixel2catch.evaluation.loading import task_of as task_of
    from pixel2catch.evaluation.protocol import EvaluationCfg as EvaluationCfg, run_round as run_round
    from pixel2catch.evaluation.stress import Axis as Axis, Level as Level
    from pixel2catch.learning.experiment import Experiment as Experiment, preset as preset
    from pixel2catch.mdp import observations as observations, terminations as terminations
    from pixel2catch.mdp.rewards import RewardTerm as RewardTerm
    from pixel2catch.methods import Method as Method, find_method as find_method
    from pixel2catch.policy.contract import method_of as method_of
    from pixel2catch.policy.policy import INPUT_CLIP as INPUT_CLIP, Policy as Policy
    from pixel2catch.rendering.renderer import Renderer as Renderer
    from pixel2catch.robots.geometry import chain_of as chain_of
    from pixel2catch.robots.workcell import WorkcellSpec as WorkcellSpec
    from pixel2catch.scene import constants as constants
    from pixel2catch.scene.cfg import PUSH_OUT as PUSH_OUT
    from pixel2catch.scene.meshes import mesh_object as mesh_object
    from pixel2catch.scene.objects import (
        OBJECTS as OBJECTS,
        SEEN as SEEN,
        UNSEEN as UNSEEN,
        make_object as make_object,
        surface_points as surface_points,
    )
    from pixel2catch.scene.scene import build_model as build_model, build_spec as build_spec
    from pixel2catch.workcells import find_workcell as find_workcell

_WHERE = {
    alias.name: node.module
    for node in ast.walk(ast.parse(Path(__file__).read_text("utf-8")))
    if isinstance(node, ast.ImportFrom) and str(node.module).startswith("pixel2catch.")
    for alias in node.names
}
"""Module of each name that is imported above, or package of each module."""

__all__ = [*_WHERE]  # pyright: ignore[reportUnsupportedDunderAll] (it reads the imports above)


def __getattr__(name: str) -> Any:
    """Import the module that defines a name; a function gets a check of its arguments."""
    if name not in _WHERE:
        raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
    try:
        value = getattr(__import__(str(_WHERE[name]), fromlist=[name]), name)
    except (AttributeError, ImportError, RuntimeError) as error:
        if "MUJOCO_GL" not in os.environ or "mujoco" in sys.modules:
            raise
        fault = f"MUJOCO_GL is '{os.environ['MUJOCO_GL']}', with which MuJoCo cannot be imported: unset it."
        raise RuntimeError(fault) from error
    if isinstance(value, FunctionType):
        from pixel2catch import checks

        value = checks.typed(value)
        value.__module__ = __name__  # where pickle finds it
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """What there is, imported or not."""
    return sorted({*globals(), *__all__})
