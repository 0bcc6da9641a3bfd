"""What a deployment says of itself while it runs, and afterwards."""

from collections import Counter, deque
from dataclasses import dataclass, field
from math import inf
from typing import Any

import numpy as np

from pixel2catch.deployment.sight import Sight
from pixel2catch.perception.extractor import Extraction
from pixel2catch.scene.constants import CONTROL_DT
from pixel2catch.servo.core import Clamp, Mode
from pixel2catch.servo.link import PolicyCommand, ServoStatus
from pixel2catch.servo.watchdogs import Fault, flag_names

MEMORY = 40_000  #: Latencies that are kept: more than twenty minutes at 30 Hz.
SERVO_MEMORY = 1_000_000  #: Durations of servo ticks that are kept: half an hour at 500 Hz.

ACTIVE = (int(Mode.ARMED), int(Mode.RAMP), int(Mode.RUN))


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
    num_ticks: int = 0  #: Servo ticks heard of.
    num_late_ticks: int = 0  #: Servo ticks that came more than a tick late.
    _latencies: deque[float] = field(default_factory=lambda: deque(maxlen=MEMORY))
    _thinking: deque[float] = field(default_factory=lambda: deque(maxlen=MEMORY))
    _ticks: deque[float] = field(default_factory=lambda: deque(maxlen=SERVO_MEMORY))
    _sent: deque[tuple[float, float]] = field(default_factory=lambda: deque(maxlen=8))
    _last: ServoStatus | None = None
    _refused: int = 0
    _clamped: int = 0

    def count_step(self, *, took: float, is_missed: bool) -> None:
        """Note a control step of an armed robot: what perception and policy took, without waiting [s]."""
        self.num_steps += 1
        self.num_missed += is_missed
        if not is_missed:
            self._thinking.append(took)
            self.num_overruns += took > CONTROL_DT

    def note_command(self, policy_command: PolicyCommand) -> None:
        """Note a command by the image that it was decided on, of which the servo is not told."""
        self._sent.append((policy_command.target_stamp, policy_command.image_stamp))

    def note_status(self, servo_status: ServoStatus, dt: float) -> None:
        """Note a tick of the servo, which is to come every so often [s]."""
        last = self._last
        self.num_ticks += 1
        self._ticks.append(servo_status.duration)
        self._refused |= servo_status.refused
        self._clamped |= servo_status.clamped
        self.clamps.update(flag_names(Clamp, servo_status.clamped))
        if servo_status.refused:
            self.refusals[", ".join(flag_names(Fault, servo_status.refused))] += 1
        if last is not None:
            self.num_late_ticks += servo_status.time - last.time > 2.0 * dt + 1e-4
            if servo_status.mode == Mode.STOPPED and last.mode != Mode.STOPPED:
                self.stops[", ".join(flag_names(Fault, servo_status.stopped_by))] += 1
            if servo_status.mode in ACTIVE and servo_status.target_stamp > last.target_stamp:
                image_stamp = dict(self._sent).get(servo_status.target_stamp, servo_status.image_stamp)
                self._latencies.append(servo_status.time - image_stamp)
        self._last = servo_status

    def status(
        self, seen: Extraction | None, message: str, sight: Sight | None = None, age: float = inf
    ) -> dict[str, Any]:
        """What is going on now, and what is known of the object, if one matters, seen so long ago [s].

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
            "box": seen.box[0].tolist() if seen and seen.is_valid else None,
            "verdict": str(seen.verdict) if seen else None,
            "object": sight and str(sight),
            "object_age_ms": round(1e3 * age, 1) if age < inf else None,
            "latency_ms": round(1e3 * self._latencies[-1], 2) if self._latencies else None,
            "num_missed": self.num_missed,
            "message": message,
        }

    def summary(self) -> dict[str, Any]:
        """All of it."""
        return {
            "num_steps": self.num_steps,
            "num_missed": self.num_missed,
            "num_overruns": self.num_overruns,
            "image_to_command_ms": milliseconds(self._latencies),
            "thinking_ms": milliseconds(self._thinking),
            "servo_tick_ms": milliseconds(self._ticks),
            "num_ticks": self.num_ticks,
            "num_late_ticks": self.num_late_ticks,
            "stops": dict(self.stops),
            "refusals": dict(self.refusals),
            "clamps": dict(self.clamps),
        }


def milliseconds(durations: deque[float]) -> dict[str, float] | None:
    """Percentiles of durations [s] in ms; none if there are none."""
    if not durations:
        return None
    values = 1e3 * np.array(durations)
    p50, p95, p99 = np.percentile(values, (50, 95, 99)).tolist()
    return {"p50": p50, "p95": p95, "p99": p99, "max": float(values.max()), "count": len(values)}
