"""Functions of tensors as CUDA graphs: one launch instead of hundreds."""

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.utils import _pytree as pytree

WARM_UP_RUNS = 2
"""Runs before a capture: in the first, kernels choose algorithms and take memory. Source: ours: one spare."""


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
    """What a recording depends on: layout of a tensor, value of anything else."""
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
    return [leaf.clone() if isinstance(leaf, Tensor) else leaf for leaf in leaves]
