"""Choice of the back end for a device and an engine."""

from typing import Any

import mujoco
import torch

from pixel2catch.errors import DeviceUnavailableError, InvalidValueError, UnknownNameError
from pixel2catch.sim.simulation import Simulation

ENGINES = ("mujoco", "physx", "drake")  #: MuJoCo on CPU and GPU; the others evaluate on the CPU.

INELASTIC = ("drake",)  #: Engines without restitution.


def make_simulation(
    model: mujoco.MjModel, num_envs: int, device: str, engine: str = ENGINES[0]
) -> Simulation:
    """Build the back end of a device: `mujoco.batch` for "cpu", MuJoCo Warp for "cuda" or "cuda:N"."""
    if engine != ENGINES[0]:
        make_copy = require_engine(engine)
        if device != "cpu":
            raise InvalidValueError(f"engine '{engine}' does not support CUDA; give --device cpu.")
        from pixel2catch.sim.engine import EngineSimulation

        return EngineSimulation(model, num_envs, make_copy)
    if device == "cpu":
        from pixel2catch.sim.batch import BatchSimulation

        return BatchSimulation(model, num_envs)
    require_cuda(device)
    from pixel2catch.sim.warp import WarpSimulation

    return WarpSimulation(model, num_envs, device)


def require_engine(engine: str) -> Any:
    """Return the class of copies in an engine, None for MuJoCo; raise if it is unknown or not installed."""
    if engine not in ENGINES:
        raise UnknownNameError("engine", engine, ENGINES)
    if engine == "physx":
        from pixel2catch.sim.physx import PhysxCopy as Copy
        from pixel2catch.sim.physx import load_sapien as load
    elif engine == "drake":
        from pixel2catch.sim.drake import DrakeCopy as Copy
        from pixel2catch.sim.drake import load_drake as load
    else:
        return None
    load()
    return Copy


def require_cuda(device: str) -> None:
    """Raise if a device is of CUDA and PyTorch does not find it."""
    count = torch.cuda.device_count()
    if device != "cpu" and (torch.device(device).index or 0) >= count:
        fix = "use --device cpu, or install a CUDA build of PyTorch and a driver that it supports."
        fix = f"use cuda:0 to cuda:{count - 1}." if count else fix
        raise DeviceUnavailableError(
            f"device '{device}' was given, but PyTorch {torch.__version__} finds {count} CUDA devices; {fix}"
        )
