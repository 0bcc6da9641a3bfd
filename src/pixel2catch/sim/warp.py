"""The GPU back end: MuJoCo Warp, float32, each physics step one CUDA graph.

Nothing here copies to the host inside a step. PyTorch and Warp work on the same stream, so that tensors
written by one are read by the other in order.
"""

import copy
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, final

import mujoco
import mujoco_warp as mjw
import numpy as np
import torch
import warp as wp
from jaxtyping import Bool, Float, Shaped
from torch import Tensor

from pixel2catch.errors import NonFiniteError
from pixel2catch.sim import warp_rays
from pixel2catch.sim.graphs import GraphedFunction
from pixel2catch.sim.simulation import Result, Simulation

CONTACTS_PER_DOF = 1.6
"""Contacts to allocate per environment and degree of freedom, shared by all environments (ours: 8,192 random
robots of one arm and one hand, 25 degrees of freedom with the object, used 3.4 an environment)."""

CONSTRAINTS_PER_DOF = 8.0
"""Constraint rows to allocate per environment and degree of freedom (ours: 8,192 random robots of one arm and
one hand used 45 at the most, 120 with an object of 28 cm in the hand; two arms and two hands that learn once
needed more than 160)."""

CONTACTS_PER_SENSOR = 32
"""Contacts that a contact sensor chooses from. Source: ours: 8,192 random robots had 15 contacts at the most
in all; sorting MuJoCo Warp's 64 took 1.1 of 11 ms of kernels in a control step of theirs (H100)."""

SORT_BLOCK = 32
"""Threads that sort the contacts of a sensor. Source: ours: with MuJoCo Warp's 64 they take 1.16 instead of
0.58 ms of a control step of 8,192 environments (H100)."""

_HARMLESS = int(
    mjw.OverflowType.ITERATIONS
    | mjw.OverflowType.LS_ITERATIONS
    | mjw.OverflowType.CONTACT_MATCH  # a sensor misses nothing else
)


@final
class WarpSimulation(Simulation):
    """MuJoCo Warp on one CUDA device (or on Warp's CPU device, which is slow and serves in tests)."""

    def __init__(self, model: mujoco.MjModel, num_envs: int, device: str) -> None:
        """Put the model on the device and create the environments at its defaults."""
        kind, _, index = device.partition(":")
        super().__init__(model, num_envs, torch.device(kind, int(index or 0)), torch.float32)
        wp.config.log_level = wp.LOG_WARNING
        wp.init()
        self._device = wp.device_from_torch(self.device)
        if self._device.is_cuda:
            wp.set_stream(wp.stream_from_torch(torch.cuda.current_stream(self.device)), self._device)
        with wp.ScopedDevice(self._device):
            self._model = mjw.put_model(_without_cpu_flags(model))
            self._model.block_dim.contact_sort = SORT_BLOCK
            self._model.opt.contact_sensor_maxmatch = CONTACTS_PER_SENSOR
            self._model.opt.warn_overflow &= ~_HARMLESS
            self._data = mjw.make_data(
                model,
                num_envs,
                nconmax=round(CONTACTS_PER_DOF * model.nv),
                njmax=round(CONSTRAINTS_PER_DOF * model.nv),
            )
        self._recorded_step = self._recorded(self._step)

    def bind(self, field: str) -> Shaped[Tensor, "num_envs ..."]:  # noqa: D102 (documented in the interface)
        shape = np.shape(getattr(mujoco.MjData(self.model), field))
        return wp.to_torch(getattr(self._data, field)).view(self.num_envs, *shape)

    def expand(self, field: str) -> Shaped[Tensor, "num_envs ..."]:  # noqa: D102
        array = getattr(self._model, field)
        if array.shape[0] != self.num_envs:
            rows = np.repeat(array.numpy(), self.num_envs, axis=0)
            array = wp.array(rows, dtype=array.dtype, device=self._device)
            setattr(self._model, field, array)
            self._recorded_step = self._recorded(self._step)  # it held the address of the shared values
        return wp.to_torch(array).view(self.num_envs, *np.shape(getattr(self.model, field)))

    def can_expand(self, field: str) -> bool:  # noqa: D102
        return hasattr(self._model, field) and getattr(self._model, field).shape[0] in (1, self.num_envs)

    def step(self) -> None:  # noqa: D102
        if not self._device.is_cuda or torch.cuda.is_current_stream_capturing():
            self._step()
        else:
            self._recorded_step()

    def forward(self, mask: Bool[Tensor, " num_envs"] | None = None) -> None:
        """Make bound fields current; for every environment, since that is what one launch computes.

        Where a mask is given, contacts are not looked for: those of others are known, and those of the masked
        environments, a tenth of the work of a control step, are found in the next physics step.
        """
        with wp.ScopedDevice(self._device):
            if mask is not None:
                contact = self._data.contact
                is_masked = mask[wp.to_torch(contact.worldid).long()]
                wp.to_torch(contact.dist).masked_fill_(is_masked, torch.inf)
            self._model.opt.run_collision_detection = mask is None
            mjw.step1(self._model, self._data)
            self._model.opt.run_collision_detection = True

    def ray(  # noqa: D102
        self,
        origin: Float[Tensor, "3"],
        directions: Float[Tensor, "num_envs num_rays 3"],
        groups: tuple[int, ...],
        mask: Bool[Tensor, " num_envs"] | None = None,
    ) -> Float[Tensor, "num_envs num_rays"]:
        with wp.ScopedDevice(self._device):
            return warp_rays.cast(self._model, self._data, origin, directions, groups)

    def record(
        self, function: Callable[[Tensor], Result], generator: torch.Generator
    ) -> Callable[[Tensor], Result]:
        """A CUDA graph of the function, captured at the second call; the first compiles its kernels."""
        return self._recorded(function, generator) if self._device.is_cuda else function

    def check(self) -> None:
        """Raise if an environment overflowed its contact or constraint buffers.

        Raises:
            NonFiniteError: Naming what overflowed, and how many environments lost it.
        """
        overflow = wp.to_torch(self._data.overflow) & ~_HARMLESS
        flags = int(torch.unique(overflow).sum().item()) if bool(overflow.any()) else 0
        if flags:
            raise NonFiniteError(
                f"MuJoCo Warp dropped contacts or constraints ({mjw.OverflowType(flags)!r}) in "
                f"{int((overflow != 0).sum())} environments; raise CONTACTS_PER_DOF or CONSTRAINTS_PER_DOF"
            )

    def close(self) -> None:  # noqa: D102
        self._recorded_step = self._step

    def _recorded(
        self, function: Callable[..., Any], generator: torch.Generator | None = None
    ) -> GraphedFunction[Any]:
        """A CUDA graph of PyTorch's and Warp's work."""
        return GraphedFunction(
            function,
            device=self.device,
            num_eager_calls=2,  # the first compiles kernels, the second finds all that it needs
            is_aside=False,
            generator=generator,
            around=self._captured_by_warp,
        )

    @contextmanager
    def _captured_by_warp(self) -> Iterator[None]:
        """Let Warp take part in a capture that PyTorch has begun on its current stream."""
        stream = wp.stream_from_torch(torch.cuda.current_stream(self.device))
        with wp.ScopedStream(stream), wp.ScopedCapture(stream=stream, external=True):
            yield

    def _step(self) -> None:
        """Second half of this step, first half of the next: positions and sensors are then current."""
        with wp.ScopedDevice(self._device):
            mjw.step2(self._model, self._data)
            mjw.step1(self._model, self._data)


def _without_cpu_flags(model: mujoco.MjModel) -> mujoco.MjModel:
    """The model without options that only say how the CPU finds contacts."""
    model = copy.copy(model)
    model.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_MIDPHASE)
    return model
