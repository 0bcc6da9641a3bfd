"""Who comes first on a busy machine; each test asks in a thread of its own, and leaves the others alone."""

import os
import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TypeVar

import pytest

from pixel2catch.deployment.recorder import ORDERS, BagRecorder
from pixel2catch.servo.link import (
    LOOP_PRIORITY,
    RECORDER_PRIORITY,
    SERVO_PRIORITY,
    give_way,
    scheduled,
    set_real_time,
)

T = TypeVar("T")


def in_thread(action: Callable[[], T]) -> T:
    with ThreadPoolExecutor(1) as thread:
        return thread.submit(action).result()


def place() -> tuple[int, int]:
    """Scheduling policy and priority of this thread."""
    return os.sched_getscheduler(0), os.sched_getparam(0).sched_priority


def real_time_place() -> tuple[int, int]:
    set_real_time(LOOP_PRIORITY)
    return place()


USUAL, FIRST = (os.SCHED_OTHER, 0), (os.SCHED_FIFO, LOOP_PRIORITY)
needs_permission = pytest.mark.skipif(in_thread(real_time_place) != FIRST, reason="the system refuses it")


def test_the_servo_comes_before_the_policy_and_the_recording_last():
    assert SERVO_PRIORITY > LOOP_PRIORITY > RECORDER_PRIORITY > 0


def test_who_is_no_real_time_thread_stays_none():
    def action() -> tuple[int, int]:
        give_way(RECORDER_PRIORITY)
        with scheduled(os.SCHED_OTHER, 0) as is_granted:
            assert is_granted
        return place()

    assert in_thread(action) == USUAL


@needs_permission
def test_what_is_started_as_others_is_no_real_time_process():
    def action() -> tuple[str, tuple[int, int]]:
        set_real_time(LOOP_PRIORITY)
        with scheduled(os.SCHED_OTHER, 0):
            asked = [sys.executable, "-c", "import os; print(os.sched_getscheduler(0))"]
            said = subprocess.run(asked, check=True, capture_output=True, text=True).stdout
        return said.strip(), place()

    assert in_thread(action) == (str(os.SCHED_OTHER), FIRST)


@needs_permission
def test_the_recorder_gives_way_to_who_made_it(tmp_path: Path):
    places: list[tuple[int, int]] = []

    def note(data: bytes) -> bytes:
        places.append(place())
        return data

    def action() -> None:
        set_real_time(LOOP_PRIORITY)
        with BagRecorder(tmp_path / "recording") as recorder:
            recorder.record(ORDERS, bytes(16), 1.0, note)

    in_thread(action)
    assert places == [(os.SCHED_FIFO, RECORDER_PRIORITY)]
