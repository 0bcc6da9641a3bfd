"""Catch thrown objects with an arm and a hand from one RGB camera: what other Python code builds on.

    import pixel2catch as p2c

    env = p2c.make("proposed", num_envs=64)
    policy = p2c.load_policy("proposed-seed0")
    actions = policy.act(env.reset().policy)

Everything is imported where it is first used: `import pixel2catch` alone loads nothing.
"""

import importlib
import os
import sys
from typing import TYPE_CHECKING, Any

#: Whether idle threads of PyTorch, which was imported before, wait in a loop; see `api.calls`.
WAITS_IN_A_LOOP = "torch" in sys.modules and "OMP_WAIT_POLICY" not in os.environ

# PyTorch's idle threads sleep: in a loop they would take the cores from physics.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

if TYPE_CHECKING:
    from pixel2catch.agents import AgentSpec, agents_of, sharing, together
    from pixel2catch.api.calls import evaluate, load_policy, make, train
    from pixel2catch.api.parallel import CatchParallelEnv
    from pixel2catch.api.vector import CatchSingleEnv, CatchVectorEnv
    from pixel2catch.camera.pinhole import nominal_projection
    from pixel2catch.envs import actuators, world
    from pixel2catch.envs.catch_env import CatchEnv
    from pixel2catch.envs.cfg import CatchEnvCfg
    from pixel2catch.envs.tasks import find_task
    from pixel2catch.errors import Pixel2CatchError
    from pixel2catch.evaluation.loading import task_of
    from pixel2catch.evaluation.stress.suite import Axis, Level
    from pixel2catch.learning.experiment import Experiment, preset
    from pixel2catch.mdp import observations, terminations
    from pixel2catch.mdp.rewards import RewardTerm
    from pixel2catch.methods import Method, find_method
    from pixel2catch.policy.policy import INPUT_CLIP, Policy
    from pixel2catch.robots.geometry import chain_of
    from pixel2catch.robots.workcell import WorkcellSpec
    from pixel2catch.scene import constants
    from pixel2catch.scene.cfg import PUSH_OUT
    from pixel2catch.scene.meshes import mesh_object
    from pixel2catch.scene.objects import OBJECTS, SEEN, UNSEEN, make_object, surface_points
    from pixel2catch.scene.scene import build_spec
    from pixel2catch.workcells import find_workcell

_WHERE = {
    "agents": ("AgentSpec", "agents_of", "sharing", "together"),
    "api.calls": ("evaluate", "load_policy", "make", "train"),
    "api.parallel": ("CatchParallelEnv",),
    "api.vector": ("CatchSingleEnv", "CatchVectorEnv"),
    "camera.pinhole": ("nominal_projection",),
    "envs.catch_env": ("CatchEnv",),
    "envs.cfg": ("CatchEnvCfg",),
    "envs.tasks": ("find_task",),
    "errors": ("Pixel2CatchError",),
    "evaluation.loading": ("task_of",),
    "evaluation.stress.suite": ("Axis", "Level"),
    "learning.experiment": ("Experiment", "preset"),
    "mdp.rewards": ("RewardTerm",),
    "methods": ("Method", "find_method"),
    "policy.policy": ("INPUT_CLIP", "Policy"),
    "robots.geometry": ("chain_of",),
    "robots.workcell": ("WorkcellSpec",),
    "scene.cfg": ("PUSH_OUT",),
    "scene.meshes": ("mesh_object",),
    "scene.objects": ("OBJECTS", "SEEN", "UNSEEN", "make_object", "surface_points"),
    "scene.scene": ("build_spec",),
    "workcells": ("find_workcell",),
}
_MODULES = {
    "actuators": "envs.actuators",
    "constants": "scene.constants",
    "observations": "mdp.observations",
    "terminations": "mdp.terminations",
    "world": "envs.world",
}
"""Modules with the constants that another implementation of the environment needs."""

__all__ = [
    "INPUT_CLIP",
    "OBJECTS",
    "PUSH_OUT",
    "SEEN",
    "UNSEEN",
    "AgentSpec",
    "Axis",
    "CatchEnv",
    "CatchEnvCfg",
    "CatchParallelEnv",
    "CatchSingleEnv",
    "CatchVectorEnv",
    "Experiment",
    "Level",
    "Method",
    "Pixel2CatchError",
    "Policy",
    "RewardTerm",
    "WorkcellSpec",
    "actuators",
    "agents_of",
    "build_spec",
    "chain_of",
    "constants",
    "evaluate",
    "find_method",
    "find_task",
    "find_workcell",
    "load_policy",
    "make",
    "make_object",
    "mesh_object",
    "nominal_projection",
    "observations",
    "preset",
    "sharing",
    "surface_points",
    "task_of",
    "terminations",
    "together",
    "train",
    "world",
]


def __getattr__(name: str) -> Any:
    """Import the module that defines a name."""
    if name in _MODULES:
        return importlib.import_module(f"{__name__}.{_MODULES[name]}")
    for module, names in _WHERE.items():
        if name in names:
            return getattr(importlib.import_module(f"{__name__}.{module}"), name)
    raise AttributeError(f"module '{__name__}' has no attribute '{name}'")


def __dir__() -> list[str]:
    """What there is, imported or not."""
    return sorted({*globals(), *__all__})
