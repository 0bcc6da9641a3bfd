"""CUDA graphs: a function of tensors is recorded once and then replayed with a single launch."""

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from functools import cached_property
from typing import Any, Generic, TypeVar

import torch
from torch import Tensor

from pixel2catch.device_constants import Constants, keeping

Result = TypeVar("Result")


class GraphedFunction(Generic[Result]):
    """A function on a CUDA device whose first calls run as they are and whose later ones are replayed.

    It owns whatever a recording reads and writes: the function with all that it refers to, copies of its
    arguments, the constants that it asks for, its result, and unless it shares memory, the stream of the
    recording: cuBLAS has one workspace for a stream, so that recordings of the same stream must not be
    replayed side by side (PyTorch, issue 193402). Tensors that the function reads besides its arguments must
    be changed in place.
    """

    def __init__(
        self,
        function: Callable[..., Result],
        *,
        device: torch.device,
        num_eager_calls: int,
        is_aside: bool = True,
        pool: Any = None,
        generator: torch.Generator | None = None,
        around: Callable[[], AbstractContextManager[Any]] = nullcontext,
    ) -> None:
        """Take the function; nothing runs yet.

        Args:
            function: Takes tensors of the same shapes in every call, and never waits for the device.
            device: Where it works, and all arguments are.
            num_eager_calls: Calls before it is recorded: in the first, libraries set themselves up
                and constants are made.
            is_aside: Whether those run on a stream of their own, as gradients require; not where another
                library works on the current stream.
            pool: Memory that several recordings share, a `torch.cuda.graph_pool_handle`; its own if absent.
            generator: Random generator that the function draws from, if not torch's own.
            around: Entered around the recorded call, such as a capture by another library.
        """
        self._function, self._device = function, device
        self._num_eager_calls, self._is_aside = num_eager_calls, is_aside
        self._pool, self._generator, self._around = pool, generator, around
        self._constants: Constants = {}
        self._graph: torch.cuda.CUDAGraph | None = None

    def __call__(self, *arguments: Tensor) -> Result:
        """Return what the function returns; a later call overwrites the tensors in it."""
        if self._num_eager_calls > 0:
            self._num_eager_calls -= 1
            with keeping(self._constants):
                return self._run_aside(arguments) if self._is_aside else self._function(*arguments)
        if self._graph is None:
            self._graph = self._record(arguments)
        for own, argument in zip(self._arguments, arguments, strict=True):
            own.copy_(argument)
        self._graph.replay()
        return self._result

    @cached_property
    def _stream(self) -> torch.cuda.Stream:
        return torch.cuda.Stream(self._device)

    def _run_aside(self, arguments: tuple[Tensor, ...]) -> Result:
        stream = self._stream
        stream.wait_stream(torch.cuda.current_stream(self._device))
        with torch.cuda.stream(stream):
            result = self._function(*arguments)
        torch.cuda.current_stream(self._device).wait_stream(stream)
        return result

    def _record(self, arguments: tuple[Tensor, ...]) -> torch.cuda.CUDAGraph:
        self._arguments = [argument.clone() for argument in arguments]
        graph = torch.cuda.CUDAGraph()
        if self._generator is not None:
            graph.register_generator_state(self._generator)
        stream = self._stream if self._pool is None else None  # of one stream, memory can be shared
        # Other threads may use the device meanwhile (NCCL's do), which "global" would forbid.
        with (
            keeping(self._constants),
            torch.cuda.device(self._device),
            torch.cuda.graph(graph, self._pool, stream, capture_error_mode="thread_local"),
            self._around(),
        ):
            self._result = self._function(*self._arguments)
        # PyTorch begins a capture by writing the generator's state on the stream of the capture; the first
        # replay writes it anew, on this stream, and must come later.
        torch.cuda.synchronize(self._device)
        return graph
