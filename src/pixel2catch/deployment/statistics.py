"""What a deployment says of itself while it runs, and afterwards."""

from collections import Counter, deque
from dataclasses import dataclass, field
from math import inf
from typing import Any

import numpy as np

from pixel2catch.camera.image import Box, Verdict
from pixel2catch.deployment.sight import Sight
from pixel2catch.scene.constants import CONTROL_DT
from pixel2catch.servo.link import Clamp, Command, Fault, JointTargets, Mode, flag_names

BIN, LONGEST = 5e-5, 0.5  #: Width of a histogram's bins, and what the last one holds from [s]. Source: ours.
NUM_MS = round(1e-3 / BIN)  #: Bins of a millisecond.
PERCENTAGES = (50, 90, 95, 99)  #: Of durations, in a summary.
STAGES = ("received", "begun", "looked", "decided")
"""What happens to an image: it arrives, perception begins and ends, and its command is given to the servo."""

ACTIVE = (int(Mode.ARMED), int(Mode.RAMP), int(Mode.RUN))


class Histogram:
    """Counts durations, however many; a percentile is the mean of the bin that it is in."""

    def __init__(self) -> None:
        """Begin with none."""
        self._counts = np.zeros(round(LONGEST / BIN) + 1, dtype=np.int64)
        self._sums, self._longest = np.zeros(len(self._counts)), 0.0

    def count(self, duration: float) -> None:
        """Count a duration [s]."""
        place = min(max(int(duration / BIN), 0), len(self._counts) - 1)
        self._counts[place] += 1
        self._sums[place] += duration
        self._longest = max(self._longest, duration)

    def milliseconds(self, *percentages: int) -> dict[str, float] | None:
        """Percentiles, the longest duration and how many there were [ms]; none if there were none."""
        total = np.cumsum(self._counts)
        if not total[-1]:
            return None
        places = np.searchsorted(total, 0.01 * np.array(percentages) * total[-1])
        values = self._sums[places] / self._counts[places]
        named = {f"p{q}": 1e3 * value for q, value in zip(percentages, values.tolist(), strict=True)}
        return {**named, "max": 1e3 * self._longest, "count": int(total[-1])}

    @property
    def by_ms(self) -> list[int]:
        """How many durations there were of 0 to 1 ms, 1 to 2 ms, and so on, up to the longest."""
        starts = np.arange(0, len(self._counts), NUM_MS)
        return np.trim_zeros(np.add.reduceat(self._counts, starts), "b").tolist()


@dataclass(kw_only=True)
class RunStatistics:
    """Counts what happens, from control step to control step."""

    num_steps: int = 0  #: Control steps in which the robot was armed or moved; only these count.
    num_missed: int = 0  #: Control steps for which no new image had come, or been looked at, in time.
    num_overruns: int = 0  #: Control steps whose image took longer than one.
    stops: Counter[str] = field(default_factory=Counter)  #: How often the robot was stopped, by the reasons.
    #: How often it could not be armed, by the reasons.
    refusals: Counter[str] = field(default_factory=Counter)
    #: Servo ticks in which a command was held back, by what.
    clamps: Counter[str] = field(default_factory=Counter)
    stop_requests: Counter[str] = field(default_factory=Counter)  #: Messages that asked to stop, by who sent.
    #: Prompts that were not heeded, by who sent.
    refused_prompts: Counter[str] = field(default_factory=Counter)
    num_ticks: int = 0  #: Servo ticks heard of.
    num_late_ticks: int = 0  #: Servo ticks that came more than a tick late.
    _latencies: Histogram = field(default_factory=Histogram)
    _stages: dict[str, Histogram] = field(default_factory=lambda: {name: Histogram() for name in STAGES})
    _thinking: Histogram = field(default_factory=Histogram)
    _ticks: Histogram = field(default_factory=Histogram)
    _latency: float | None = None
    _sent: deque[tuple[float, float]] = field(default_factory=lambda: deque(maxlen=8))
    _last: Command | None = None
    _refused: int = 0
    _clamped: int = 0

    def count_step(self, *, took: float, is_missed: bool) -> None:
        """Note a control step of an armed robot: what perception and policy took, without waiting [s]."""
        self.num_steps += 1
        self.num_missed += is_missed
        if not is_missed:
            self._thinking.count(took)
            self.num_overruns += took > CONTROL_DT

    def count_stages(self, stamp: float, times: dict[str, float]) -> None:
        """Note when each of `STAGES` was done with an image that was taken at a time [s]."""
        for name, time in times.items():
            self._stages[name].count(time - stamp)

    def note_targets(self, joint_targets: JointTargets) -> None:
        """Note a command by the image that it was decided on, of which the servo is not told."""
        self._sent.append((joint_targets.target_stamp, joint_targets.image_stamp))

    def note_command(self, command: Command, dt: float) -> None:
        """Note a tick of the servo, which is to come every so often [s]."""
        last = self._last
        self.num_ticks += 1
        self._ticks.count(command.duration)
        self._refused |= command.refused
        self._clamped |= command.clamped
        self.clamps.update(flag_names(Clamp, command.clamped))
        if command.refused:
            self.refusals[", ".join(flag_names(Fault, command.refused))] += 1
        if last is not None:
            self.num_late_ticks += command.time - last.time > 2.0 * dt + 1e-4
            if command.mode == Mode.STOPPED and last.mode != Mode.STOPPED:
                self.stops[", ".join(flag_names(Fault, command.stopped_by))] += 1
            if command.mode in ACTIVE and command.target_stamp > last.target_stamp:
                image_stamp = dict(self._sent).get(command.target_stamp, command.image_stamp)
                self._latency = command.time - image_stamp
                self._latencies.count(self._latency)
        self._last = command

    def status(
        self, box: Box | None, message: str, sight: Sight | None = None, age: float = inf
    ) -> dict[str, Any]:
        """What is going on now, and what is known of the object, if one matters, last seen so long ago [s].

        Requests that were refused are said once.
        """
        last = self._last
        refused, clamped, self._refused, self._clamped = self._refused, self._clamped, 0, 0
        return {
            "mode": Mode(last.mode).name.lower() if last else "starting",
            "stopped_by": flag_names(Fault, last.stopped_by) if last else [],
            "found": flag_names(Fault, last.found) if last else [],
            "refused": flag_names(Fault, refused),
            "clamped": flag_names(Clamp, clamped),
            "box": list(box.edges) if box and box.is_valid else None,
            "verdict": str(box.verdict) if box else sight and str(Verdict.NO_IMAGE),
            "object": sight and str(sight),
            "object_age_ms": round(1e3 * age, 1) if age < inf else None,
            "latency_ms": self._latencies.milliseconds(50, 90, 99),
            "num_missed": self.num_missed,
            "message": message,
        }

    def summary(self) -> dict[str, Any]:
        """All of it; latencies are from the middle of an image's exposure on."""
        latency = self._latencies.milliseconds(*PERCENTAGES)
        return {
            "num_steps": self.num_steps,
            "num_missed": self.num_missed,
            "num_overruns": self.num_overruns,
            "image_to_command_ms": latency and {**latency, "by_ms": self._latencies.by_ms},
            "stages_ms": {name: times.milliseconds(*PERCENTAGES) for name, times in self._stages.items()},
            "thinking_ms": self._thinking.milliseconds(*PERCENTAGES),
            "servo_tick_ms": self._ticks.milliseconds(*PERCENTAGES),
            "num_ticks": self.num_ticks,
            "num_late_ticks": self.num_late_ticks,
            "stops": dict(self.stops),
            "refusals": dict(self.refusals),
            "clamps": dict(self.clamps),
            "stop_requests": dict(self.stop_requests),
            "refused_prompts": dict(self.refused_prompts),
        }
