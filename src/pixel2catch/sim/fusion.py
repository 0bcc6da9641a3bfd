"""torch.compile for functions that step a simulation: their tensor operations become fewer kernels."""

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
    """Return the function with fused tensor operations; the steps of the simulation are not compiled.

    The first call compiles for about a minute. `backend` is a back end of torch.compile.
    """
    if simulation.device.type == "cpu" and backend == "inductor":
        require_compiler()
    for name in ("step", "forward", "ray"):
        setattr(simulation, name, torch.compiler.disable(getattr(simulation, name)))
    # Dynamo treats results of cached functions as constants.
    warnings.filterwarnings("ignore", "Dynamo detected a call to a `functools.lru_cache`", UserWarning)
    return torch.compile(function, dynamic=False, backend=backend)


def require_compiler() -> None:
    """Require the C++ compiler that torch.compile needs for a CPU."""
    from torch._inductor.cpp_builder import get_cpp_compiler
    from torch._inductor.exc import InvalidCxxCompiler

    try:
        get_cpp_compiler()
    except InvalidCxxCompiler as error:
        raise DeviceUnavailableError(
            "--fuse on a CPU needs a C++ compiler and none works: install g++ (on Ubuntu: apt install g++), "
            "name a compiler in the environment variable CXX, or leave out --fuse."
        ) from error
