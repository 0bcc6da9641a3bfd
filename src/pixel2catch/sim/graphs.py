"""Fewer and larger launches of work on a device: CUDA graphs, and torch.compile around a simulation."""

import warnings
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from functools import cached_property
from typing import Any, Generic

import torch
from torch import Tensor

from pixel2catch.devices import Constants, keeping
from pixel2catch.errors import DeviceUnavailableError
from pixel2catch.sim.simulation import Result, Simulation


class GraphedFunction(Generic[Result]):
    """A function on a CUDA device: its first calls run eagerly, later calls replay a recording.

    The object owns all memory of the recording: the function, copies of its arguments, device constants, the
    result and the stream. cuBLAS has one workspace per stream, so recordings of one stream must not be
    replayed concurrently (PyTorch issue 193402). Change other tensors that the function reads in place only.
    """

    def __init__(
        self,
        function: Callable[..., Result],
        *,
        device: torch.device,
        num_eager_calls: int,
        is_aside: bool = True,
        generator: torch.Generator | None = None,
        around: Callable[[], AbstractContextManager[Any]] = nullcontext,
    ) -> None:
        """Store the function; nothing runs yet.

        The function takes tensors of the same shapes in every call and never waits for the device. Libraries
        initialise in its eager calls, and constants are made. Those run aside, on a separate stream, as
        gradients require, unless another library uses the current stream. The recorded call is inside
        `around`, such as the capture of another library.
        """
        self._function, self._device = function, device
        self._num_eager_calls, self._is_aside = num_eager_calls, is_aside
        self._generator, self._around = generator, around
        self._constants: Constants = {}
        self._graph: torch.cuda.CUDAGraph | None = None

    def __call__(self, *arguments: Tensor) -> Result:
        """Return the result of the function; a later call overwrites its tensors."""
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
        # "thread_local" lets other threads, such as NCCL's, use the device during the capture.
        with (
            keeping(self._constants),
            torch.cuda.device(self._device),
            torch.cuda.graph(graph, stream=self._stream, capture_error_mode="thread_local"),
            self._around(),
        ):
            self._result = self._function(*self._arguments)
        # A capture begins by writing the generator's state on the capture stream. The first replay writes it
        # again on this stream and must come later.
        torch.cuda.synchronize(self._device)
        return graph


def fused(
    function: Callable[..., Result], simulation: Simulation, backend: str = "inductor"
) -> Callable[..., Result]:
    """Return the function with fused tensor operations; the steps of the simulation are not compiled.

    The first call compiles for about a minute. `backend` is a back end of torch.compile. Raises
    DeviceUnavailableError without a C++ compiler, which torch.compile needs for a CPU.
    """
    if simulation.device.type == "cpu" and backend == "inductor":
        from torch._inductor.cpp_builder import get_cpp_compiler
        from torch._inductor.exc import InvalidCxxCompiler

        try:
            get_cpp_compiler()
        except InvalidCxxCompiler as error:
            raise DeviceUnavailableError(
                "--fuse on a CPU needs a C++ compiler and none works: install g++ (on Ubuntu: apt install "
                "g++), name a compiler in the environment variable CXX, or leave out --fuse."
            ) from error
    for name in ("step", "forward", "ray"):
        setattr(simulation, name, torch.compiler.disable(getattr(simulation, name)))
    # Dynamo treats results of cached functions as constants.
    warnings.filterwarnings("ignore", "Dynamo detected a call to a `functools.lru_cache`", UserWarning)
    return torch.compile(function, dynamic=False, backend=backend)
