"""The GPU back end: MuJoCo Warp, float32, each physics step one CUDA graph.

A step copies nothing to the host. PyTorch and Warp use the same stream, so that each reads what the other has
written.
"""

import copy
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import reduce
from operator import or_
from typing import Any, final, no_type_check

import mujoco
import mujoco_warp as mjw
import numpy as np
import torch
import warp as wp
from mujoco_warp._src.ray import _ray_geom_mesh
from mujoco_warp._src.types import vec6
from torch import Tensor

from pixel2catch.batches import Flags
from pixel2catch.errors import NonFiniteError
from pixel2catch.sim.graphs import GraphedFunction
from pixel2catch.sim.simulation import Distances, Field, Groups, Places, Rays, Result, Simulation

CONTACTS_PER_DOF = 1.6
"""Contacts to allocate per environment and degree of freedom, in one pool for all environments. Source: ours;
8,192 robots with random actions and 25 degrees of freedom used 3.4 per environment."""

CONSTRAINTS_PER_DOF = 8.0
"""Constraint rows to allocate per environment and degree of freedom. Source: ours; 8,192 robots with random
actions used at most 45, 120 with an object of 28 cm in the hand, two robots in training more than 160."""

CONTACTS_PER_SENSOR = 32
"""Contacts among which a contact sensor selects. Source: ours; 8,192 robots with random actions had at most
15 contacts each. MuJoCo Warp's default of 64 costs a tenth of a control step in sorting."""

SORT_BLOCK = 32
"""Threads that sort the contacts of a sensor. Source: ours; Warp's default, 64, takes twice as long."""

_HARMLESS = int(
    mjw.OverflowType.ITERATIONS
    | mjw.OverflowType.LS_ITERATIONS
    | mjw.OverflowType.CONTACT_MATCH  # affects the choice of a sensor only
)


@final
class WarpSimulation(Simulation):
    """MuJoCo Warp on one CUDA device, or for tests on Warp's CPU device, which is slow."""

    def __init__(self, model: mujoco.MjModel, num_envs: int, device: str) -> None:
        """Copy the model to the device and create the environments at its defaults."""
        kind, _, index = device.partition(":")
        super().__init__(model, num_envs, torch.device(kind, int(index or 0)), torch.float32)
        wp.config.log_level = wp.LOG_WARNING
        wp.init()
        self._device = wp.device_from_torch(self.device)
        if self._device.is_cuda:
            wp.set_stream(wp.stream_from_torch(torch.cuda.current_stream(self.device)), self._device)
        accepted = copy.copy(model)
        accepted.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_MIDPHASE)  # affects the CPU only
        with wp.ScopedDevice(self._device):
            self._model = mjw.put_model(accepted)
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

    def bind(self, field: str) -> Field:
        shape = np.shape(getattr(mujoco.MjData(self.model), field))
        return wp.to_torch(getattr(self._data, field)).view(self.num_envs, *shape)

    def expand(self, field: str) -> Field:
        array = getattr(self._model, field)
        if array.shape[0] != self.num_envs:
            rows = np.repeat(array.numpy(), self.num_envs, axis=0)
            array = wp.array(rows, dtype=array.dtype, device=self._device)
            setattr(self._model, field, array)
            self._recorded_step = self._recorded(self._step)  # the old recording has the old address
        return wp.to_torch(array).view(self.num_envs, *np.shape(getattr(self.model, field)))

    def can_expand(self, field: str) -> bool:
        return hasattr(self._model, field) and getattr(self._model, field).shape[0] in (1, self.num_envs)

    def step(self, mask: Flags | None = None) -> None:
        if not self._device.is_cuda or torch.cuda.is_current_stream_capturing():
            self._step()
        else:
            self._recorded_step()

    def forward(self, mask: Flags | None = None) -> None:
        """Update the bound fields of every environment.

        With a mask, collision detection, a tenth of a control step, is skipped: contacts of other
        environments are current, and those of the masked ones are found in the next physics step.
        """
        with wp.ScopedDevice(self._device):
            if mask is not None:
                contact = self._data.contact
                is_masked = mask[wp.to_torch(contact.worldid).long()]
                wp.to_torch(contact.dist).masked_fill_(is_masked, torch.inf)
            self._model.opt.run_collision_detection = mask is None
            mjw.step1(self._model, self._data)
            self._model.opt.run_collision_detection = True

    def ray(self, origin: Places, directions: Rays, groups: Groups, mask: Flags | None = None) -> Distances:
        with wp.ScopedDevice(self._device):
            return _cast_rays(self._model, self._data, origin, directions, groups)

    def record(
        self, function: Callable[[Tensor], Result], generator: torch.Generator
    ) -> Callable[[Tensor], Result]:
        """Return a CUDA graph of the function, captured after two calls that compile its kernels."""
        return self._recorded(function, generator) if self._device.is_cuda else function

    def check(self) -> None:
        """Raise if an environment overflowed its contact or constraint buffers."""
        overflow = wp.to_torch(self._data.overflow) & ~_HARMLESS
        if flags := reduce(or_, torch.unique(overflow).tolist(), 0):
            raise NonFiniteError(
                f"MuJoCo Warp dropped contacts or constraints ({mjw.OverflowType(flags)!r}) in "
                f"{int((overflow != 0).sum())} environments; raise CONTACTS_PER_DOF or CONSTRAINTS_PER_DOF."
            )

    def close(self) -> None:
        self._recorded_step = self._step

    def _recorded(
        self, function: Callable[..., Any], generator: torch.Generator | None = None
    ) -> GraphedFunction[Any]:
        return GraphedFunction(
            function,
            device=self.device,
            num_eager_calls=2,  # the first compiles kernels, the second allocates
            is_aside=False,
            generator=generator,
            around=self._captured_by_warp,
        )

    @contextmanager
    def _captured_by_warp(self) -> Iterator[None]:
        """Add Warp to a capture that PyTorch has begun on its current stream."""
        stream = wp.stream_from_torch(torch.cuda.current_stream(self.device))
        with wp.ScopedStream(stream), wp.ScopedCapture(stream=stream, external=True):
            yield

    def _step(self) -> None:
        """Run the second half of this step and the first half of the next, which updates the sensors."""
        with wp.ScopedDevice(self._device):
            mjw.step2(self._model, self._data)
            mjw.step1(self._model, self._data)


_Vec3: Any = wp.vec3


# fmt: off
@wp.kernel(enable_backward=False)
@no_type_check  # Warp reads the annotations
def _nearest(
    num_geoms: int,
    nmeshface: int, body_weldid: wp.array[int], geom_type: wp.array[int], geom_bodyid: wp.array[int],
    geom_dataid: wp.array2d[int], geom_matid: wp.array2d[int], geom_group: wp.array[int],
    geom_size: wp.array2d[wp.vec3], geom_rgba: wp.array2d[wp.vec4],
    mesh_vertadr: wp.array[int], mesh_faceadr: wp.array[int],
    mesh_vert: wp.array[wp.vec3], mesh_face: wp.array[wp.vec3i],
    hfield_size: wp.array[wp.vec4], hfield_nrow: wp.array[int], hfield_ncol: wp.array[int],
    hfield_adr: wp.array[int], hfield_data: wp.array[float], mat_rgba: wp.array2d[wp.vec4],
    geom_xpos: wp.array2d[wp.vec3], geom_xmat: wp.array2d[wp.mat33],
    groups: vec6,
    num_origins: int,
    origin: wp.array[wp.vec3],
    directions: wp.array2d[wp.vec3],
    distance: wp.array2d[float],
):
    env, ray = wp.tid()
    nearest = float(-1.0)  # noqa: UP018 (a variable, to Warp)
    for geom in range(num_geoms):
        hit, _ = _ray_geom_mesh(
            nmeshface, body_weldid, geom_type, geom_bodyid, geom_dataid, geom_matid, geom_group, geom_size,
            geom_rgba, mesh_vertadr, mesh_faceadr, mesh_vert, mesh_face, hfield_size, hfield_nrow,
            hfield_ncol, hfield_adr, hfield_data, mat_rgba, geom_xpos, geom_xmat,
            env, origin[wp.min(env, num_origins - 1)], directions[env, ray], groups, True, -1, geom,
        )
        if hit >= 0.0 and (nearest < 0.0 or hit < nearest):
            nearest = hit
    distance[env, ray] = nearest
# fmt: on


def _cast_rays(
    model: mjw.Model, data: mjw.Data, origin: Places, directions: Rays, groups: Groups
) -> Distances:
    """Cast rays with one thread each; MuJoCo Warp's own function takes a block of threads for a ray."""
    num_envs, num_rays, _ = directions.shape
    origins = origin.to(directions).view(-1, 3).contiguous()
    distance = torch.empty(num_envs, num_rays, device=directions.device)
    fields = (
        *("nmeshface", "body_weldid", "geom_type", "geom_bodyid", "geom_dataid", "geom_matid", "geom_group"),
        *("geom_size", "geom_rgba", "mesh_vertadr", "mesh_faceadr", "mesh_vert", "mesh_face", "hfield_size"),
        *("hfield_nrow", "hfield_ncol", "hfield_adr", "hfield_data", "mat_rgba"),
    )
    wp.launch(
        _nearest,
        dim=(num_envs, num_rays),
        inputs=[
            model.ngeom,
            *(getattr(model, name) for name in fields),
            data.geom_xpos,
            data.geom_xmat,
            vec6(*(float(group in groups) for group in range(mujoco.mjNGROUP))),
            len(origins),
            wp.from_torch(origins, dtype=_Vec3),
            wp.from_torch(directions.contiguous(), dtype=_Vec3),
        ],
        outputs=[wp.from_torch(distance)],
    )
    return distance
