"""The networks of policies and value functions."""

import itertools
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn

HIDDEN = (512, 256, 128)  #: Sizes of the hidden layers of every network. Source: paper, Sec. IV-E.

INPUT_CLIP = 5.0
"""Standardised inputs are clipped to ± this many standard deviations. Source: release (skrl)."""


def build_mlp(num_inputs: int, num_outputs: int, hidden: Sequence[int] = HIDDEN) -> nn.Sequential:
    """Build a multi-layer perceptron with ELU between its layers and a linear output.

    Source: paper, Sec. IV-E.
    """
    sizes = [num_inputs, *hidden]
    layers: list[nn.Module] = []
    for size, next_size in itertools.pairwise(sizes):
        layers += [nn.Linear(size, next_size), nn.ELU()]
    return nn.Sequential(*layers, nn.Linear(sizes[-1], num_outputs))


def recall(gru: nn.GRUCell | None, inputs: Tensor, hidden_state: Tensor) -> tuple[Tensor, Tensor]:
    """Return what the hidden layers see, and the new hidden state.

    Args:
        gru: A gated recurrent unit before the hidden layers, which see the inputs themselves without one.
        inputs: Standardised, clipped inputs, (num_envs, num_inputs).
        hidden_state: What the unit remembers, (num_envs, size); zeros at the first step of an episode.
    """
    if gru is None:
        return inputs, hidden_state
    hidden_state = gru(inputs, hidden_state)
    return hidden_state, hidden_state


class AgentNetwork(nn.Module):
    """Mean action of one agent: standardised, clipped inputs through a GRU, if any, and a perceptron."""

    input_mean: Tensor
    input_std: Tensor

    def __init__(
        self, num_inputs: int, num_outputs: int, hidden: Sequence[int] = HIDDEN, recurrent: int = 0
    ) -> None:
        """Build the network with neutral input statistics (mean 0, standard deviation 1)."""
        super().__init__()
        self.register_buffer("input_mean", torch.zeros(num_inputs))
        self.register_buffer("input_std", torch.ones(num_inputs))
        self.gru = nn.GRUCell(num_inputs, recurrent) if recurrent else None
        self.network = build_mlp(recurrent or num_inputs, num_outputs, hidden)

    def forward(
        self,
        observation: Float[Tensor, "num_envs num_inputs"],
        hidden_state: Float[Tensor, "num_envs recurrent"],
    ) -> tuple[Float[Tensor, "num_envs num_outputs"], Float[Tensor, "num_envs recurrent"]]:
        """Return the unclipped mean action and the new hidden state: see `recall`."""
        standardised = (observation - self.input_mean) / self.input_std
        features, hidden_state = recall(self.gru, standardised.clamp(-INPUT_CLIP, INPUT_CLIP), hidden_state)
        return self.network(features), hidden_state
