"""Processes that train together, one for each GPU, and their communication.

    torchrun --nproc-per-node 2 -m pixel2catch train proposed

Every process simulates its share of the environments. Gradients, statistics and decisions are combined, so
that all hold the same networks and end at the same point; only the first process prints and writes files.
"""

import contextlib
import dataclasses
import os
import random
from collections.abc import Iterator, Sequence
from typing import final

import torch
import torch.distributed.nn  # its default arguments would keep a process group alive that is older than it
from torch import Tensor
from torch import distributed as dist

from pixel2catch.errors import InvalidValueError, Pixel2CatchError, WorkerError
from pixel2catch.learning.config import TrainCfg
from pixel2catch.own_files import in_words
from pixel2catch.sim.factory import require_cuda


@final
class Workers:
    """The process group; every process calls the same methods in the same order."""

    def __init__(self, rank: int = 0, size: int = 1, device: str = "cpu") -> None:
        self.rank = rank  #: Number of this process, from 0.
        self.size = size  #: Number of processes.
        self.device = device  #: Device of this process, "cpu" or "cuda:N".
        self.is_agreed = False  #: Whether all processes have exchanged that the training failed.

    @property
    def is_first(self) -> bool:
        """Whether this is the process that prints and writes."""
        return self.rank == 0

    def sum(self, values: Tensor) -> Tensor:
        """Return the sums over all processes; `values` is overwritten."""
        if self.size > 1:
            dist.all_reduce(values)
        return values

    def max(self, values: Tensor) -> Tensor:
        """Return the largest values of all processes; `values` is overwritten."""
        if self.size > 1:
            dist.all_reduce(values, dist.ReduceOp.MAX)
        return values

    def any(self, flag: bool) -> bool:
        """Return whether a flag is set in any process."""
        return bool(self.max(torch.tensor(float(flag))))

    def average(self, tensors: Sequence[Tensor]) -> None:
        """Replace tensors of one type by their means over all processes; nothing waits for the device.

        One collective for all of them, which can be part of a CUDA graph.
        """
        if self.size == 1:
            return
        flat = self.sum(torch.cat([tensor.flatten() for tensor in tensors])) / self.size
        parts = flat.split([tensor.numel() for tensor in tensors])
        views = [part.view_as(tensor) for tensor, part in zip(tensors, parts, strict=True)]
        torch._foreach_copy_(list(tensors), views)  # pyright: ignore[reportPrivateImportUsage] (in few launches)

    def moments(self, found: Sequence[tuple[Tensor, Tensor]], count: int) -> Sequence[tuple[Tensor, Tensor]]:
        """Return means and unbiased variances of the samples of all processes, by one exchange.

        Every process passes those of its own samples, `count` in each. Source: law of total variance.
        """
        if self.size == 1:
            return found
        means, squares = [], []
        for mean, variance in found:
            means.append(mean.to(torch.float64, copy=True))
            squares.append(variance.double() * ((count - 1) / count) + means[-1].square())
        self.average([*means, *squares])
        total = count * self.size
        joint = zip(means, squares, strict=True)
        return [(mean, (square - mean.square()) * (total / (total - 1))) for mean, square in joint]

    @contextlib.contextmanager
    def sync_errors(self) -> Iterator[None]:
        """Run work without communication; if it fails in one process, all processes end.

        WorkerError is raised in the first process, if only others failed, with their message.
        """
        failure: Exception | None = None
        try:
            yield
        except Exception as error:
            if self.size == 1:
                raise
            failure = error
        if self.size == 1 or not self.any(failure is not None):
            return
        messages: list[str | None] = [None] * self.size
        dist.all_gather_object(messages, failure and in_words(failure))
        failed = [f"process {rank}: {each}" for rank, each in enumerate(messages) if each is not None]
        self.is_agreed = True
        if failure and (self.is_first or not isinstance(failure, Pixel2CatchError)):
            raise failure
        if self.is_first:
            raise WorkerError(failed[0])
        raise SystemExit(0)

    def share(self, cfg: TrainCfg) -> TrainCfg:
        """Return the configuration of this process: its equal share of environments, device and seed."""
        if cfg.num_envs % self.size:
            raise InvalidValueError(
                f"num_envs is {cfg.num_envs}; it is split over {self.size} processes and must be a multiple "
                f"of {self.size}, such as {self.size * -(-cfg.num_envs // self.size)}."
            )
        return dataclasses.replace(
            cfg, num_envs=cfg.num_envs // self.size, device=self.device, seed=self._seed(cfg.seed)
        )

    def diverge(self, seed: int, transitions: int) -> None:
        """Seed torch differently in all processes but the first; the progress is part of the seed."""
        if not self.is_first:
            torch.manual_seed(self._seed(seed, transitions))

    def _seed(self, seed: int, *others: int) -> int:
        return seed if self.is_first else random.Random(repr((self.rank, seed, *others))).getrandbits(31)


@contextlib.contextmanager
def start_workers(device: str) -> Iterator[Workers]:
    """Join the processes that torchrun started; any other process trains alone.

    The device is "cpu" or "cuda"; a process that is alone may take any one CUDA device, such as "cuda:1".
    """
    is_alone = not dist.is_torchelastic_launched() or int(os.environ["WORLD_SIZE"]) == 1
    local = _own_device(device, None if is_alone else int(os.environ["LOCAL_RANK"]))
    if local.startswith("cuda"):
        torch.cuda.set_device(local)
    if is_alone:
        yield Workers(device=local)
        return
    # Host tensors use gloo, which detects a lost process at once and does not wait for a device.
    if local.startswith("cuda"):
        dist.init_process_group("cpu:gloo,cuda:nccl", device_id=torch.device(local))
    else:
        dist.init_process_group("gloo")
    workers = Workers(dist.get_rank(), dist.get_world_size(), local)
    try:
        yield workers
    except BaseException:
        # Destroying the group waits for the others, which do not come before a failure is exchanged.
        if workers.is_agreed:
            dist.destroy_process_group()
        raise
    dist.destroy_process_group()


def _own_device(device: str, local_rank: int | None) -> str:
    """Return the device of this process; with a local rank there are others on the machine."""
    kind, _, index = device.partition(":")
    if kind != "cuda":
        return device
    if index and local_rank is not None:
        raise InvalidValueError(f"device is '{device}', one device for several processes; use 'cuda'.")
    own = f"cuda:{int(index or local_rank or 0)}"
    require_cuda(own)
    return own
