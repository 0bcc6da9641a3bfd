"""The environments of a training, made anew where its physics rate changes."""

import dataclasses
from collections.abc import Callable

from pixel2catch.errors import PolicyMismatchError
from pixel2catch.policy import PolicyContract
from pixel2catch.rl.config import TrainCfg
from pixel2catch.rl.environment import Environment


class Stages:
    """The environments of the present stage.

    Attributes:
        env: The environments.
    """

    def __init__(
        self, cfg: TrainCfg, make_env: Callable[[TrainCfg], Environment], contract: PolicyContract
    ) -> None:
        """Make the environments of the first stage.

        Args:
            cfg: This process's share of the configuration.
            make_env: Makes environments; `physics_hz` of its configuration has one rate.
            contract: What the environments must fit.

        Raises:
            PolicyMismatchError: They do not fit; the message names the field.
        """
        self._cfg, self._make_env, self._contract = cfg, make_env, contract
        self._rate = cfg.rate_at(0)
        self.env = self._make()

    def enter(self, transitions: int) -> bool:
        """Be in the stage that follows this many transitions; whether the environments are new."""
        rate = self._cfg.rate_at(transitions)
        if rate == self._rate:
            return False
        self.env.close()
        self._rate = rate
        self.env = self._make()
        return True

    def close(self) -> None:
        """Close the environments."""
        self.env.close()

    def _make(self) -> Environment:
        env = self._make_env(dataclasses.replace(self._cfg, physics_hz=(self._rate,)))
        try:
            _require_fit(self._cfg, env, self._contract)
        except PolicyMismatchError:
            env.close()
            raise
        return env


def _require_fit(cfg: TrainCfg, env: Environment, contract: PolicyContract) -> None:
    sizes = {
        "num_envs": (cfg.num_envs, env.num_envs),
        "observation_sizes": (
            {name: agent.num_inputs for name, agent in contract.agents.items()},
            env.observation_sizes,
        ),
        "action_sizes": (
            {name: len(agent.joints) for name, agent in contract.agents.items()},
            env.action_sizes,
        ),
    }
    for name, (expected, found) in sizes.items():
        if expected != found:
            raise PolicyMismatchError(
                f"{name}: configuration and contract say {expected}, the environment {found}."
            )
