"""A policy as one ONNX file: networks, input statistics and contract, for ONNX Runtime on any machine.

For every agent NAME of the contract the graph has the input `observation.NAME` (num_envs, num_inputs) and the
output `action.NAME` (num_envs, num_joints), clipped to [-1, 1]; a recurrent policy has `hidden_state.NAME` as
well, zeros at the first step of an episode, and `next_hidden_state.NAME` (num_envs, size). All are float32.
The metadata's entry `policy` is what `policy.json` says, the contract included.
"""

from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING, Any, final

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from pixel2catch.errors import InvalidValueError, NonFiniteError, PolicyMismatchError
from pixel2catch.files import MOST_WEIGHTS, json_object, read_bytes, reading, shown
from pixel2catch.installation import needs_extra
from pixel2catch.policy.contract import PolicyContract
from pixel2catch.policy.policy import INPUT_CLIP, AgentNetwork, Policy, described

if TYPE_CHECKING:
    import onnx
    from onnxruntime import InferenceSession

SUFFIX = ".onnx"  #: How such a file's name ends.
METADATA = "policy"  #: Name of the entry of the file's metadata.
FIX = "Make one with 'pixel2catch export POLICY'."
OPERATIONS = frozenset({"Sub", "Div", "Clip", "Unsqueeze", "GRU", "Squeeze", "Gemm", "Elu"})
"""What the graph is made of."""
MOST_NODES = 1000  #: Operations of a graph that is read; one of four agents has some sixty. Source: ours.
OPSET, IR_VERSION = 17, 8  #: ONNX of 2022: what runtimes in use read. Source: ours.
TOLERANCE = 1e-5  #: Most that an action may differ from that of the original. Source: ours.
NUM_TRIED = 10_000  #: Inputs on which that is tried. Source: ours.
NUM_STEPS = 10  #: Steps in a row of each: hidden states go on. Source: ours.


@final
class OnnxPolicy:
    """What `to_onnx` made, with `contract`, `act` and `reset` of a `Policy`; the CPU runs its networks."""

    contract: PolicyContract
    recurrent: int  #: Size of the GRU, 0 for none.

    def __init__(self, model: bytes | Path) -> None:
        """Read a model.

        Raises:
            PolicyMismatchError: It is missing, damaged, no policy, or does not fit this code.
        """
        name = str(model) if isinstance(model, Path) else "made here"
        self._session = _session(model, name)
        with reading("policy", name, FIX, PolicyMismatchError):
            text = self._session.get_modelmeta().custom_metadata_map.get(METADATA)
            if text is None:
                raise InvalidValueError("it is an ONNX file, but no policy")
            self.contract, _, self.recurrent = described(json_object(text))
        self._outputs = [output.name for output in self._session.get_outputs()]
        self._states: dict[str, np.ndarray] = {}
        _require_shapes(self._session, self.contract, self.recurrent, name)

    def reset(self, is_ended: Bool[Tensor, " num_envs"] | None = None) -> None:
        """Forget what was seen: see `Policy.reset`."""
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
        self._states = {
            name.removeprefix("next_"): state for name, state in outputs.items() if name.startswith("next_")
        }
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


def to_onnx(policy: Policy) -> bytes:
    """Return a policy as an ONNX model that does the same, which is tried with random inputs.

    Raises:
        NonFiniteError: Its actions are not those of the policy, which has weights that are not finite.
        PolicyMismatchError: A library is missing.
    """
    with _needs_libraries():
        graph = _Graph()
    for agent, contract in policy.contract.agents.items():
        _add_agent(graph, policy.network(agent), agent, len(contract.joints))
    data = graph.model({METADATA: policy.description})
    if not (difference := largest_difference(policy, OnnxPolicy(data))) <= TOLERANCE:
        raise NonFiniteError(
            f"the exported policy's actions differ by {difference:g} from the original's, {TOLERANCE:g} is "
            "allowed: look for weights or input statistics that are no finite numbers, and train again."
        )
    return data


@final
class _Graph:
    """A model that is being put together, node after node."""

    def __init__(self) -> None:
        import onnx

        self._onnx = onnx
        self._nodes, self._weights = list[onnx.NodeProto](), list[onnx.TensorProto]()
        self._inputs, self._outputs = list[onnx.ValueInfoProto](), list[onnx.ValueInfoProto]()

    def _declare(self, name: str, size: int) -> "onnx.ValueInfoProto":
        kind = self._onnx.TensorProto.FLOAT
        return self._onnx.helper.make_tensor_value_info(name, kind, ["num_envs", size])

    def input(self, name: str, size: int) -> str:
        """An input of the model, (num_envs, size)."""
        self._inputs.append(self._declare(name, size))
        return name

    def output(self, name: str, size: int) -> str:
        """An output of the model, (num_envs, size)."""
        self._outputs.append(self._declare(name, size))
        return name

    def add(self, operation: str, *inputs: str | Tensor, to: str = "", **attributes: Any) -> str:
        """A node, of values by their names and of weights; the name of what it makes, its last output."""
        made, names = to or f"value{len(self._nodes)}", list[str]()
        for each in inputs:
            if not isinstance(each, str):
                array = each.detach().cpu().numpy()
                each = f"weight{len(self._weights)}"
                self._weights.append(self._onnx.numpy_helper.from_array(array, each))
            names.append(each)
        outputs = ["", made] if operation == "GRU" else [made]
        self._nodes.append(self._onnx.helper.make_node(operation, names, outputs, **attributes))
        return made

    def model(self, metadata: dict[str, str]) -> bytes:
        """The model as the bytes of a file."""
        helper = self._onnx.helper
        model = helper.make_model(
            helper.make_graph(self._nodes, "policy", self._inputs, self._outputs, self._weights),
            opset_imports=[helper.make_opsetid("", OPSET)],
            ir_version=IR_VERSION,
            producer_name="pixel2catch",
            doc_string=__doc__ or "",
        )
        helper.set_model_props(model, metadata)
        self._onnx.checker.check_model(model, full_check=True)
        return model.SerializeToString()


def _add_agent(graph: _Graph, network: AgentNetwork, agent: str, num_joints: int) -> None:
    """`AgentNetwork.forward` and the clip of its actions."""
    value = graph.input(f"observation.{agent}", len(network.input_mean))
    value = graph.add("Div", graph.add("Sub", value, network.input_mean), network.input_std)
    value = graph.add("Clip", value, *torch.tensor((-INPUT_CLIP, INPUT_CLIP)))
    if gru := network.gru:
        state = graph.input(f"hidden_state.{agent}", gru.hidden_size)
        first = torch.tensor([0])
        # torch has the gates reset, update and new, ONNX update, reset and new
        weights = [
            torch.cat([part.chunk(3)[gate] for gate in (1, 0, 2)])
            for part in (gru.weight_ih, gru.weight_hh, gru.bias_ih, gru.bias_hh)
        ]
        parts = (weights[0][None], weights[1][None], torch.cat(weights[2:])[None])
        inputs = (graph.add("Unsqueeze", value, first), *parts, "", graph.add("Unsqueeze", state, first))
        value = graph.add("GRU", *inputs, hidden_size=gru.hidden_size, linear_before_reset=1)
        made = graph.output(f"next_hidden_state.{agent}", gru.hidden_size)
        value = graph.add("Squeeze", value, first, to=made)
    for layer in network.network:
        if isinstance(layer, nn.Linear):
            value = graph.add("Gemm", value, layer.weight, layer.bias, transB=1)
        else:
            value = graph.add("Elu", value)
    graph.add("Clip", value, *torch.tensor((-1.0, 1.0)), to=graph.output(f"action.{agent}", num_joints))


def largest_difference(policy: Policy, other: LoadedPolicy) -> float:
    """How far actions of two policies of one contract differ at most, for random observations.

    They are normal, with three times the deviation of the policy's statistics; hidden states go on.
    """
    generator, differences = torch.Generator().manual_seed(0), list[Tensor]()
    policy.reset()
    other.reset()
    for _ in range(NUM_STEPS):
        observations = dict[str, Tensor]()
        for agent in policy.contract.agents:
            mean, std = policy.network(agent).input_mean, policy.network(agent).input_std
            noise = torch.randn(NUM_TRIED // NUM_STEPS, len(mean), generator=generator)
            observations[agent] = mean + 3.0 * std * noise
        actions, others = policy.act(observations), other.act(observations)
        differences += [(actions[agent] - others[agent]).abs().max() for agent in actions]
    policy.reset()
    other.reset()
    return float(torch.stack(differences).max())


def _needs_libraries() -> AbstractContextManager[None]:
    return needs_extra("onnx", "ONNX files need a package that cannot be imported", PolicyMismatchError)


def _session(model: bytes | Path, name: str) -> "InferenceSession":
    with _needs_libraries():
        import onnx
        from onnxruntime import InferenceSession, SessionOptions  # pyright: ignore[reportAttributeAccessIssue]
    options = SessionOptions()
    options.intra_op_num_threads = 1  # its threads only make steps of these small tensors slower
    options.log_severity_level = 4
    with reading("policy", name, FIX, PolicyMismatchError):
        content = read_bytes(model, MOST_WEIGHTS) if isinstance(model, Path) else model
        try:
            _require_ours(onnx.load_model_from_string(content))
            return InferenceSession(content, options, providers=["CPUExecutionProvider"])
        except InvalidValueError:
            raise
        except Exception as error:  # the libraries raise a class of their own for every kind of damage
            raise InvalidValueError(f"it is damaged, or no ONNX file: {error}") from error


def _require_ours(model: "onnx.ModelProto") -> None:
    """Refuse a graph with anything but what a policy is made of: others may compute without end."""
    from onnx import numpy_helper

    other = {node.op_type for node in model.graph.node} - OPERATIONS
    if other or len(model.functions) or len(model.graph.node) > MOST_NODES:
        raise InvalidValueError(
            f"it has {len(model.graph.node)} operations, {shown(sorted(other))} among them; a policy has "
            f"{', '.join(sorted(OPERATIONS))}, at most {MOST_NODES}"
        )
    for each in model.graph.initializer:
        if each.external_data or not np.isfinite(numpy_helper.to_array(each)).all():
            raise InvalidValueError(f"its weights '{each.name}' are in another file, or not finite")


def _require_shapes(session: "InferenceSession", contract: PolicyContract, recurrent: int, name: str) -> None:
    """Refuse networks that are not those of the contract."""
    expected: dict[str, int] = {}
    for agent, each in contract.agents.items():
        expected |= {f"observation.{agent}": each.num_inputs, f"action.{agent}": len(each.joints)}
        states = (f"hidden_state.{agent}", f"next_hidden_state.{agent}")
        expected |= dict.fromkeys(states, recurrent) if recurrent else {}
    found = {
        each.name: each.shape[-1] if each.shape else None
        for each in (*session.get_inputs(), *session.get_outputs())
    }
    for field in expected | found:
        if expected.get(field) != found.get(field):
            raise PolicyMismatchError(
                f"'{name}': '{field}' has size {found.get(field)}, and {expected.get(field)} by its "
                "contract; export the policy again."
            )
