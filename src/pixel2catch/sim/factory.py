"""The back end for a device and an engine."""

import mujoco
import torch

from pixel2catch.errors import DeviceUnavailableError, InvalidValueError, UnknownNameError
from pixel2catch.sim.simulation import Simulation

ENGINES = ("mujoco", "physx", "drake")
"""Physics that there is: MuJoCo's, on a CPU or a GPU, and others to judge policies by, on a CPU."""

INELASTIC = ("drake",)
"""Those in which nothing bounces."""


def make_simulation(
    model: mujoco.MjModel, num_envs: int, device: str, engine: str = ENGINES[0]
) -> Simulation:
    """Build the back end of a device: `mujoco.batch` for "cpu", MuJoCo Warp for "cuda" or "cuda:N".

    Another engine than MuJoCo has the CPU alone. Nothing else asks which device or engine it is.

    Raises:
        DeviceUnavailableError: If CUDA is asked for and absent, or the engine is not installed.
        InvalidValueError: If an engine is asked for CUDA, or it cannot have what is in the model.
        UnknownNameError: If the device is of another type, or there is no such engine.
    """
    kind = device.split(":")[0]
    if kind not in ("cpu", "cuda"):
        raise UnknownNameError("device", device, ("cpu", "cuda", "cuda:0", "cuda:1"))
    require_engine(engine)
    if engine != ENGINES[0]:
        if kind != "cpu":
            raise InvalidValueError(f"engine '{engine}' was asked for on a CUDA device; give --device cpu")
        from pixel2catch.sim.drake import DrakeCopy
        from pixel2catch.sim.engine import EngineSimulation
        from pixel2catch.sim.physx import PhysxCopy

        return EngineSimulation(model, num_envs, {"physx": PhysxCopy, "drake": DrakeCopy}[engine])
    if kind == "cpu":
        from pixel2catch.sim.batch import BatchSimulation

        return BatchSimulation(model, num_envs)
    require_cuda(device)
    from pixel2catch.sim.warp import WarpSimulation

    return WarpSimulation(model, num_envs, device)


def require_engine(engine: str) -> None:
    """Raise if there is no such engine, or it is not installed.

    Raises:
        DeviceUnavailableError: With the command that installs it.
        UnknownNameError: With the engines that there are.
    """
    if engine not in ENGINES:
        raise UnknownNameError("engine", engine, ENGINES)
    if engine == "physx":
        from pixel2catch.sim.physx import load_sapien

        load_sapien()
    elif engine == "drake":
        from pixel2catch.sim.drake import load_drake

        load_drake()


def require_cuda(device: str) -> None:
    """Raise if PyTorch does not see the CUDA device.

    Raises:
        DeviceUnavailableError: With what is there and what to do.
    """
    count = torch.cuda.device_count()
    index = torch.device(device).index or 0
    if index >= count:
        raise DeviceUnavailableError(
            f"device '{device}' was asked for, but PyTorch {torch.__version__} sees {count} CUDA devices; "
            "use --device cpu, or install a CUDA build of PyTorch and a driver that it supports"
        )
