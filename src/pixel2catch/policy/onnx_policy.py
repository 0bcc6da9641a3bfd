"""A policy as one ONNX file: networks, input statistics and contract, for ONNX Runtime on any machine.

For every agent NAME of the contract the graph has the input `observation.NAME` (num_envs, num_inputs) and
the output `action.NAME` (num_envs, num_joints), clipped to [-1, 1]. A recurrent policy also has
`hidden_state.NAME`, zeros at the first step of an episode, and `next_hidden_state.NAME` (num_envs, size). All
are float32. The metadata entry `policy` has the content of `policy.json`, with the contract.
"""

import logging
import warnings
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, final

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from pixel2catch.errors import InvalidValueError, NonFiniteError, PolicyMismatchError
from pixel2catch.files import MOST_WEIGHTS, json_object, read_bytes, reading, shown
from pixel2catch.installation import needs_extra
from pixel2catch.policy.contract import PolicyContract
from pixel2catch.policy.policy import Policy, described

SUFFIX = ".onnx"  #: How such a file's name ends.
FIX = "Make one with 'pixel2catch export POLICY'."
OPERATIONS = {"Add", "Clip", "Div", "Elu", "Gemm", "Mul", "Sigmoid", "Split", "Sub", "Tanh"} | {
    *("GRU", "Squeeze", "Unsqueeze"),  # in files of earlier versions
}
"""Operations of an exported policy. Others are refused: loops may compute without end."""
MOST_NODES = 1000  #: Operations of a graph that is read; one of four agents has some sixty. Source: ours.
OPSET, IR_VERSION = 18, 8  #: Format of 2022, which all current runtimes read. Source: ours.
TOLERANCE = 1e-5  #: Largest allowed difference of an action from the original's. Source: ours.
NUM_STEPS, NUM_TRIED = 10, 1000  #: Consecutive steps and environments in which that is tried. Source: ours.


@final
class OnnxPolicy:
    """A policy from an ONNX file, with `contract`, `act` and `reset` of a `Policy`; it runs on the CPU."""

    contract: PolicyContract
    recurrent: int  #: Size of the GRU, 0 for none.

    def __init__(self, model: bytes | Path) -> None:
        """Read a model.

        Raises:
            PolicyMismatchError: It is missing, damaged, no policy, or does not fit this code.
        """
        name = str(model) if isinstance(model, Path) else "made here"
        with _needs_libraries(), reading("policy", name, FIX, PolicyMismatchError):
            self._session = _session(read_bytes(model, MOST_WEIGHTS) if isinstance(model, Path) else model)
            text = self._session.get_modelmeta().custom_metadata_map.get("policy")
            if text is None:
                raise InvalidValueError("it is an ONNX file, but no policy")
            self.contract, _, self.recurrent = described(json_object(text))
            values = (*self._session.get_inputs(), *self._session.get_outputs())
            found = {each.name: each.shape[-1] if each.shape else None for each in values}
            if (expected := _shapes(self.contract, self.recurrent)) != found:
                raise InvalidValueError(f"its values have sizes {found}, and {expected} by its contract")
        self._outputs = [output.name for output in self._session.get_outputs()]
        self._states: dict[str, np.ndarray] = {}

    def reset(self, is_ended: Bool[Tensor, " num_envs"] | None = None) -> None:
        """Reset the hidden states: see `Policy.reset`."""
        if is_ended is None:
            self._states.clear()
        else:
            goes_on = ~is_ended.cpu().numpy()[:, None]
            self._states = {name: state * goes_on for name, state in self._states.items()}

    def act(
        self, observations: dict[str, Float[Tensor, "num_envs _"]]
    ) -> dict[str, Float[Tensor, "num_envs _"]]:
        """Return the mean action of every agent, clipped to [-1, 1]: see `Policy.act`."""
        inputs = {f"observation.{name}": values.cpu().numpy() for name, values in observations.items()}
        if self.recurrent:
            blank = np.zeros((len(next(iter(inputs.values()))), self.recurrent), np.float32)
            inputs |= {f"hidden_state.{name}": blank for name in observations} | self._states
        values: Any = self._session.run(self._outputs, inputs)
        outputs: dict[str, np.ndarray] = dict(zip(self._outputs, values, strict=True))
        states = {name: state for name, state in outputs.items() if name.startswith("next_")}
        self._states = {name.removeprefix("next_"): state for name, state in states.items()}
        return {
            name: torch.from_numpy(outputs[f"action.{name}"]).to(values.device)
            for name, values in observations.items()
        }


LoadedPolicy = Policy | OnnxPolicy  #: What acts: a policy's folder or ONNX file.


def load(path: Path, device: str = "cpu") -> LoadedPolicy:
    """Read the folder of a policy or its ONNX file.

    Raises:
        PolicyMismatchError: A file is missing or damaged, or a field does not fit this code.
    """
    return OnnxPolicy(path) if path.suffix == SUFFIX else Policy.load(path, device)


@final
class _Graph(nn.Module):
    def __init__(self, policy: Policy) -> None:
        super().__init__()
        self.policy, self.names = policy, tuple(policy.contract.agents)

    def forward(self, *inputs: Tensor) -> tuple[Tensor, ...]:
        """Return all actions, and all next hidden states of a recurrent policy."""
        states = inputs[len(self.names) :] or (inputs[0].new_zeros(0, 0),) * len(self.names)
        made = [
            self.policy.network(name)(value, state)
            for name, value, state in zip(self.names, inputs, states, strict=False)
        ]
        actions = tuple(mean.clamp(-1.0, 1.0) for mean, _ in made)
        return actions + tuple(state for _, state in made) if self.policy.recurrent else actions


def to_onnx(policy: Policy) -> bytes:
    """Return a policy as an ONNX model whose actions are compared with the policy's for random inputs.

    Raises:
        NonFiniteError: The actions differ: weights or input statistics are not finite.
        PolicyMismatchError: A library is missing.
    """
    sizes = _shapes(policy.contract, policy.recurrent)
    inputs = [name for name in sizes if name.startswith(("observation", "hidden_state"))]
    batch = torch.export.Dim("num_envs")
    with _needs_libraries(), warnings.catch_warnings():
        import onnx
        import onnxscript  # noqa: F401 (the exporter needs it)

        warnings.simplefilter("ignore")  # of libraries about each other
        logging.getLogger("torch.onnx").setLevel(logging.ERROR)
        program = torch.onnx.export(
            _Graph(policy).eval(),
            tuple(torch.zeros(2, sizes[name]) for name in inputs),
            dynamo=True,
            verbose=False,
            opset_version=OPSET,
            input_names=inputs,
            output_names=[name for name in sizes if name not in inputs],
            dynamic_shapes=(tuple({0: batch} for _ in inputs),),
        )
    assert program is not None
    model = program.model_proto
    for node in model.graph.node:
        node.ClearField("metadata_props")  # traces of this machine
    model.ir_version, model.producer_name, model.doc_string = IR_VERSION, "pixel2catch", __doc__ or ""
    onnx.helper.set_model_props(model, {"policy": policy.description})
    data = model.SerializeToString()
    if not (difference := largest_difference(policy, OnnxPolicy(data))) <= TOLERANCE:
        raise NonFiniteError(
            f"the exported policy's actions differ by {difference:g} from the original's, {TOLERANCE:g} is "
            "allowed: look for weights or input statistics that are not finite, and train again."
        )
    return data


def largest_difference(policy: Policy, other: LoadedPolicy) -> float:
    """Return the largest difference of the actions of two policies of one contract for random observations.

    They are normal, with three times the deviation of the policy's statistics; hidden states go on.
    """
    generator, differences = torch.Generator().manual_seed(0), list[Tensor]()
    policy.reset()
    other.reset()
    for _ in range(NUM_STEPS):
        observations = dict[str, Tensor]()
        for agent in policy.contract.agents:
            mean, std = policy.network(agent).input_mean, policy.network(agent).input_std
            observations[agent] = mean + 3.0 * std * torch.randn(NUM_TRIED, len(mean), generator=generator)
        actions, others = policy.act(observations), other.act(observations)
        differences += [(actions[agent] - others[agent]).abs().max() for agent in actions]
    policy.reset()
    other.reset()
    return float(torch.stack(differences).max())


def _shapes(contract: PolicyContract, recurrent: int) -> dict[str, int]:
    """Return the sizes of the inputs, then of the outputs, by name."""
    agents = contract.agents.items()
    states = {f"hidden_state.{name}": recurrent for name, _ in agents if recurrent}
    inputs = {f"observation.{name}": agent.num_inputs for name, agent in agents} | states
    actions = {f"action.{name}": len(agent.joints) for name, agent in agents}
    return inputs | actions | {f"next_{name}": size for name, size in states.items()}


def _needs_libraries() -> AbstractContextManager[None]:
    return needs_extra("onnx", "ONNX files need a package that cannot be imported", PolicyMismatchError)


def _session(content: bytes) -> Any:
    import onnx
    from onnxruntime import InferenceSession, SessionOptions  # pyright: ignore[reportAttributeAccessIssue]

    options = SessionOptions()
    options.intra_op_num_threads = 1  # more threads make steps of these small tensors slower
    options.log_severity_level = 4
    try:
        graph = onnx.load_model_from_string(content).graph
        other = {node.op_type for node in graph.node} - OPERATIONS
        if other or len(graph.node) > MOST_NODES:
            raise InvalidValueError(
                f"it has {len(graph.node)} operations, {shown(sorted(other))} among them; a policy has "
                f"{', '.join(sorted(OPERATIONS))}, at most {MOST_NODES}"
            )
        for each in graph.initializer:
            if each.external_data or not np.isfinite(onnx.numpy_helper.to_array(each)).all():
                raise InvalidValueError(f"its weights '{each.name}' are in another file, or not finite")
        return InferenceSession(content, options, providers=["CPUExecutionProvider"])
    except InvalidValueError:
        raise
    except Exception as error:  # the libraries raise a class of their own for every kind of damage
        raise InvalidValueError(f"it is damaged, or no ONNX file: {error}") from error
