"""A policy as one ONNX file: networks, input statistics and contract, for ONNX Runtime on any machine.

For every agent NAME of the contract the graph has the input `observation.NAME` (num_envs, num_inputs) and
the output `action.NAME` (num_envs, num_joints), clipped to [-1, 1]; both are float32. The metadata entry
`policy` has the content of `policy.json`, with the contract. This package reads the weights from such a file,
and computes with PyTorch.
"""

import logging
import warnings
from contextlib import AbstractContextManager
from pathlib import Path
from typing import final

import numpy as np
import torch
from torch import Tensor, nn

from pixel2catch.errors import InvalidValueError, NonFiniteError, PolicyMismatchError
from pixel2catch.files import MOST_WEIGHTS, json_object, read_bytes, reading
from pixel2catch.installation import needs_extra
from pixel2catch.policy.policy import Policy

SUFFIX = ".onnx"  #: How such a file's name ends.
WEIGHTS = "policy."  #: How the names of weights begin in such a file, before those in a `Policy`.
FIX = "Make one with 'pixel2catch export POLICY'."
OPSET, IR_VERSION = 18, 8  #: Format of 2022, which all current runtimes read. Source: ours.
TOLERANCE = 1e-5  #: Largest allowed difference of an action from the original's. Source: ours.
NUM_TRIED = 10_000  #: Random observations for which that is tried. Source: ours.


def load(path: Path, device: str = "cpu") -> Policy:
    """Read the folder of a policy or its ONNX file; raise PolicyMismatchError if it does not fit."""
    if path.suffix != SUFFIX:
        return Policy.load(path, device)
    with _needs_libraries(), reading("policy", path, FIX, PolicyMismatchError):
        import onnx

        content = read_bytes(path, MOST_WEIGHTS)
        try:
            model = onnx.load_model_from_string(content)
            tensors = {
                each.name.removeprefix(WEIGHTS): torch.tensor(onnx.numpy_helper.to_array(each))
                for each in model.graph.initializer
                if each.name.startswith(WEIGHTS) and not each.external_data
            }
        except Exception as error:  # the libraries raise a class of their own for every kind of damage
            raise InvalidValueError(f"it is damaged, or no ONNX file: {error}") from error
        text = {each.key: each.value for each in model.metadata_props}.get("policy")
        if text is None:
            raise InvalidValueError("it is an ONNX file, but no policy")
        return Policy.of(json_object(text), tensors).to(device).eval()


@final
class _Graph(nn.Module):
    def __init__(self, policy: Policy) -> None:
        super().__init__()
        self.policy, self.names = policy, tuple(policy.contract.agents)

    def forward(self, *inputs: Tensor) -> tuple[Tensor, ...]:
        given = zip(self.names, inputs, strict=True)
        return tuple(self.policy.network(name)(value).clamp(-1.0, 1.0) for name, value in given)


def to_onnx(policy: Policy) -> bytes:
    """Return a policy as an ONNX model; raise NonFiniteError if its actions differ for random inputs."""
    agents, description = policy.contract.agents, policy.description
    sizes = {f"observation.{name}": agent.num_inputs for name, agent in agents.items()}
    batch = torch.export.Dim("num_envs")
    with _needs_libraries(), warnings.catch_warnings():
        import onnx
        import onnxscript  # noqa: F401 (the exporter needs it)

        warnings.simplefilter("ignore")  # of libraries about each other
        logging.getLogger("torch.onnx").setLevel(logging.ERROR)
        program = torch.onnx.export(
            _Graph(policy).eval(),
            tuple(torch.zeros(2, size) for size in sizes.values()),
            dynamo=True,
            verbose=False,
            opset_version=OPSET,
            input_names=[*sizes],
            output_names=[f"action.{name}" for name in agents],
            dynamic_shapes=(tuple({0: batch} for _ in sizes),),
        )
    assert program is not None
    model = program.model_proto
    for node in model.graph.node:
        node.ClearField("metadata_props")  # traces of this machine
    model.ir_version, model.producer_name, model.doc_string = IR_VERSION, "pixel2catch", __doc__ or ""
    onnx.helper.set_model_props(model, {"policy": description})
    data = model.SerializeToString()
    if not (difference := largest_difference(policy, data)) <= TOLERANCE:
        raise NonFiniteError(
            f"the exported policy's actions differ by {difference:g} from the original's, {TOLERANCE:g} is "
            "allowed: look for weights or input statistics that are not finite, and train again."
        )
    return data


def largest_difference(policy: Policy, data: bytes) -> float:
    """Return the largest difference of its actions by ONNX Runtime for random observations.

    They are normal, with three times the deviation of the policy's statistics.
    """
    with _needs_libraries():
        from onnxruntime import InferenceSession  # pyright: ignore[reportAttributeAccessIssue]
    session = InferenceSession(data, providers=["CPUExecutionProvider"])
    generator, observations = torch.Generator().manual_seed(0), dict[str, Tensor]()
    for agent in policy.contract.agents:
        mean, std = policy.network(agent).input_mean, policy.network(agent).input_std
        observations[agent] = mean + 3.0 * std * torch.randn(NUM_TRIED, len(mean), generator=generator)
    actions = policy.act(observations)
    inputs = {f"observation.{agent}": values.numpy() for agent, values in observations.items()}
    found = session.run([f"action.{agent}" for agent in actions], inputs)
    pairs = zip(found, actions.values(), strict=True)
    return float(np.max([np.abs(one - other.numpy()).max() for one, other in pairs]))


def _needs_libraries() -> AbstractContextManager[None]:
    return needs_extra("onnx", "ONNX files need a package that cannot be imported", PolicyMismatchError)
