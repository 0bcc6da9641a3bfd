"""torch.compile for functions that step a simulation: what they compute on tensors becomes fewer kernels."""

import warnings
from collections.abc import Callable
from typing import TypeVar

import torch

from pixel2catch.sim.simulation import Simulation

Result = TypeVar("Result")


def fused(
    function: Callable[..., Result], simulation: Simulation, backend: str = "inductor"
) -> Callable[..., Result]:
    """The function with its tensor work fused between the steps of the simulation, which stay as they are.

    The first call compiles it, which takes about a minute. `backend` is one of torch.compile's.
    """
    for name in ("step", "forward", "ray"):
        setattr(simulation, name, torch.compiler.disable(getattr(simulation, name)))
    # The values of these functions are constants to the compiler, so that their caches do not matter.
    warnings.filterwarnings("ignore", "Dynamo detected a call to a `functools.lru_cache`", UserWarning)
    return torch.compile(function, dynamic=False, backend=backend)
