"""The control clock of a recording: which image a controller has in every control step."""

from collections.abc import Generator, Iterable
from dataclasses import dataclass

from pixel2catch.perception.finder import CameraFrame
from pixel2catch.robot.constants import CONTROL_DT

PHASE = 0.5
"""Control steps from the first image to the first tick. Source: ours; half a step, so that no jitter of a
camera of 30 Hz makes a tick miss its image."""

LONGEST_PAUSE = 150
"""Ticks without a new image that a pause in a recording makes at most: 5 s. Source: ours."""


@dataclass(frozen=True, kw_only=True)
class Tick:
    """One control step.

    Attributes:
        frame: The newest image; in the step before it may have been the same.
        now: The time [s], of the clock of the stamps.
    """

    frame: CameraFrame
    now: float


def on_control_clock(frames: Iterable[CameraFrame], notes: list[str]) -> Generator[Tick, None, None]:
    """Yield a tick in every control step of a recording; of several new images it has the newest.

    Args:
        frames: Images in the order of the recording.
        notes: Gets what is wrong with their stamps.
    """
    newest, num_older, start = None, 0, 0.0
    tick = 0
    for frame in frames:
        if newest is not None and not frame.stamp > newest.stamp:
            num_older += 1
            continue
        start = frame.stamp if newest is None else start
        due = _num_ticks(frame.stamp - start)
        if due - tick > LONGEST_PAUSE:
            notes.append(
                f"{(due - tick) * CONTROL_DT:.1f} s without an image after {tick * CONTROL_DT:.1f} s."
            )
            tick = due - LONGEST_PAUSE
        while newest is not None and tick < due:
            yield Tick(frame=newest, now=start + (tick + PHASE) * CONTROL_DT)
            tick += 1
        newest = frame
    if newest is not None:
        yield Tick(frame=newest, now=start + (tick + PHASE) * CONTROL_DT)
    if num_older:
        notes.append(f"images no newer than those before them, passed over: {num_older}.")


def _num_ticks(elapsed: float) -> int:
    """Ticks before a time since the first image [s]."""
    return max(int(elapsed / CONTROL_DT + 1.0 - PHASE), 0)
