"""Choosing the back end by the device: the only place that asks which one it is."""

import mujoco
import torch

from pixel2catch.errors import DeviceUnavailableError, UnknownNameError
from pixel2catch.sim.simulation import Simulation


def make_simulation(model: mujoco.MjModel, num_envs: int, device: str) -> Simulation:
    """Build the back end of a device: `mujoco.batch` for "cpu", MuJoCo Warp for "cuda" or "cuda:N".

    Raises:
        DeviceUnavailableError: If CUDA is asked for and absent.
        UnknownNameError: If the device is of another type.
    """
    kind = device.split(":")[0]
    if kind == "cpu":
        from pixel2catch.sim.batch import BatchSimulation

        return BatchSimulation(model, num_envs)
    if kind == "cuda":
        require_cuda(device)
        from pixel2catch.sim.warp import WarpSimulation

        return WarpSimulation(model, num_envs, device)
    raise UnknownNameError("device", device, ("cpu", "cuda", "cuda:0", "cuda:1"))


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
