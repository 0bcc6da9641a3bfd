"""Data checks: whether a recording can be fitted, from its clocks, speeds, accelerations and lag."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import median_filter, uniform_filter1d
from scipy.signal import correlate, correlation_lags, lfilter, savgol_filter

from pixel2catch.identification.recording import Recording, held, specs_of
from pixel2catch.robots.spec import JointSpec

MIN_SAMPLES = 50  # least number of measurements (ours, half a second at 100 Hz)
MAX_GAP = 0.1  # longest time without a measurement [s] (ours; a joint can start, move and stop in more)
MAX_SPAN_RATIO = 10.0  # longest duration of the commands, as a multiple of that of the measurements (ours)

STALL_TIME = 0.01  # least time of a stall beyond two steps [s] (ours; a real recording had stalls of 40 ms)
LONG_STEP = 1.5  # least length of a long step, in medians (ours)
STALL_ANGLE = 2e-3  # least motion in a stall, beyond noise and rounding [rad] (ours)
NOISE_FACTOR = 4.0  # standard deviations of noise that do not count as motion (ours)
REPEATED_STEPS = 2.0  # least change of a moving joint from sample to sample, in encoder steps (ours)
MAX_STALL_SHARE = 5e-3  # of all steps (ours, a tenth of that recording's; a jerk can look like one)
MOVING_SPEED = 0.02  # least speed of a moving joint [rad/s] (ours, 0.7 % of the arm's largest speed)
MAX_REPEATED_SHARE = 0.02  # largest share of samples that repeat the one before while the robot moves (ours)

LAG_RANGE = (-0.02, 0.3)
"""Plausible lag of the motion behind its command [s]. Source: ours; servoJ with a lookahead of 0.1 s lags by
as much. A log of the controller's own target can appear late by half its step."""

MOVED_ANGLE = 0.01  # least span of the positions of a joint that moved [rad] (ours)
MIN_CORRELATION = 0.5  # smallest of measured and commanded positions (ours; swapped joints are near 0)
LEAST_MARGIN = 0.2  # by which another joint's command must fit better to be the joint's own (ours)
SCALES = (0.7, 1.25)  # of slow motion to its commands (ours; a simulated UR5e has 0.89 to 0.96)
SLOW = 0.3  # window of a mean that leaves slow motion [s] (ours; servos do not follow fast motion)
LARGEST_OFFSET = 0.2  # of positions from commands, in the median [rad] (ours; gravity bends servos by 0.06)
MIN_SPEED_SHARE = 0.1  # least top speed of a joint, as a share of its limit (ours)
MAX_SPEED_SHARE = 5.0  # largest top speed of a joint, as a share of its limit (ours; fast steps have 3.5)
MIN_REVERSALS = 1  # least number of reversals of a joint (ours; without one, friction looks like an offset)
PEAK_QUANTILE = 0.995  # of speeds and accelerations, counts as their peak (ours; no single samples)

SMOOTHING = 0.1  # window of the cubic for speed and acceleration [s] (ours; motion up to 5 Hz passes)
NEIGHBOURS = 7  # steps whose median speed is that of the middle one (ours)
ROUNDING = 1e-9  # largest change of positions that is rounding [rad]
REFINEMENTS = 10  # Gauss-Newton steps for the lag (ours; three are enough for sines)


@dataclass(frozen=True, kw_only=True)
class DataCheck:
    """The result of one check of a recording."""

    name: str  #: what was checked
    joint: str | None = None  #: joint that was checked; None for the whole recording
    is_good: bool | None  #: whether it passed; None if the recording does not show it
    detail: str  #: the figures, and the remedy if it failed

    @property
    def forbids_fit(self) -> bool:
        """Return whether the recording must not be fitted; weak excitation makes a fit less certain only."""
        return self.is_good is False and self.name != "excitation"

    @property
    def verdict(self) -> str:
        """Return one word: BAD forbids a fit, weak makes its result less certain."""
        return {None: "unknown", True: "good", False: "BAD" if self.forbids_fit else "weak"}[self.is_good]


def check_recording(recording: Recording) -> list[DataCheck]:
    """Return all checks of a recording, or only those of its clocks and motion if one of them failed."""
    clocks = list(_clocks(recording))
    if all(clock.is_good for clock in clocks):
        clocks.append(_motion(recording))
    if not all(clock.is_good for clock in clocks):
        return clocks
    lag = measured_lag(recording)
    samples = [_stalls(recording), _repeated_samples(recording), _clock_offset(lag)]
    return [*clocks, *samples, *_joint_checks(recording, lag or 0.0)]


def _judged(name: str, is_good: bool, found: str, remedy: str, joint: str | None = None) -> DataCheck:
    return DataCheck(name=name, joint=joint, is_good=is_good, detail=found if is_good else found + remedy)


def _clocks(recording: Recording) -> Iterator[DataCheck]:
    sent, measured = recording.t_cmd, recording.t_meas
    longest, is_long = float(np.diff(measured).max()), np.ptp(sent) > MAX_SPAN_RATIO * np.ptp(measured)
    meas_faults = {
        f"; fewer than {MIN_SAMPLES} samples: record longer": len(measured) < MIN_SAMPLES,
        f"; a gap of more than {MAX_GAP} s: split the recording there": longest > MAX_GAP,
    }
    cmd_faults = {"; far longer than the measurements: are both in seconds?": is_long}
    for name, time, remedy, faults in (
        ("measurement times", measured, "the controller's time", meas_faults),
        ("command times", sent, "the time of sending", cmd_faults),
    ):
        num_equal = int((np.diff(time) == 0).sum())
        found = f"{len(time)} times in {np.ptp(time):.1f} s, median step {1e3 * time_step(time):.1f} ms"
        found += f", longest {1e3 * longest:.1f} ms" if time is measured else ""
        wrong = f"; {num_equal} times twice: record {remedy}" if num_equal else ""
        wrong += "".join(text for text, is_there in faults.items() if is_there)
        yield _judged(name, not wrong, found, wrong)


def _motion(recording: Recording) -> DataCheck:
    window = max(1, round(SMOOTHING / time_step(recording.t_meas)))
    spans = np.ptp(uniform_filter1d(recording.q, window, axis=0), axis=0)
    most = int(np.argmax(spans))
    is_good = bool(spans[most] >= MOVED_ANGLE)
    found = f"{recording.joints[most]} moved most, by {spans[most]:.2f} rad"
    if not is_good:
        found = f"at a standstill: no joint moved more than {1e3 * spans[most]:.2g} mrad"
    remedy = ": let the robot follow an excitation ('pixel2catch excite', 'pixel2catch record')"
    return _judged("motion", is_good, found, remedy)


def _stalls(recording: Recording) -> DataCheck:
    """Check that no step needed more time than its clock shows: Δq against q̇·Δt.

    Steps whose own time is long are left out.
    """
    excess, angle = excess_time(recording)
    step = time_step(recording.t_meas)
    uncertainty = encoder_step(recording.q) + NOISE_FACTOR * np.sqrt(2.0) * position_noise(recording.q)
    is_stall = (excess > STALL_TIME + step) & (angle > STALL_ANGLE + float(np.linalg.norm(uncertainty)))
    is_stall &= np.diff(recording.t_meas) < LONG_STEP * step
    num_stalls, share = int(is_stall.sum()), float(is_stall.mean())
    found = f"{num_stalls} steps ({100 * share:.2f} %) lasted longer than their times"
    if num_stalls:
        found += f", {1e3 * float(np.median(excess[is_stall])):.0f} ms in the median"
    remedy = ": record the controller's time, not a count of loops"
    return _judged("stalls", share <= MAX_STALL_SHARE, found, remedy)


def _repeated_samples(recording: Recording) -> DataCheck:
    """Check how often a sample repeats the one before while a joint moves by more than encoder steps.

    It must move before and after: a joint that waits for its command repeats samples, too.
    """
    time, q = recording.t_meas, recording.q
    change = np.minimum(np.abs(q[10:] - q[5:-5]), np.abs(q[5:-5] - q[:-10]))
    least = MOVING_SPEED / 2 * (time[10:] - time[:-10])[:, None]
    is_moving = (change > np.maximum(least, 5 * REPEATED_STEPS * encoder_step(q))).any(1)
    is_repeated = (np.diff(recording.q, axis=0) == 0).all(1)[5:-4]
    if not is_moving.any():
        return DataCheck(name="repeated samples", is_good=None, detail="the robot does not move")
    share = float(is_repeated[is_moving].mean())
    found = f"{100 * share:.1f} % of the samples while moving"
    remedy = ": record at the controller's rate, not faster"
    return _judged("repeated samples", share <= MAX_REPEATED_SHARE, found, remedy)


def _clock_offset(lag: float | None) -> DataCheck:
    if lag is None:
        return DataCheck(name="clock offset", is_good=None, detail="no motion follows a command")
    low, high = LAG_RANGE
    remedy = f"; plausible is {low} to {high} s: the clocks differ, add {lag:.3f} s to the command times"
    found = f"the motion is {1e3 * lag:.1f} ms behind its command"
    return _judged("clock offset", low <= lag <= high, found, remedy)


def _joint_checks(recording: Recording, lag: float) -> Iterator[DataCheck]:
    speed, acceleration = smoothed(recording.t_meas, recording.q)
    command = recording.held(recording.t_meas - lag)
    for column, joint in enumerate(recording.joints):
        spec = specs_of(recording.workcell)[joint]
        yield _following(recording, command, lag, column)
        yield _excitation(spec, speed[:, column], acceleration[:, column])


def _following(recording: Recording, command: np.ndarray, lag: float, column: int) -> DataCheck:
    """Compare a joint's positions with the commands of all joints at the measurements, without the lag."""
    name, joint, position = "follows its command", recording.joints[column], recording.q[:, column]
    is_sent, has_moved = np.ptp(command, axis=0) >= MOVED_ANGLE, bool(np.ptp(position) >= MOVED_ANGLE)
    if not is_sent[column] and not has_moved:
        return DataCheck(name=name, joint=joint, is_good=None, detail="it is not commanded to move")
    usable = is_sent & has_moved
    matches = [np.corrcoef(each, position)[0, 1] if usable[i] else 0.0 for i, each in enumerate(command.T)]
    best, correlation = int(np.argmax(matches)), float(matches[column])
    offset = float(np.median(position - command[:, column]))
    share = 1.0 / (1.0 + max(lag, 0.0) / time_step(recording.t_meas))
    slowed = lfilter([share], [1.0, share - 1.0], command[:, column] - command[0, column])
    least, most = np.std(position) / np.maximum((np.std(command[:, column]), np.std(slowed)), ROUNDING)
    is_other = matches[best] >= max(MIN_CORRELATION, correlation + LEAST_MARGIN)
    faults = {
        f"it follows the command of {recording.joints[best]}: are these joints exchanged?": is_other,
        "it moves without a command: record its commands, too": not is_sent[column],
        "its commands equal its measurements: record what was sent": _is_copied(recording, column),
        "it moves against its command: change its sign": correlation <= -MIN_CORRELATION,
        f"correlation {correlation:.3f}: is it stopped?": correlation < MIN_CORRELATION,
        f"it moves {least:.2f} to {most:.2f} times as far as its command: are both in rad, of the joint?": (
            least > SCALES[1] or most < SCALES[0]
        ),
        f"it is {offset:+.2f} rad from its command throughout: does its driver have another zero?": (
            abs(offset) > LARGEST_OFFSET
        ),
    }
    fault = next((text for text, is_there in faults.items() if is_there), "")
    return _judged(name, not fault, fault or f"correlation {correlation:.3f}", "", joint)


def _is_copied(recording: Recording, column: int) -> bool:
    """Return whether a moving joint is at its command in most samples: no servo is without lag."""
    streams = ((recording.t_cmd, recording.q_cmd), (recording.t_meas, recording.q))
    (time, rows), dense = sorted(streams, key=lambda stream: len(stream[0]))
    is_moving = np.abs(np.diff(rows[:, column])) > MOVING_SPEED * np.diff(time)
    is_same = rows[1:, column] == held(*dense, time[1:])[:, column]
    return bool(is_moving.any() and is_same[is_moving].mean() > 0.5)


def _excitation(spec: JointSpec, speed: np.ndarray, acceleration: np.ndarray) -> DataCheck:
    """Check that speed, acceleration and reversals of a joint show its parameters, and are possible.

    At the least acceleration the armature's torque is the simulated joint's dry friction (ours).
    """
    least_speed, least_acceleration = MIN_SPEED_SHARE * spec.velocity_limit, spec.frictionloss / spec.armature
    signs = np.sign(speed[np.abs(speed) > MOVING_SPEED])
    reversals = int((np.diff(signs) != 0).sum())
    top_speed, top = (np.quantile(np.abs(values), PEAK_QUANTILE) for values in (speed, acceleration))
    if top_speed > MAX_SPEED_SHARE * spec.velocity_limit:
        fault = f"{top_speed:.1f} rad/s, beyond {spec.velocity_limit:g}: are times in s, positions in rad?"
        return _judged("speed", False, fault, "", spec.name)
    needs = {
        f"{least_speed:.2f} rad/s": top_speed < least_speed,
        f"{least_acceleration:.1f} rad/s²": top < least_acceleration,
        f"{MIN_REVERSALS} reversal": reversals < MIN_REVERSALS,
    }
    lacking = ", ".join(text for text, is_lacking in needs.items() if is_lacking)
    found = f"{speed.min():.2f} to {speed.max():.2f} rad/s, "
    found += f"{acceleration.min():.1f} to {acceleration.max():.1f} rad/s², {reversals} reversals"
    return _judged("excitation", not lacking, found, f"; needs {lacking}", spec.name)


def encoder_step(positions: np.ndarray) -> np.ndarray:
    """Return the least change of each joint's positions [rad], shape (joints,): their resolution."""
    changes = np.abs(np.diff(positions, axis=0))
    least = np.where(changes > ROUNDING, changes, np.inf).min(axis=0)
    return np.where(np.isfinite(least), least, 0.0)


def position_noise(positions: np.ndarray) -> np.ndarray:
    """Return the standard deviation of each joint's noise [rad], shape (joints,), from third differences.

    Those of motion are small, those of white noise σ are √20 σ.
    """
    third = np.abs(np.diff(positions, 3, axis=0))
    return 1.4826 * np.median(third, axis=0) / np.sqrt(20.0)


def time_step(time: np.ndarray) -> float:
    """Return the median of the steps that are not zero [s]; 0 if there are none."""
    steps = np.diff(time)
    return float(np.median(steps[steps > 0])) if (steps > 0).any() else 0.0


def smoothed(time: np.ndarray, positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return speed [rad/s] and acceleration [rad/s²] of noisy positions, by a cubic around each sample."""
    dt = time_step(time)
    even = _resampled(np.arange(time[0], time[-1], dt), time, positions)
    window = min(max(5, 2 * round(SMOOTHING / dt / 2) + 1), len(even) - 1 + len(even) % 2)
    speed = savgol_filter(even, window, polyorder=3, deriv=1, delta=dt, axis=0)
    return np.asarray(speed), np.asarray(savgol_filter(even, window, 3, deriv=2, delta=dt, axis=0))


def excess_time(recording: Recording) -> tuple[np.ndarray, np.ndarray]:
    """Return the time that each step's motion needed beyond its clock [s], and the motion in that time [rad].

    The excess is e = (Δq - q̇·Δt)·q̇ / |q̇|², the motion |q̇|·e, with the median speed of the neighbouring
    steps; both have the shape (samples - 1,).
    """
    steps = np.diff(recording.t_meas)[:, None]
    moved = np.diff(recording.q, axis=0)
    speed = median_filter(moved / np.maximum(steps, 1e-9), size=(NEIGHBOURS, 1), mode="nearest")
    norm = np.maximum(np.linalg.norm(speed, axis=1), 1e-9)
    surplus = ((moved - speed * steps) * speed).sum(1) / norm
    return surplus / norm, surplus


def measured_lag(recording: Recording) -> float | None:
    """Return the lag of the measured motion behind its command [s]; None if nothing moved or was commanded.

    The peak of the cross-correlation of the speeds of all joints gives a rough lag, whatever the offset of
    the clocks; then the lag τ is the one for which q(t) - q_cmd(t - τ), without its mean, is least.
    """
    dt = time_step(recording.t_meas)
    grid_cmd = np.arange(recording.t_cmd[0], recording.t_cmd[-1] + dt, dt)
    grid_meas = np.arange(recording.t_meas[0], recording.t_meas[-1], dt)
    commanded = np.diff(recording.held(grid_cmd), axis=0)
    measured = np.diff(_resampled(grid_meas, recording.t_meas, recording.q), axis=0)
    pairs = zip(measured.T, commanded.T, strict=True)
    correlation = np.sum([correlate(meas, cmd, method="fft") for meas, cmd in pairs], axis=0)
    peak = int(np.argmax(correlation))
    if correlation[peak] <= 0:
        return None
    shift = dt * correlation_lags(len(measured), len(commanded))[peak]
    lag = float(grid_meas[0] - grid_cmd[0] + shift)
    position = _resampled(grid_meas, recording.t_meas, recording.q)
    speed, _ = smoothed(recording.t_meas, recording.q)
    for _ in range(REFINEMENTS):
        sent = grid_meas - lag
        is_inside = (sent >= recording.t_cmd[0]) & (sent <= recording.t_cmd[-1])
        if not is_inside.any():
            break
        error = position[is_inside] - recording.held(sent[is_inside])
        slope = speed[is_inside] - speed[is_inside].mean(0)
        lag -= float((error * slope).sum() / max((slope**2).sum(), 1e-12))
    return lag


def _resampled(grid: np.ndarray, time: np.ndarray, positions: np.ndarray) -> np.ndarray:
    return np.stack([np.interp(grid, time, column) for column in positions.T], axis=-1)
