"""What a recording must be like before anything is fitted to it: checks as values."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from pixel2catch.identification.recording import JOINT_SPECS, Recording
from pixel2catch.identification.signals import (
    command_lag,
    excess_time,
    held,
    progress,
    smoothed,
    time_step,
)

MIN_SAMPLES = 50
"""Fewer measurements are not checked further. Source: ours, half a second at 100 Hz."""

MAX_GAP = 0.1
"""Longest time without a measurement [s]. Source: ours; a joint can start, move and stop in more."""

MAX_SPAN_RATIO = 10.0
"""Longest duration of the commands, as a multiple of that of the measurements. Source: ours."""

STALL_TIME = 0.01
"""A step whose motion took so much longer than the clock says, and at least one more step, is a stall [s].

Source: ours; a real recording with a nominal clock of 2 ms had stalls of 40 ms.
"""

LONG_STEP = 1.5
"""A step is long from this multiple of the median on. Source: ours."""

STALL_ANGLE = 2e-3
"""A stall is seen from this much motion on [rad]. Source: ours, ten times the noise of a UR5e's positions."""

MAX_STALL_SHARE = 5e-3
"""Largest share of stalled steps. Source: ours, a tenth of that recording's; a jerk can look like one."""

PROGRESS_RANGE = (0.8, 1.25)
"""Plausible change of the positions over that by the speeds. Source: ours; degrees would give 0.017."""

MOVING_SPEED = 0.02
"""A joint that is slower stands still [rad/s]. Source: ours, 0.7 % of the arm's largest speed."""

MAX_REPEATED_SHARE = 0.02
"""Largest share of samples that repeat the one before while the robot moves. Source: ours."""

LAG_RANGE = (-0.02, 0.3)
"""Plausible lag of the motion behind its command [s].

Source: ours; servoJ with a lookahead of 0.1 s lags by 0.1 s and a few ms. A log of the controller's own
target can seem late by half its step, because a command is taken to hold until the next.
"""

MOVED_ANGLE = 0.01
"""A joint whose positions span less did not move [rad]. Source: ours."""

MIN_CORRELATION = 0.5
"""Smallest correlation of measured and commanded positions. Source: ours; swapped joints are near 0."""

SATURATED = 0.98
"""A torque of this share of its limit counts as saturated. Source: ours."""

MAX_SATURATED_SHARE = 0.1
"""Largest share of saturated samples. Source: ours; some tell the scale of the gains, many hide the rest."""

MIN_SPEED_SHARE = 0.1
"""Speed that a joint must reach, as a share of its limit. Source: ours."""

MIN_REVERSALS = 1
"""A joint must reverse so often. Source: ours; without a reversal friction looks like an offset."""

PEAK_QUANTILE = 0.995
"""Speeds and accelerations beyond this quantile are no peaks, but single bad samples. Source: ours."""


@dataclass(frozen=True, kw_only=True)
class Check:
    """One answer about a recording.

    Attributes:
        name: What was checked.
        joint: The joint it is about; none if it is about the whole recording.
        is_good: Whether it passed; None if the recording cannot tell.
        is_advice: Whether the motion can be fitted even if it failed: the fit then tells less.
        detail: The figures, and the remedy if it failed.
    """

    name: str
    joint: str | None = None
    is_good: bool | None
    is_advice: bool = False
    detail: str

    @property
    def forbids_fit(self) -> bool:
        """Whether nothing can be fitted to such a recording."""
        return self.is_good is False and not self.is_advice


def check_recording(recording: Recording, effort_limits: Mapping[str, float] | None = None) -> list[Check]:
    """All checks of a recording, or those of its clocks alone if one of them failed.

    Args:
        recording: The motion.
        effort_limits: Torque limits of the joints [N·m]; those of the simulated robot if absent.
    """
    limits = effort_limits or {name: spec.effort_limit for name, spec in JOINT_SPECS.items()}
    clocks = [_measurement_times(recording), _command_times(recording)]
    if not all(clock.is_good for clock in clocks):
        return clocks
    lag = command_lag(recording)
    samples = [_speeds(recording), _stalls(recording), _repeated_samples(recording)]
    whole = [*clocks, *samples, _clock_offset(lag)]
    return [*whole, *_joint_checks(recording, lag or 0.0, limits)]


def _measurement_times(recording: Recording) -> Check:
    steps = np.diff(recording.t_meas)
    num_equal, longest = int((steps == 0).sum()), float(steps.max())
    detail = f"{_clock(recording.t_meas)}, longest {1e3 * longest:.1f} ms"
    faults = {
        f"; fewer than {MIN_SAMPLES} samples: record longer": len(recording.t_meas) < MIN_SAMPLES,
        f"; {num_equal} times twice: record the controller's time": num_equal > 0,
        f"; a gap of more than {MAX_GAP} s: split the recording there": longest > MAX_GAP,
    }
    fault = "".join(text for text, is_there in faults.items() if is_there)
    return Check(name="measurement times", is_good=not fault, detail=detail + fault)


def _command_times(recording: Recording) -> Check:
    num_equal = int((np.diff(recording.t_cmd) == 0).sum())
    is_long = np.ptp(recording.t_cmd) > MAX_SPAN_RATIO * np.ptp(recording.t_meas)
    faults = {
        f"; {num_equal} times twice: record the time of sending": num_equal > 0,
        "; far longer than the measurements: are both in seconds?": is_long,
    }
    fault = "".join(text for text, is_there in faults.items() if is_there)
    return Check(name="command times", is_good=not fault, detail=_clock(recording.t_cmd) + fault)


def _clock(time: np.ndarray) -> str:
    return f"{len(time)} times in {time[-1] - time[0]:.1f} s, median step {1e3 * time_step(time):.1f} ms"


def _speeds(recording: Recording) -> Check:
    """Whether the recorded speeds are the change of the positions, in rad/s."""
    if recording.qd is None:
        return Check(name="speeds", is_good=None, detail="no speed was recorded")
    ratio = progress(recording)
    is_good = PROGRESS_RANGE[0] <= ratio <= PROGRESS_RANGE[1]
    remedy = "" if is_good else ": are the speeds in rad/s, the times in seconds?"
    detail = f"the positions change by {ratio:.3g} of the recorded speeds{remedy}"
    return Check(name="speeds", is_good=is_good, detail=detail)


def _stalls(recording: Recording) -> Check:
    """Whether steps lasted longer than their times say: Δq against q̇·Δt.

    Not judged is a step whose own time is long: its clock did see the stall.
    """
    excess, angle = excess_time(recording)
    step = time_step(recording.t_meas)
    is_stall = (excess > STALL_TIME + step) & (angle > STALL_ANGLE)
    is_stall &= np.diff(recording.t_meas) < LONG_STEP * step
    num_stalls, share = int(is_stall.sum()), float(is_stall.mean())
    detail = f"{num_stalls} steps ({100 * share:.2f} %) lasted longer than their times say"
    if num_stalls:
        detail += f", {1e3 * float(np.median(excess[is_stall])):.0f} ms in the median"
    is_good = share <= MAX_STALL_SHARE
    remedy = "" if is_good else ": record the controller's time, not a count of loops"
    return Check(name="stalls", is_good=is_good, detail=detail + remedy)


def _repeated_samples(recording: Recording) -> Check:
    """How often a sample is the one before although the robot moves, judged by five samples on each side."""
    change = np.abs(recording.q[10:] - recording.q[:-10]).max(1)
    is_moving = change > MOVING_SPEED * (recording.t_meas[10:] - recording.t_meas[:-10])
    is_repeated = (np.diff(recording.q, axis=0) == 0).all(1)[5:-4]
    if not is_moving.any():
        return Check(name="repeated samples", is_good=None, detail="the robot does not move")
    share = float(is_repeated[is_moving].mean())
    is_good = share <= MAX_REPEATED_SHARE
    remedy = "" if is_good else ": record at the controller's rate, not faster"
    detail = f"{100 * share:.1f} % of the samples while moving{remedy}"
    return Check(name="repeated samples", is_good=is_good, detail=detail)


def _clock_offset(lag: float | None) -> Check:
    name = "clock offset"
    if lag is None:
        return Check(name=name, is_good=None, detail="no motion follows a command")
    low, high = LAG_RANGE
    is_good = low <= lag <= high
    remedy = (
        f"; plausible is {low} to {high} s: the clocks differ, add {lag:.3f} s to the command's times "
        "(--shift-commands)"
    )
    detail = f"the motion is {1e3 * lag:.1f} ms behind its command" + ("" if is_good else remedy)
    return Check(name=name, is_good=is_good, detail=detail)


def _joint_checks(recording: Recording, lag: float, limits: Mapping[str, float]) -> Iterator[Check]:
    """The checks that are made joint by joint."""
    motion = smoothed(recording.t_meas, recording.q)
    command = held(recording, recording.t_meas - lag)
    for column, joint in enumerate(recording.joints):
        effort = None if recording.effort is None else recording.effort[:, column]
        yield _following(joint, command[:, column], recording.q[:, column])
        yield _saturation(joint, effort, limits[joint])
        yield _excitation(joint, motion.speed[:, column], motion.acceleration[:, column])


def _following(joint: str, command: np.ndarray, position: np.ndarray) -> Check:
    name = "follows its command"
    has_moved = np.ptp(position) >= MOVED_ANGLE
    if np.ptp(command) < MOVED_ANGLE:
        remedy = "it moves without a command: are joints swapped?"
        detail = remedy if has_moved else "it is not commanded to move"
        return Check(name=name, joint=joint, is_good=False if has_moved else None, detail=detail)
    correlation = float(np.corrcoef(command, position)[0, 1]) if has_moved else 0.0
    is_good = correlation >= MIN_CORRELATION
    remedy = "" if is_good else ": are joints swapped, of another sign, or stopped?"
    return Check(name=name, joint=joint, is_good=is_good, detail=f"correlation {correlation:.3f}{remedy}")


def _saturation(joint: str, effort: np.ndarray | None, limit: float) -> Check:
    if effort is None:
        return Check(name="saturation", joint=joint, is_good=None, detail="no effort was recorded")
    share = float((np.abs(effort) >= SATURATED * limit).mean())
    is_good = share <= MAX_SATURATED_SHARE
    remedy = "" if is_good else ": move more gently"
    detail = f"{100 * share:.1f} % of the samples at the limit of {limit:g} N·m{remedy}"
    return Check(name="saturation", joint=joint, is_good=is_good, is_advice=True, detail=detail)


def _excitation(joint: str, speed: np.ndarray, acceleration: np.ndarray) -> Check:
    """Whether the joint was moved fast, hard and often enough to tell damping, armature and friction.

    The acceleration must let the armature's torque exceed the simulated joint's dry friction (ours).
    """
    spec = JOINT_SPECS[joint]
    least_speed, least_acceleration = MIN_SPEED_SHARE * spec.velocity_limit, spec.frictionloss / spec.armature
    reversals = num_reversals(speed)
    needs = {
        f"{least_speed:.2f} rad/s": _peak(speed) < least_speed,
        f"{least_acceleration:.1f} rad/s²": _peak(acceleration) < least_acceleration,
        f"{MIN_REVERSALS} reversal": reversals < MIN_REVERSALS,
    }
    lacking = ", ".join(text for text, is_lacking in needs.items() if is_lacking)
    detail = (
        f"{_range(speed, 2)} rad/s, {_range(acceleration, 1)} rad/s², {reversals} reversals"
        f"{f'; needs {lacking}' if lacking else ''}"
    )
    return Check(name="excitation", joint=joint, is_good=not lacking, is_advice=True, detail=detail)


def _peak(values: np.ndarray) -> float:
    return float(np.quantile(np.abs(values), PEAK_QUANTILE))


def _range(values: np.ndarray, digits: int) -> str:
    return f"{values.min():.{digits}f} to {values.max():.{digits}f}"


def num_reversals(speed: np.ndarray) -> int:
    """Changes of direction, from a speed that counts to an opposite one that counts."""
    signs = np.sign(speed[np.abs(speed) > MOVING_SPEED])
    return int((np.diff(signs) != 0).sum())
