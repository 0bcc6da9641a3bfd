"""The CPU back end: `mujoco.batch`, all cores, float64."""

import os
import warnings
from typing import final

import mujoco
import numpy as np
import torch
from mujoco.batch import MODEL_FIELDS, Batch
from torch import Tensor

from pixel2catch.batches import Flags
from pixel2catch.errors import InvalidValueError
from pixel2catch.sim.simulation import Distances, Field, Groups, Places, Rays, Simulation

BYTES_PER_ENV = 250_000  #: Memory of an environment [bytes]. Source: ours, measured with 1,000 environments.

SEEN_FIELDS = (
    *("geom_type", "geom_dataid", "geom_pos", "geom_quat", "geom_size", "geom_aabb", "geom_rbound"),
    *("body_pos", "body_quat", "jnt_pos", "jnt_axis"),
)
"""Model fields that affect rays."""

_VELOCITY_STAGE = int(mujoco.mjtStage.mjSTAGE_VEL)


@final
class BatchSimulation(Simulation):
    """`mujoco.batch.Batch`, one `MjData` per environment.

    Results are bit-identical at any number of threads.
    """

    def __init__(self, model: mujoco.MjModel, num_envs: int, num_threads: int = 0) -> None:
        """Create the environments at the model's defaults; 0 threads means one for each processor."""
        super().__init__(model, num_envs, torch.device("cpu"), torch.float64)
        fits = int(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / BYTES_PER_ENV)
        if num_envs > fits:  # the system would kill the process
            raise InvalidValueError(f"num_envs is {num_envs:,}; at most {fits:,} fit into memory.")
        num_threads = num_threads or len(os.sched_getaffinity(0))
        self._batch = Batch(model, num_envs, min(num_threads, num_envs), persistent=True)
        # Rays in the first batch would make its next step recompute positions and contacts.
        self._rays = Batch(model, num_envs, min(num_threads, num_envs))

    def bind(self, field: str) -> Field:
        return _as_tensor(self._batch.bind(field))

    def expand(self, field: str) -> Field:
        return _as_tensor(self._batch.expand(field))

    def can_expand(self, field: str) -> bool:
        return field in MODEL_FIELDS

    def step(self, mask: Flags | None = None) -> None:
        ids = None if mask is None else mask.numpy().nonzero()[0]
        self._batch.step(ids, stage=_VELOCITY_STAGE)

    def forward(self, mask: Flags | None = None) -> None:
        self._batch.forward(None if mask is None else mask.numpy(), stage=_VELOCITY_STAGE)

    def ray(self, origin: Places, directions: Rays, groups: Groups, mask: Flags | None = None) -> Distances:
        geomgroup = np.isin(np.arange(mujoco.mjNGROUP), groups).astype(np.uint8)
        ids = np.arange(self.num_envs) if mask is None else mask.numpy().nonzero()[0]
        self._rays.bind("qpos")[:] = self._batch.bind("qpos")
        for name in SEEN_FIELDS:
            if (values := self._batch.expanded(name)) is not None:
                self._rays.expand(name)[:] = values
        distance = np.full(directions.shape[:2], -1.0)
        distance[ids], _ = self._rays.ray(
            origin.expand(self.num_envs, 3).numpy()[ids, None],
            directions.numpy()[ids],
            geomgroup=geomgroup,
            ids=ids,
        )
        return torch.from_numpy(distance)


def _as_tensor(array: np.ndarray) -> Tensor:
    """Return a tensor that shares the memory of an array, read-only or not."""
    with warnings.catch_warnings(action="ignore"):  # of PyTorch about arrays that are read-only
        return torch.from_numpy(array)
