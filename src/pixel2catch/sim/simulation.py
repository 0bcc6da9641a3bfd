"""The interface of all back ends, in MuJoCo's own verbs.

    simulation = make_simulation(model, num_envs=256, device="cpu")  # sim.factory
    qpos, ctrl = simulation.bind("qpos"), simulation.bind("ctrl")
    qpos[:] = start                 # a state field is live: what is written is the state
    simulation.forward()            # makes positions, velocities and sensors of that state current
    for _ in range(steps):
        ctrl[:] = targets
        simulation.step()           # one physics step; every bound field is current again

`mujoco.batch` computes in float64 on the CPU, MuJoCo Warp in float32 on the GPU: `dtype` says which, and
callers cast once, where they take a snapshot.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import TypeVar

import mujoco
import torch
from jaxtyping import Bool, Float, Shaped
from torch import Tensor

from pixel2catch.errors import InvalidValueError

Result = TypeVar("Result")

MAX_GEOM_GROUPS = mujoco.mjNGROUP


class Simulation(ABC):
    """`num_envs` independent copies of one MuJoCo model on one device."""

    def __init__(
        self, model: mujoco.MjModel, num_envs: int, device: torch.device, dtype: torch.dtype
    ) -> None:
        """Store what all back ends share.

        Raises:
            InvalidValueError: If `num_envs` is not positive.
        """
        if num_envs < 1:
            raise InvalidValueError(f"num_envs is {num_envs}; it must be at least 1")
        self.model = model  #: The model that every environment starts from.
        self.num_envs = num_envs
        self.device = device  #: Where bound and expanded tensors live.
        self.dtype = dtype  #: Their floating-point type.

    @abstractmethod
    def bind(self, field: str) -> Shaped[Tensor, "num_envs ..."]:
        """Live tensor of an `MjData` field, named and shaped as in MuJoCo.

        `qpos`, `qvel`, `ctrl` and `qacc_warmstart` are the state, `xfrc_applied` and `qfrc_applied` are
        inputs: a write takes effect at the next call. After one to `qpos` or `qvel` that call must be
        `forward`: MuJoCo Warp begins a step with the forces of the speeds that it knows. Every other field is
        an output.
        """

    @abstractmethod
    def expand(self, field: str) -> Shaped[Tensor, "num_envs ..."]:
        """Live per-environment values of an `MjModel` field; a write takes effect at the next call."""

    @abstractmethod
    def can_expand(self, field: str) -> bool:
        """Whether the back end has an `MjModel` field that can differ between environments.

        Both have all that describe a model; each has some of its own that are derived from them.
        """

    @abstractmethod
    def step(self) -> None:
        """Advance every environment by one physics step; bound fields then describe the new state."""

    @abstractmethod
    def forward(self, mask: Bool[Tensor, " num_envs"] | None = None) -> None:
        """Make the bound fields current after writes to the state of the masked environments, or of all.

        What masked ones touch may be found in the next step only, as if they touched nothing until then.
        """

    @abstractmethod
    def ray(
        self,
        origin: Float[Tensor, "3"],
        directions: Float[Tensor, "num_envs num_rays 3"],
        groups: tuple[int, ...],
        mask: Bool[Tensor, " num_envs"] | None = None,
    ) -> Float[Tensor, "num_envs num_rays"]:
        """Distance to the nearest geom along each ray in units of the direction's length, -1 for a miss.

        Rays begin at a common origin [m] and hit geoms of some groups; origin and directions are in the world
        frame. Those outside the mask may be left out, and miss then.
        """

    def record(
        self, function: Callable[[Tensor], Result], generator: torch.Generator
    ) -> Callable[[Tensor], Result]:
        """A function that does what `function` does, at the least cost for the host.

        The function steps the simulation, draws from the generator and works on tensors whose memory stays
        where it is. Returned is itself, where there is nothing to save, or a recording of its work on the
        device, whose next call overwrites the results.
        """
        return function

    def check(self) -> None:  # noqa: B027 (nothing is lost where arrays grow as needed)
        """Raise if contacts or constraints were lost since the last check; waits for the device."""

    def close(self) -> None:  # noqa: B027 (threads end with their object)
        """Free what the back end holds."""
