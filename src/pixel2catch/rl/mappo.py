"""Builds skrl's MAPPO from a configuration and the sizes of an environment."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium import Space
from gymnasium.spaces import Box
from skrl.multi_agents.torch.mappo import MAPPO_CFG

from pixel2catch.rl.config import TrainCfg
from pixel2catch.rl.environment import Environment
from pixel2catch.rl.graph_mappo import GraphMAPPO
from pixel2catch.rl.memory import RolloutMemory
from pixel2catch.rl.models import GaussianPolicy, ValueFunction
from pixel2catch.rl.scaling import JointScaler
from pixel2catch.rl.workers import Workers


def build_mappo(cfg: TrainCfg, env: Environment, workers: Workers) -> GraphMAPPO:
    """Build models, memories and the learner; one agent is as good as two.

    skrl writes no files here, and its own tracking of rewards, which waits for the device at every step, is
    off: both hang on the write and checkpoint intervals.
    """
    agents = list(env.action_sizes)
    observation_spaces = {agent: _unbounded(env.observation_sizes[agent]) for agent in agents}
    state_spaces = {agent: _unbounded(env.state_size) for agent in agents}
    action_spaces = {agent: _unbounded(env.action_sizes[agent]) for agent in agents}
    models = {
        agent: {
            "policy": GaussianPolicy(cfg, observation_spaces[agent], action_spaces[agent]),
            "value": ValueFunction(cfg, state_spaces[agent], action_spaces[agent]),
        }
        for agent in agents
    }
    memory_size = {"memory_size": cfg.rollout_steps, "num_envs": env.num_envs, "device": cfg.device}
    mappo = GraphMAPPO(
        cfg,
        workers,
        possible_agents=agents,
        models=models,
        memories={agent: RolloutMemory(**memory_size) for agent in agents},
        observation_spaces=observation_spaces,
        state_spaces=state_spaces,
        action_spaces=action_spaces,
        device=cfg.device,
        cfg=_mappo_cfg(observation_spaces, state_spaces, {"device": cfg.device, "workers": workers}),
    )
    mappo.init()
    mappo.enable_training_mode(True)
    return mappo


def _unbounded(size: int) -> Space[Any]:
    return Box(-np.inf, np.inf, (size,), dtype=np.float32)


def _mappo_cfg(
    observation_spaces: Mapping[str, Space[Any]],
    state_spaces: Mapping[str, Space[Any]],
    scaler: Mapping[str, Any],
) -> MAPPO_CFG:
    """Translate the configuration.

    Every `…_kwargs` is given by agent: skrl takes an empty dictionary for one whose agents are missing.
    `rollouts` is 1 because the loop calls `post_interaction` once a rollout, when the memory is full. What
    only skrl's own update would read is left out.
    """
    return MAPPO_CFG(
        rollouts=1,
        learning_rate_scheduler_kwargs={agent: {} for agent in observation_spaces},
        observation_preprocessor=JointScaler,
        observation_preprocessor_kwargs={
            agent: {**scaler, "size": space} for agent, space in observation_spaces.items()
        },
        state_preprocessor=JointScaler,
        state_preprocessor_kwargs={agent: {**scaler, "size": space} for agent, space in state_spaces.items()},
        value_preprocessor=JointScaler,
        value_preprocessor_kwargs={agent: {**scaler, "size": 1} for agent in observation_spaces},
        time_limit_bootstrap=False,
        experiment={"write_interval": 0, "checkpoint_interval": 0},  # pyright: ignore[reportArgumentType]
    )
