"""torch.compile for functions that step a simulation: what they compute on tensors becomes fewer kernels."""

import warnings
from collections.abc import Callable
from typing import TypeVar

import torch

from pixel2catch.errors import DeviceUnavailableError
from pixel2catch.sim.simulation import Simulation

Result = TypeVar("Result")


def fused(
    function: Callable[..., Result], simulation: Simulation, backend: str = "inductor"
) -> Callable[..., Result]:
    """The function with its tensor work fused between the steps of the simulation, which stay as they are.

    The first call compiles it, which takes about a minute. `backend` is one of torch.compile's.

    Raises:
        DeviceUnavailableError: If there is no C++ compiler, which a CPU's kernels need.
    """
    if simulation.device.type == "cpu" and backend == "inductor":
        require_compiler()
    for name in ("step", "forward", "ray"):
        setattr(simulation, name, torch.compiler.disable(getattr(simulation, name)))
    # The values of these functions are constants to the compiler, so that their caches do not matter.
    warnings.filterwarnings("ignore", "Dynamo detected a call to a `functools.lru_cache`", UserWarning)
    return torch.compile(function, dynamic=False, backend=backend)


def require_compiler() -> None:
    """See that torch.compile finds the C++ compiler that it needs for a CPU.

    Raises:
        DeviceUnavailableError: If it does not.
    """
    from torch._inductor.cpp_builder import get_cpp_compiler
    from torch._inductor.exc import InvalidCxxCompiler

    try:
        get_cpp_compiler()
    except InvalidCxxCompiler as error:
        raise DeviceUnavailableError(
            "kernels of a CPU are fused by a C++ compiler, and none works here: install g++ (on Ubuntu: apt "
            "install g++), name another one in the environment variable CXX, or leave out --fuse."
        ) from error
