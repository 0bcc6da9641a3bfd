"""Policy: the deterministic controller that training writes and every other command reads."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, cast

import safetensors.torch
import torch
from jaxtyping import Bool, Float
from safetensors import SafetensorError
from torch import Tensor, nn

from pixel2catch.errors import PolicyMismatchError
from pixel2catch.files import read_json_object, write_atomically
from pixel2catch.policy.contract import PolicyContract
from pixel2catch.policy.networks import HIDDEN, AgentNetwork

WEIGHTS_FILE = "policy.safetensors"
CONTRACT_FILE = "policy.json"


class Policy(nn.Module):
    """Networks, input statistics and contract of all agents of one method.

    Example:
        policy = Policy.load(Path("runs/proposed/policy"))
        actions = policy.act({"arm": arm_observation, "hand": hand_observation})
    """

    def __init__(self, contract: PolicyContract, hidden: Sequence[int] = HIDDEN, recurrent: int = 0) -> None:
        """Build untrained networks that fit the contract; `recurrent` is the size of a GRU, 0 for none."""
        super().__init__()
        self.contract = contract
        self.hidden, self.recurrent = tuple(hidden), recurrent
        self._hidden_states: dict[str, Tensor] = {}
        self.agents = nn.ModuleDict(
            {
                name: AgentNetwork(agent.num_inputs, len(agent.joints), hidden, recurrent)
                for name, agent in contract.agents.items()
            }
        )

    def network(self, agent: str) -> AgentNetwork:
        """Return the network of an agent."""
        return cast(AgentNetwork, self.agents[agent])

    def reset(self, is_ended: Bool[Tensor, " num_envs"] | None = None) -> None:
        """Forget what was seen: where the next observation is the first of an episode, or everywhere.

        Recurrent policies need it.
        """
        if is_ended is None:
            self._hidden_states.clear()
        else:
            self._hidden_states = {
                name: state * ~is_ended[:, None] for name, state in self._hidden_states.items()
            }

    @torch.no_grad()
    def act(
        self, observations: dict[str, Float[Tensor, "num_envs _"]]
    ) -> dict[str, Float[Tensor, "num_envs _"]]:
        """Return the mean action of every agent, clipped to [-1, 1]; a GRU goes on from the last call.

        The observation vectors are in the order of the contract.
        """
        actions = {}
        for name in self.agents:
            observation, state = observations[name], self._hidden_states.get(name)
            if state is None:
                state = observation.new_zeros(len(observation), self.recurrent)
            mean, state = self.network(name)(observation, state)
            actions[name] = mean.clamp(-1.0, 1.0)
            if self.recurrent:
                self._hidden_states[name] = state
        return actions

    @property
    def description(self) -> str:
        """The contract and the sizes of the networks as JSON."""
        sizes = {"hidden": list(self.hidden)} | ({"recurrent": self.recurrent} if self.recurrent else {})
        return json.dumps({**sizes, **self.contract.to_dict()}, indent=2) + "\n"

    def save(self, folder: Path) -> None:
        """Write `policy.safetensors` and `policy.json` into a folder, both or neither.

        Raises:
            OSError: A file could not be written; a policy that was there before is still there.
        """
        folder.mkdir(parents=True, exist_ok=True)
        text = self.description
        tensors = {name: tensor.detach().cpu().contiguous() for name, tensor in self.state_dict().items()}
        weights = safetensors.torch.save(tensors, metadata={"policy": text})
        write_atomically({folder / WEIGHTS_FILE: weights, folder / CONTRACT_FILE: text.encode()})

    @classmethod
    def load(cls, folder: Path, device: str = "cpu") -> "Policy":
        """Read what `save` wrote.

        Raises:
            PolicyMismatchError: A file is missing or damaged, or a field does not fit this code.
        """
        description, tensors = _read(folder)
        hidden, recurrent = description.pop("hidden", None), description.pop("recurrent", 0)
        if hidden is None:
            raise PolicyMismatchError(
                f"policy field 'hidden' is missing in {folder / CONTRACT_FILE}; train again."
            )
        policy = cls(PolicyContract.from_dict(description), hidden, recurrent)
        for name, expected in policy.state_dict().items():
            found = tuple(tensors[name].shape) if name in tensors else "nothing"
            if found != tuple(expected.shape):
                raise PolicyMismatchError(
                    f"policy tensor '{name}' should have shape {tuple(expected.shape)} by {CONTRACT_FILE}, "
                    f"but {WEIGHTS_FILE} has {found}; train again or restore both files."
                )
        policy.load_state_dict(tensors)
        return policy.to(device).eval()


def _read(folder: Path) -> tuple[dict[str, Any], dict[str, Tensor]]:
    try:
        text = (folder / CONTRACT_FILE).read_text()
        description = read_json_object(folder / CONTRACT_FILE)
        with safetensors.safe_open(folder / WEIGHTS_FILE, framework="pt") as file:
            saved_text = (file.metadata() or {}).get("policy")
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (not a dict)
    except (FileNotFoundError, NotADirectoryError) as error:
        raise PolicyMismatchError(
            f"no policy in '{folder}': it needs {WEIGHTS_FILE} and {CONTRACT_FILE}, as training writes them."
        ) from error
    except (SafetensorError, ValueError) as error:
        raise PolicyMismatchError(f"the policy in '{folder}' is damaged: {error}") from error
    if saved_text != text:
        raise PolicyMismatchError(
            f"{CONTRACT_FILE} and {WEIGHTS_FILE} in '{folder}' are not of the same save; restore both files."
        )
    return description, tensors
