"""Looks for NaN and infinity, once a rollout, and names where they are."""

import math
from collections.abc import Mapping

import torch
from torch import Tensor

from pixel2catch.errors import NonFiniteError
from pixel2catch.policy import PolicyContract
from pixel2catch.rl.learner import Learner

REWARD_TERM = "reward_term/"
"""How the names of reward terms begin in an environment's statistics."""


def check_rollout(
    learner: Learner, contract: PolicyContract, statistics: Mapping[str, float]
) -> dict[str, float]:
    """Check what the environment gave since the last update, before the networks learn from it.

    A sum over a rollout is finite if and only if all of its terms are, as long as they are of sane size.

    Args:
        learner: What remembers the rollout.
        contract: Names and sizes of the observation terms.
        statistics: Means since the last update; those of reward terms begin with `REWARD_TERM`.

    Returns:
        The mean reward a control step, by agent.

    Raises:
        NonFiniteError: The message names the agent and the observation term, the reward term, or the
            value input.
    """
    totals: dict[str, Tensor] = {
        f"reward term '{name.removeprefix(REWARD_TERM)}'": torch.tensor(value, device=learner.cfg.device)
        for name, value in statistics.items()
        if name.startswith(REWARD_TERM) and not math.isfinite(value)
    }
    for agent in learner.agents:
        memory, mappo = learner.memories[agent], learner.mappo
        totals[f"reward of agent '{agent}'"] = memory.get_tensor_by_name("rewards").mean((0, 1))
        columns = memory.get_tensor_by_name("observations").sum((0, 1))
        for name, term in zip(*_terms(contract, agent, columns), strict=True):
            totals[f"observation term '{name}' of agent '{agent}'"] = term
        state = memory.get_tensor_by_name("states").sum((0, 1)) + mappo._current_next_states[agent].sum(0)
        totals["value input (state)"] = state
        totals[f"sampled action of agent '{agent}'"] = memory.get_tensor_by_name("actions").sum((0, 1))
    sums = _raise_if_not_finite(totals)
    return {f"reward/{agent}": sums[f"reward of agent '{agent}'"] for agent in learner.agents}


def check_update(learner: Learner, losses: Mapping[str, float]) -> None:
    """Check what an update made of the networks.

    Raises:
        NonFiniteError: The message names the agent and the loss or the network.
    """
    totals = {f"loss or metric '{name}'": torch.tensor(value) for name, value in losses.items()}
    for agent in learner.agents:
        for role, model in learner.models[agent].items():
            norm = torch.nn.utils.get_total_norm([parameter.detach() for parameter in model.parameters()])
            totals[f"parameters of the {role} network of agent '{agent}'"] = norm.cpu()
    _raise_if_not_finite(totals)


def _terms(contract: PolicyContract, agent: str, columns: Tensor) -> tuple[list[str], list[Tensor]]:
    layout = contract.agents[agent].observation
    return [name for name, _ in layout], list(columns.split([size for _, size in layout]))


def _raise_if_not_finite(totals: Mapping[str, Tensor]) -> dict[str, float]:
    """Return the totals' sums as numbers: the one wait for the device."""
    sums = torch.stack([total.sum() for total in totals.values()]).tolist()
    named = dict(zip(totals, sums, strict=True))
    bad = [name for name, total in named.items() if not torch.isfinite(torch.tensor(total))]
    if bad:
        raise NonFiniteError(
            f"NaN or infinity in {', '.join(bad)}; training stopped. "
            "The last checkpoint is from before: look at that quantity, then go on with --resume."
        )
    return named
