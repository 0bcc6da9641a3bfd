"""Policy: the deterministic controller that training writes and every other command reads."""

import itertools
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, cast

import safetensors.torch
import torch
from safetensors import SafetensorError
from torch import Tensor, nn

from pixel2catch import files
from pixel2catch.batches import ByAgent
from pixel2catch.checks import Device, typed
from pixel2catch.errors import InvalidValueError, PolicyMismatchError
from pixel2catch.mdp.tensors import require_shapes
from pixel2catch.policy.contract import PolicyContract
from pixel2catch.shipped import is_computed

MOST_LAYERS, LARGEST_LAYER = 16, 8192  #: Of networks that are read. Source: ours; the paper has 3, of 512.
WEIGHTS_FILE = "policy.safetensors"
CONTRACT_FILE = "policy.json"

HIDDEN = (512, 256, 128)  #: Sizes of the hidden layers. Source: paper, Sec. IV-E.

INPUT_CLIP = 5.0  #: Standardised inputs are clipped to ± this many deviations. Source: release (skrl).


def build_mlp(num_inputs: int, num_outputs: int, hidden: Sequence[int] = HIDDEN) -> nn.Sequential:
    """Build a perceptron with ELU between its layers and a linear output. Source: paper, Sec. IV-E."""
    sizes = [num_inputs, *hidden]
    layers: list[nn.Module] = []
    for size, next_size in itertools.pairwise(sizes):
        layers += [nn.Linear(size, next_size), nn.ELU()]
    return nn.Sequential(*layers, nn.Linear(sizes[-1], num_outputs))


class AgentNetwork(nn.Module):
    """Mean action of one agent: standardised, clipped inputs through a perceptron."""

    input_mean: Tensor
    input_std: Tensor

    def __init__(self, num_inputs: int, num_outputs: int, hidden: Sequence[int] = HIDDEN) -> None:
        super().__init__()
        self.register_buffer("input_mean", torch.zeros(num_inputs))
        self.register_buffer("input_std", torch.ones(num_inputs))
        self.network = build_mlp(num_inputs, num_outputs, hidden)

    def forward(self, observation: Tensor) -> Tensor:
        """Return the unclipped mean action, (num_envs, num_outputs), for (num_envs, num_inputs).

        Annotations of these shapes would fix num_envs when the network is exported.
        """
        standardised = (observation - self.input_mean) / self.input_std
        return self.network(standardised.clamp(-INPUT_CLIP, INPUT_CLIP))


class Policy(nn.Module):
    """Networks, input statistics and contract of all agents of one method.

    Example:
        policy = Policy.load(Path("runs/proposed/policy"))
        actions = policy.act({"arm": arm_observation, "hand": hand_observation})
    """

    def __init__(self, contract: PolicyContract, hidden: Sequence[int] = HIDDEN) -> None:
        """Build untrained networks that fit the contract."""
        super().__init__()
        self.contract, self.hidden = contract, tuple(hidden)
        self.agents = nn.ModuleDict(
            {
                name: AgentNetwork(agent.num_inputs, len(agent.joints), hidden)
                for name, agent in contract.agents.items()
            }
        )

    def network(self, agent: str) -> AgentNetwork:
        return cast(AgentNetwork, self.agents[agent])

    @torch.no_grad()
    def act(self, observations: ByAgent) -> ByAgent:
        """Return the mean action of every agent, (num_envs, num_joints), clipped to [-1, 1]."""
        try:  # the index fails without the row of environments
            given = {name: observations[name].float()[:, :] for name in self.agents}
            return {name: agent(given[name]).clamp(-1.0, 1.0) for name, agent in self.agents.items()}
        except (AttributeError, IndexError, KeyError, RuntimeError, TypeError):
            shapes = {name: (None, agent.num_inputs) for name, agent in self.contract.agents.items()}
            require_shapes("observation", observations, shapes)
            raise

    @property
    def description(self) -> str:
        """Return the contract and the sizes of the networks as JSON."""
        return json.dumps({"hidden": list(self.hidden), **self.contract.to_dict()}, indent=2) + "\n"

    def save(self, folder: Path) -> None:
        """Write `policy.safetensors` and `policy.json` into a folder, both or neither."""
        text = self.description
        tensors = {name: tensor.detach().cpu().contiguous() for name, tensor in self.state_dict().items()}
        weights = safetensors.torch.save(tensors, metadata={"policy": text})
        files.write_atomically({folder / WEIGHTS_FILE: weights, folder / CONTRACT_FILE: text.encode()})

    @classmethod
    @typed
    def load(cls, folder: str | Path, device: Device = "cpu") -> "Policy":
        """Read what `save` wrote; raise PolicyMismatchError if it does not fit this code."""
        if is_computed(folder := Path(folder)):
            raise PolicyMismatchError(f"policy '{folder}' has no networks to go on from; give a trained one.")
        fix = f"It needs {WEIGHTS_FILE} and {CONTRACT_FILE}, both of one save; train again, or restore both."
        with files.reading("policy", folder, fix, PolicyMismatchError):
            return cls.of(*_read(folder)).to(device).eval()

    @classmethod
    def of(cls, description: dict[str, Any], tensors: dict[str, Tensor]) -> "Policy":
        """Make a policy of its description and weights; raise InvalidValueError or PolicyMismatchError."""
        if "hidden" not in description:
            raise InvalidValueError("field 'hidden' is missing")
        contract = {key: value for key, value in description.items() if key != "hidden"}
        hidden = files.decoded(tuple[int, ...], description["hidden"], "hidden")
        if len(hidden) > MOST_LAYERS or not all(1 <= size <= LARGEST_LAYER for size in hidden):
            raise InvalidValueError(
                f"hidden layers are of sizes {files.shown(hidden)}; they must be from 1 to {LARGEST_LAYER}, "
                f"in {MOST_LAYERS} layers at most"
            )
        with torch.device("meta"):  # sizes are checked before memory is allocated
            policy = cls(PolicyContract.from_dict(contract), hidden)
        try:
            policy.load_state_dict(tensors, assign=True)
        except RuntimeError as error:
            raise InvalidValueError(f"weights do not fit the description: {error}") from error
        for name, tensor in tensors.items():
            if tensor.dtype != torch.float32 or not tensor.isfinite().all():
                raise InvalidValueError(f"tensor '{name}' has numbers that are not finite, or no 32-bit ones")
            if name.endswith("input_std") and not (tensor > 0.0).all():
                raise InvalidValueError(f"tensor '{name}' must have standard deviations greater than 0")
        return policy


def _read(folder: Path) -> tuple[dict[str, Any], dict[str, Tensor]]:
    text = files.read_text(folder / CONTRACT_FILE)
    description, data = files.json_object(text), files.read_bytes(folder / WEIGHTS_FILE, files.MOST_WEIGHTS)
    try:
        tensors = safetensors.torch.load(data)
    except SafetensorError as error:
        raise InvalidValueError(f"{WEIGHTS_FILE} is damaged: {error}") from error
    header = files.json_object(data[8 : 8 + int.from_bytes(data[:8], "little")].decode())
    if header.get("__metadata__", {}).get("policy") != text:
        raise InvalidValueError(f"{CONTRACT_FILE} and {WEIGHTS_FILE} are not of the same save")
    return description, tensors
