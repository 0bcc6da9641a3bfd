"""CPU threads of PyTorch that sleep while they have no work."""

import os
from math import ceil
from threading import Event, Thread

import torch

from pixel2catch import WAITS_IN_A_LOOP

MOST_SLEEPERS = 16  #: Most sleeping threads that are created; if more are needed, none are. Source: ours.

_sleepers: list[Thread] = []


def let_torch_sleep() -> None:
    """Let idle threads of PyTorch sleep also where PyTorch was imported before `pixel2catch`.

    OMP_WAIT_POLICY, which `pixel2catch` sets, is read when PyTorch is loaded. If it was loaded before, its
    idle threads wait in a loop and take the cores from physics. GNU OpenMP ends that loop at once while a
    process has more threads than cores: sleeping threads that each own a team of threads exceed that number.
    """
    threads, cores = torch.get_num_threads(), len(os.sched_getaffinity(0))
    count = ceil(cores / max(threads - 1, 1))
    if not WAITS_IN_A_LOOP or threads == 1 or count > MOST_SLEEPERS or _sleepers:
        return
    for _ in range(count):
        has_team = Event()
        _sleepers.append(Thread(target=_sleep, args=(has_team,), daemon=True))
        _sleepers[-1].start()
        has_team.wait()


def _sleep(has_team: Event) -> None:
    torch.ones(2**18).exp()  # large enough for all threads
    has_team.set()
    Event().wait()
