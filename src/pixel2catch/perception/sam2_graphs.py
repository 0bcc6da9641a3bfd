"""SAM 2's modules as CUDA graphs: one launch for each instead of hundreds.

The model runs a thousand small kernels for an image; on a data-centre GPU the time goes into launching them.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import torch
from torch import Tensor, nn
from torch.utils import _pytree as pytree

Module = Literal["vision_encoder", "memory_attention", "mask_decoder", "memory_encoder"]
"""A part of the model that takes tensors and returns tensors, and never asks for a value on the host."""

MODULES: tuple[Module, ...] = ("vision_encoder", "memory_attention", "mask_decoder", "memory_encoder")

WARM_UP_RUNS = 2
"""Runs before a capture: in the first, kernels choose algorithms and take memory. Source: ours: one spare."""


@dataclass(frozen=True, kw_only=True)
class SpeedCfg:
    """How SAM 2 is made faster on a CUDA device.

    Attributes:
        captured: Modules that run as CUDA graphs.
        compiled: Modules that `torch.compile` fuses before; its first use takes about a minute and needs a C
            compiler.
    """

    captured: tuple[Module, ...] = MODULES
    compiled: tuple[Module, ...] = ()


def accelerate(model: nn.Module, cfg: SpeedCfg) -> None:
    """Replace the modules' forward functions by faster ones that compute the same.

    Args:
        model: SAM 2 on a CUDA device, in evaluation mode.
        cfg: Which modules, and how.
    """
    pool = torch.cuda.graph_pool_handle()
    for name in MODULES:
        module = getattr(model, name)
        if name in cfg.compiled:
            module.forward = torch.compile(module.forward)
        if name in cfg.captured:
            module.forward = CapturedFunction(module.forward, pool)


class CapturedFunction:
    """A function of tensors on a CUDA device, recorded once for every shape of its input and then replayed.

    Several may share a pool of memory: inputs and outputs are copied, so that nothing in it is needed between
    two calls.
    """

    def __init__(self, function: Callable[..., Any], pool: Any) -> None:
        """Take the function; nothing runs yet.

        Args:
            function: Depends on its arguments and on constant tensors only. In and out are nested tuples,
                lists, dictionaries and model outputs of tensors and constants.
            pool: From `torch.cuda.graph_pool_handle`.
        """
        self._function = function
        self._pool = pool
        self._captures: dict[tuple[Any, ...], _Capture] = {}

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        """Return what the function returns."""
        leaves, structure = pytree.tree_flatten((args, kwargs))
        key = (structure, *map(_signature, leaves))
        if key not in self._captures:
            self._captures[key] = _Capture(self._function, leaves, structure, self._pool)
        return self._captures[key].replay(leaves)


def _signature(leaf: Any) -> Any:
    """Return what a recording depends on: layout of a tensor, value of anything else."""
    return (leaf.shape, leaf.dtype, leaf.device) if isinstance(leaf, Tensor) else leaf


class _Capture:
    """One recording, with the tensors that it reads and writes."""

    def __init__(
        self, function: Callable[..., Any], leaves: Sequence[Any], structure: pytree.TreeSpec, pool: Any
    ) -> None:
        self._inputs = _cloned(leaves)
        self._graph = torch.cuda.CUDAGraph()
        device = next(leaf.device for leaf in leaves if isinstance(leaf, Tensor))
        args, kwargs = pytree.tree_unflatten(self._inputs, structure)
        with torch.cuda.device(device):
            stream = torch.cuda.Stream()
            stream.wait_stream(torch.cuda.current_stream())
            with torch.cuda.stream(stream):
                for _ in range(WARM_UP_RUNS):
                    function(*args, **kwargs)
            # Other threads may use the device meanwhile: a viewer, for one.
            with torch.cuda.graph(self._graph, pool, stream, capture_error_mode="thread_local"):
                outputs = function(*args, **kwargs)
            torch.cuda.current_stream().wait_stream(stream)
        self._outputs, self._structure = pytree.tree_flatten(outputs)

    def replay(self, leaves: Sequence[Any]) -> Any:
        """Run the recording on other tensors of the same shapes."""
        for own, leaf in zip(self._inputs, leaves, strict=True):
            if isinstance(leaf, Tensor):
                own.copy_(leaf)
        self._graph.replay()
        return pytree.tree_unflatten(_cloned(self._outputs), self._structure)


def _cloned(leaves: Sequence[Any]) -> list[Any]:
    """Copy tensors; leave the rest."""
    return [leaf.clone() if isinstance(leaf, Tensor) else leaf for leaf in leaves]
