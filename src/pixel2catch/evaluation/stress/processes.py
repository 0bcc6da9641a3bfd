"""Calling a function many times at once, in processes of one thread each."""

import os
import signal
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing import get_context, parent_process
from threading import Thread
from typing import Any, TypeVar

from pixel2catch.errors import StudyError

Result = TypeVar("Result")

THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
"""What libraries read, as they are loaded, for the number of their threads."""


def in_processes(
    jobs: int, function: Callable[..., Result], calls: Sequence[tuple[Any, ...]]
) -> Iterator[tuple[int, Result]]:
    """Yield number and result of every call as soon as it is done.

    The processes are new ones, and end with this one or with the first error.

    Args:
        jobs: Most processes.
        function: What is called: a function of a module.
        calls: Its arguments.

    Raises:
        StudyError: If a process was ended from outside.
    """
    context = get_context("spawn")
    pool = ProcessPoolExecutor(min(jobs, len(calls)), mp_context=context, initializer=_begin)
    try:
        with _one_thread_each():
            numbers = {pool.submit(function, *call): number for number, call in enumerate(calls)}
        for future in as_completed(numbers):
            yield numbers[future], future.result()
    except BrokenProcessPool as error:
        raise StudyError(
            f"one of {jobs} processes was ended from outside; if memory was short, give fewer --jobs. What "
            "was finished is kept: the same command goes on from there."
        ) from error
    finally:
        pool.shutdown(cancel_futures=True)


def _begin() -> None:
    """Prepare a process."""
    import torch

    signal.signal(signal.SIGINT, signal.SIG_DFL)  # Ctrl-C ends it without a word of its own
    torch.set_num_threads(1)
    Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


@contextmanager
def _one_thread_each() -> Iterator[None]:
    """Processes that begin here load libraries with one thread each."""
    before = {name: os.environ.get(name) for name in THREADS}
    os.environ.update(dict.fromkeys(THREADS, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
