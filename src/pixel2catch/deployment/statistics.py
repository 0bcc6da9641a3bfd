"""Counts and durations of a deployment: its status in every control step, and the summary at its end."""

from collections import Counter, deque
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from pixel2catch.camera.image import Box, Verdict
from pixel2catch.scene.constants import CONTROL_DT
from pixel2catch.servo.limits import ServoLimits
from pixel2catch.servo.link import Clamp, Command, Fault, JointTargets, Mode, flag_names

BIN, LONGEST = 5e-5, 0.5  #: Width of a histogram's bins, and start of the last one [s]. Source: ours.
PERCENTAGES = (50, 90, 95, 99)  #: Of durations, in a summary.
STAGES = ("received", "begun", "perceived", "decided")
"""Stages of an image: it arrives, perception begins, perception ends, its targets are sent to the servo."""

TIMES = ("image_to_command_ms", "thinking_ms", "servo_tick_ms")  #: Of exposures, control steps and ticks.
ACTIVE = (int(Mode.ARMED), int(Mode.RAMP), int(Mode.RUN))  #: Modes in which control steps count.


class Histogram:
    """Counts any number of durations; a percentile is the mean of its bin."""

    def __init__(self) -> None:
        self._counts = np.zeros(round(LONGEST / BIN) + 1, dtype=np.int64)
        self._sums, self._longest = np.zeros(len(self._counts)), 0.0

    def count(self, duration: float) -> None:
        """Count a duration [s]."""
        place = min(max(int(duration / BIN), 0), len(self._counts) - 1)
        self._counts[place] += 1
        self._sums[place] += duration
        self._longest = max(self._longest, duration)

    def milliseconds(self, *percentages: int) -> dict[str, float] | None:
        """Return percentiles, longest duration [ms] and count; None if it is empty."""
        total = np.cumsum(self._counts)
        if not total[-1]:
            return None
        places = np.searchsorted(total, 0.01 * np.array(percentages) * total[-1])
        values = self._sums[places] / self._counts[places]
        named = {f"p{q}": 1e3 * value for q, value in zip(percentages, values.tolist(), strict=True)}
        return {**named, "max": 1e3 * self._longest, "count": int(total[-1])}


@dataclass(kw_only=True)
class RunStatistics:
    """Statistics of a deployment so far."""

    tick: float = ServoLimits.dt  #: Time between two commands of the servo [s].
    num_steps: int = 0  #: Control steps in which the robot was armed or moved; only these count.
    num_missed: int = 0  #: Control steps without a new image that was processed in time.
    num_overruns: int = 0  #: Control steps in which perception and policy took longer than a step.
    stops: Counter[str] = field(default_factory=Counter)  #: Stops by reason.
    refusals: Counter[str] = field(default_factory=Counter)  #: Refused requests to arm by reason.
    clamps: Counter[str] = field(default_factory=Counter)  #: Servo ticks in which a limit changed a command.
    stop_requests: Counter[str] = field(default_factory=Counter)  #: Stop requests by sender.
    refused_prompts: Counter[str] = field(default_factory=Counter)  #: Refused prompts by sender.
    num_ticks: int = 0  #: Servo ticks received.
    num_late_ticks: int = 0  #: Servo ticks that came more than a tick late.
    _times: dict[str, Histogram] = field(default_factory=lambda: {name: Histogram() for name in TIMES})
    _stages: dict[str, Histogram] = field(default_factory=lambda: {name: Histogram() for name in STAGES})
    _sent: deque[JointTargets] = field(default_factory=lambda: deque(maxlen=8))
    _last: Command | None = None
    _refused: int = 0
    _clamped: int = 0

    def count_step(
        self, begin: float, end: float, times: dict[str, float] | None, *, is_decided: bool
    ) -> None:
        """Count a control step by its begin and end [s].

        The times [s] of a new image are those of its exposure and of `STAGES`; None without a new image.
        """
        self.num_steps += 1
        self.num_missed += times is None
        if times is None:
            return
        took = end - begin + times["perceived"] - times["begun"]
        self._times["thinking_ms"].count(took)
        self.num_overruns += took > CONTROL_DT
        if is_decided:
            for name, stage in self._stages.items():
                stage.count({**times, "decided": end}[name] - times["exposed"])

    def note_targets(self, targets: JointTargets) -> None:
        """Keep targets with the stamp of the image that they were decided on."""
        self._sent.append(targets)

    def note_command(self, command: Command) -> None:
        last, self._last = self._last, command
        self.num_ticks += 1
        self._times["servo_tick_ms"].count(command.duration)
        self._refused |= command.refused
        self._clamped |= command.clamped
        self.clamps.update(flag_names(Clamp, command.clamped))
        if command.refused:
            self.refusals[", ".join(flag_names(Fault, command.refused))] += 1
        if last is None:
            return
        self.num_late_ticks += command.time - last.time > 2.0 * self.tick + 1e-4
        if command.mode == Mode.STOPPED and last.mode != Mode.STOPPED:
            self.stops[", ".join(flag_names(Fault, command.stopped_by))] += 1
        if command.mode in ACTIVE and command.target_stamp > last.target_stamp:
            image_stamps = {targets.target_stamp: targets.image_stamp for targets in self._sent}
            image_stamp = image_stamps.get(command.target_stamp, command.image_stamp)
            self._times["image_to_command_ms"].count(command.time - image_stamp)

    def status(self, box: Box | None, message: str, visibility: str | None = None) -> dict[str, Any]:
        """Return the status of a control step; refusals and clamps are those since the last one.

        The box is of the newest image, None without a recent one; so is the visibility without an object.
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
            "verdict": str(box.verdict) if box else visibility and str(Verdict.NO_IMAGE),
            "object": visibility,
            "latency_ms": self._times["image_to_command_ms"].milliseconds(50, 90, 99),
            "num_missed": self.num_missed,
            "message": message,
        }

    def summary(self) -> dict[str, Any]:
        counts = {name: value for name, value in vars(self).items() if not name.startswith("_")}
        times, stages = (
            {name: each.milliseconds(*PERCENTAGES) for name, each in all_times.items()}
            for all_times in (self._times, self._stages)
        )
        return {**counts, **times, "stages_ms": stages}
