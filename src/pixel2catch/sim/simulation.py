"""The interface of all back ends, with MuJoCo's verbs.

    simulation = make_simulation(model, num_envs=256, device="cpu")  # sim.factory
    qpos, ctrl = simulation.bind("qpos"), simulation.bind("ctrl")
    qpos[:] = start                 # a bound state field is the state
    simulation.forward()            # updates positions, velocities and sensors
    for _ in range(steps):
        ctrl[:] = targets
        simulation.step()           # one physics step; updates every bound field

`mujoco.batch` computes in float64 on the CPU, MuJoCo Warp in float32 on the GPU; `dtype` is the type. Callers
cast once, when they take a snapshot.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import TypeVar

import mujoco
import torch
from jaxtyping import Float, Shaped
from torch import Tensor

from pixel2catch.batches import Flags

Result = TypeVar("Result")

Groups = tuple[int, ...]  #: Groups of geoms.
Field = Shaped[Tensor, "num_envs ..."]  #: Of MuJoCo's data or model.
Places = Float[Tensor, "*num_envs 3"]  #: One for all environments, or one for each.
Rays = Float[Tensor, "num_envs num_rays 3"]
Distances = Float[Tensor, "num_envs num_rays"]


class Simulation(ABC):
    """`num_envs` independent copies of one MuJoCo model on one device."""

    def __init__(
        self, model: mujoco.MjModel, num_envs: int, device: torch.device, dtype: torch.dtype
    ) -> None:
        self.model = model  #: The common model.
        self.num_envs = num_envs
        self.device = device  #: Device of bound and expanded tensors.
        self.dtype = dtype  #: Their floating-point type.

    @abstractmethod
    def bind(self, field: str) -> Field:
        """Return the live tensor of an `MjData` field, with MuJoCo's name and shape.

        `qpos`, `qvel`, `ctrl` and `qacc_warmstart` are state, `xfrc_applied` and `qfrc_applied` are inputs: a
        write takes effect at the next call. After a write to `qpos` or `qvel` that call must be `forward`,
        as MuJoCo Warp starts a step with forces from the previous speeds. Other fields are outputs.
        """

    @abstractmethod
    def expand(self, field: str) -> Field:
        """Return live values of an `MjModel` field per environment; a write takes effect at the next call."""

    @abstractmethod
    def can_expand(self, field: str) -> bool:
        """Return whether an `MjModel` field can differ between environments.

        All back ends support the fields that describe a model; derived fields depend on the back end.
        """

    @abstractmethod
    def step(self, mask: Flags | None = None) -> None:
        """Advance every environment by one physics step; bound fields then describe the new state.

        Environments outside the mask may be left as they are.
        """

    @abstractmethod
    def forward(self, mask: Flags | None = None) -> None:
        """Update the bound fields after writes to the state of the masked environments, or of all.

        With a mask, contacts of the masked environments may be found in the next step only.
        """

    @abstractmethod
    def ray(self, origin: Places, directions: Rays, groups: Groups, mask: Flags | None = None) -> Distances:
        """Return the distance to the nearest geom along each ray in lengths of its direction, -1 for a miss.

        Origin [m], one or one for each environment, and directions are in the world frame; rays hit geoms of
        some groups. Environments outside the mask may be skipped and then miss.
        """

    def record(
        self, function: Callable[[Tensor], Result], generator: torch.Generator
    ) -> Callable[[Tensor], Result]:
        """Return the function itself, or a recording of its work on the device that costs the host less.

        The function steps the simulation, draws from the generator and uses tensors at fixed addresses. The
        next call of a recording overwrites its results.
        """
        return function

    def check(self) -> None:  # noqa: B027 (arrays of a CPU grow as needed)
        """Raise if contacts or constraints were dropped since the last check; waits for the device."""

    def close(self) -> None:  # noqa: B027 (threads end with their object)
        """Free resources."""
