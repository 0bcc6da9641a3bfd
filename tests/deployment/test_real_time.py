"""Priorities on a busy machine; each test changes those of its own thread."""

import os
import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TypeVar

import pytest

from pixel2catch.deployment.recorder import TARGETS, BagRecorder
from pixel2catch.servo.link import LOOP_PRIORITY, RECORDER_PRIORITY, give_way, scheduled, set_real_time

T = TypeVar("T")


def in_thread(action: Callable[[], T]) -> T:
    with ThreadPoolExecutor(1) as thread:
        return thread.submit(action).result()


def place() -> tuple[int, int]:
    """Scheduling policy and priority of this thread."""
    return os.sched_getscheduler(0), os.sched_getparam(0).sched_priority


USUAL, FIRST = (os.SCHED_OTHER, 0), (os.SCHED_FIFO, LOOP_PRIORITY)
is_permitted = in_thread(lambda: (set_real_time(LOOP_PRIORITY), place())[1]) == FIRST
needs_permission = pytest.mark.skipif(not is_permitted, reason="the system refuses it")


def test_a_usual_thread_stays_one():
    def action() -> tuple[int, int]:
        give_way(RECORDER_PRIORITY)
        with scheduled(os.SCHED_OTHER, 0) as is_granted:
            assert is_granted
        return place()

    assert in_thread(action) == USUAL


@needs_permission
def test_a_process_started_as_usual_has_no_real_time_priority():
    def action() -> tuple[str, tuple[int, int]]:
        set_real_time(LOOP_PRIORITY)
        with scheduled(os.SCHED_OTHER, 0):
            command = [sys.executable, "-c", "import os; print(os.sched_getscheduler(0))"]
            output = subprocess.run(command, check=True, capture_output=True, text=True).stdout
        return output.strip(), place()

    assert in_thread(action) == (str(os.SCHED_OTHER), FIRST)


@needs_permission
def test_the_recorder_has_a_lower_priority_than_its_maker(tmp_path: Path):
    places: list[tuple[int, int]] = []

    def note(data: bytes) -> bytes:
        places.append(place())
        return data

    def action() -> None:
        set_real_time(LOOP_PRIORITY)
        with BagRecorder(tmp_path / "recording") as recorder:
            recorder.record(TARGETS, bytes(16), 1.0, note)

    in_thread(action)
    assert places == [(os.SCHED_FIFO, RECORDER_PRIORITY)]
