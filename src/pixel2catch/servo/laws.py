"""Laws of one joint and of one robot: motion of commands within limits, and checks of the inputs.

Motion: a tick chooses a speed v, which moves a position by v dt. Braking from it takes the ticks v, v - a dt,
and so on, that are above 0. A command is the mean of the newest n positions. It keeps their limits of
position, speed and acceleration, as each mean does. Its acceleration changes by (a - a of n ticks ago) / n
in a tick, which limits its jerk to 2 a / (n dt). All of this is exact in discrete time, except for rounding.

Checks: all stamps are of one monotonic clock. A stamp that is NaN or in the future counts as too old.

Limits are entries of `ServoLimits.joint_records` and `ServoLimits.robot_records`.

Compilation: numba is imported at the first call of an entry. Compiled code is kept in a folder named by a
hash of all sources, beside these or in the user's cache. Without a writable folder, each process compiles.
"""

import fcntl
import os
import shutil
from contextlib import suppress
from dataclasses import dataclass
from enum import IntFlag
from hashlib import sha256
from math import copysign
from pathlib import Path
from types import FunctionType
from typing import Any, final

import numpy as np

from pixel2catch.robots.geometry import speed_to_end
from pixel2catch.servo.link import Fault, Mode

Record = Any  #: An entry of a structured array; numba checks its fields when it compiles.
Records = Any  #: A structured array, with an entry for each robot or joint.

_COMPILED: set[FunctionType] = set()  #: Functions that entries may call when they compile.
USER_CACHE = Path("~/.cache/pixel2catch")  #: Where compiled code is kept if the package is read-only.

STOP_TIME = 0.3  #: Duration of a stop, after which the commands are constant [s]. Source: ours.
RETURN_TIME = 0.2  #: First part of a stop: commands return to the joints; then they brake [s]. Source: ours.
REST_ERROR = 0.05  #: Allowed distance of an arm joint at rest from its command [rad]. Source: ours.
JITTER = 0.015  #: A measured position may arrive later than usual by this time [s]. Source: ours.
SMOOTHING = 0.04  #: Time constant of the estimated joint speed [s]. Source: ours.
SLACK_LAGS = 3.0  #: Decay time of the distance allowed after a motion [lags]. Source: ours.
FROZEN_ANGLE = 0.01  #: Motion of a command in which the measurement must change [rad]. Source: ours.
FROZEN_TIME = 0.15  #: Longest time without such a change [s]. Source: ours, more than the lag of any servo.
LAG_MARGIN = 1.05  #: Factor on the estimated lag. Source: ours, half of the margin of the speed.
LEAST_LAG = 0.002  #: Smallest lag [s]. Source: ours, a tick.

#: Motion v² t from which a joint's lag is estimated, and over which it is averaged [rad²/s]. Source: ours;
#: 0.03 s after the beginning of a swing, and 0.02 s of the fastest.
LEAST_EVIDENCE, MOST_EVIDENCE = 0.003, 0.15
#: Lead of a command over its joint [rad], and share of it that the joint's motion explains if it follows. If
#: several joints lag behind and none follows, the driver ignores commands. Source: ours; UR's from 0.04 rad.
LEAST_AHEAD, LEAST_FOLLOWING = 0.04, 0.5
HAND_ERROR = 0.1  #: Distance of a free finger from its expected position that is a fault [rad]. Source: ours.
HAND_TIME = 0.12  #: Duration of that distance that is a fault [s]; a swing of the arm has 0.1. Source: ours.
#: Distance of a free finger joint, beyond that of every other one, that is a fault [rad], and its duration
#: [s]. Source: ours; 0.05 rad in rehearsed throws, 0.07 rad for 0.03 s in the fastest swings of an arm.
LONE_ERROR, LONE_TIME = 0.07, 0.04
#: Lead of a finger's command from which its motion is quick [rad], and duration of quick motions in which no
#: object touches the hand yet [s]. Source: ours; in 60 rehearsed throws the first contact came after 0.5 s.
QUICK_LEAD, FREE_TIME = 0.08, 0.4
CALM_ERROR, CALM_TIME = 0.05, 0.6  #: Largest error of a calm finger [rad]; duration [s]. Source: ours.
CLOCK_ERROR = 1e-3  #: Time by which a stamp may be in the future [s]. Source: ours; processes read the clock.


@final
@dataclass(eq=False)
class entry:  # noqa: N801
    """Compile a function, and all that it calls, for the types of its first call.

    Results equal those of Python and NumPy to the last bit, NaN included: no `fastmath`.
    """

    python: Any  #: The function.
    dispatcher: Any = None  #: The compiled function, from the first call on.

    def __call__(self, *arguments: object) -> Any:
        """Run the compiled function; raise TypeError for other types than those of the first call."""
        self.dispatcher = self.dispatcher or _compile(self.python, arguments)
        return self.dispatcher(*arguments)


def _compile(function: FunctionType, arguments: tuple[object, ...]) -> Any:
    import numba
    import numba.extending

    config: Any = vars(numba)["config"]
    callers = [function]
    for caller in callers:
        named = (caller.__globals__.get(name) for name in caller.__code__.co_names)
        callees = [each for each in named if isinstance(each, FunctionType) and each not in callers]
        callers += callees
        for law in {*callees} - _COMPILED:
            numba.extending.register_jitable(error_model="numpy", no_cfunc_wrapper=True)(law)
            _COMPILED.add(law)
    types = [tuple(numba.typeof(argument) for argument in arguments)]
    if folder := _cache_folder([Path(caller.__code__.co_filename) for caller in callers]):
        before, config.CACHE_DIR = config.CACHE_DIR, str(folder)
        lock = os.open(folder, os.O_RDONLY)
        try:
            with suppress(OSError):  # a file system without locks
                fcntl.flock(lock, fcntl.LOCK_EX)  # one process compiles, the others wait and load
            return numba.njit(types, cache=True, error_model="numpy", nogil=True)(function)
        except Exception:  # such as a full disk or a damaged file
            shutil.rmtree(folder, ignore_errors=True)
        finally:
            os.close(lock)
            config.CACHE_DIR = before
    return numba.njit(types, error_model="numpy", nogil=True)(function)


def _cache_folder(sources: list[Path]) -> Path | None:
    """Return a writable folder, near the first source, for the code compiled from these; None without one."""
    with suppress(OSError):
        files = sorted({*Path(__file__).parent.glob("*.py"), *sources})
        name = f"servo-{sha256(b''.join(file.read_bytes() for file in files)).hexdigest()[:32]}"
        for base in (sources[0].parent / "__pycache__", USER_CACHE.expanduser()):
            with suppress(OSError):
                (base / name).mkdir(parents=True, exist_ok=True)
                if os.access(base / name, os.W_OK):
                    return base / name
    return None


def clipped(value: float, lower: float, upper: float) -> float:
    """Clip a value to bounds; return NaN if one of the three is NaN."""
    return np.minimum(np.maximum(value, lower), upper)


def interpolated(start: float, end: float, elapsed: float, duration: float) -> float:
    """Return the position of a uniform motion after a part of its duration [rad]; then its end."""
    return start + clipped(elapsed / duration, 0.0, 1.0) * (end - start)


def stopping_speed(distance: float, limits: Record) -> float:
    """Return the largest speed [rad/s] after which braking ends within a distance [rad], 0 or more.

    Braking from v = (n + f) a dt, n whole and 0 <= f < 1, takes ((n + 1) f + n (n + 1) / 2) a dt².
    """
    share = distance / limits.bend
    whole = np.floor(np.sqrt(2.0 * share + 0.25) - 0.5)
    return (share / (whole + 1.0) + 0.5 * whole) * limits.change


def speed_to(position: float, goal: float, limits: Record) -> float:
    """Return the speed [rad/s] that leads to a goal [rad] without overshoot, without other limits."""
    distance = goal - position
    return copysign(stopping_speed(abs(distance), limits), distance)


def most_speed(to_limit: float, to_end: float, limits: Record) -> float:
    """Return the largest speed [rad/s] towards a limit and an end of the travel, at distances [rad]."""
    speed = np.minimum(stopping_speed(np.maximum(to_limit, 0.0), limits), limits.speed)
    return np.minimum(speed, speed_to_end(np.maximum(to_end, 0.0), limits.end_slope, limits.end_base))


def limited_speed(position: float, velocity: float, requested: float, limits: Record) -> float:
    """Return the speed nearest to the requested one that keeps all limits [rad, rad/s]."""
    below = most_speed(position - limits.lower, position - limits.low_end, limits)
    above = most_speed(limits.upper - position, limits.high_end - position, limits)
    slowest = np.maximum(velocity - limits.change, -below)
    return clipped(requested, slowest, np.minimum(velocity + limits.change, above))


def braked_position(position: float, velocity: float, num_ticks: int, limits: Record) -> float:
    """Return the position after a number of ticks of braking [rad]."""
    speed = abs(velocity)
    whole = np.minimum(num_ticks, np.floor(speed / limits.change))
    covered = whole * (speed - limits.change * (0.5 * whole + 0.5))
    return position + copysign(limits.dt, velocity) * covered


def braked_speed(velocity: float, limits: Record) -> float:
    """Return the speed after one tick of braking [rad/s]."""
    return copysign(np.maximum(abs(velocity) - limits.change, 0.0), velocity)


def moving_mean(recent: np.ndarray, position: float, limits: Record) -> float:
    """Append a position to the newest ones, oldest first, and return their mean: the command [rad]."""
    command, last = 0.0, len(recent) - 1
    for number in range(last + 1):
        recent[number] = recent[number + 1] if number < last else position
        if number > last - limits.window:
            command += recent[number] * limits.share
    return command


def is_recent(now: float, stamp: float, age: float) -> bool:
    """Return whether a stamp is at most so old [s]."""
    elapsed = now - stamp
    return (elapsed >= -CLOCK_ERROR) and (elapsed <= age)


def bit(fault: IntFlag, holds: bool) -> int:
    """Return the number of a flag if it holds, else 0."""
    return fault.value if holds else 0


def joint_faults(joints: Records, inputs: Records, now: float, is_commanded: bool, limits: Records) -> int:
    """Update the estimates of all joints, and return the faults of their measurements.

    An arm joint follows its servo: near its command at rest, behind it by the lag in motion. A finger may be
    stopped by what it holds. Some faults are only found in robots that have been commanded for a tick.
    """
    found, of_commands, num_fingers, num_frozen, num_off, num_ahead, num_following = 0, 0, 0, 0, 0, 0, 0
    for number in range(len(joints)):
        joint, position, stamp = joints[number], inputs[number].joint_pos, inputs[number].joint_stamp
        limit = limits[number]
        if limit.is_first:  # of its arm or hand
            num_off, num_ahead, num_following = 0, 0, 0
        is_jump = update_estimates(joint, position, stamp, is_commanded, limit)
        is_impossible = (position < limit.least) or (position > limit.most) or is_jump
        found |= bit(Fault.JOINTS_STALE, not is_recent(now, stamp, limit.position_age))
        found |= bit(Fault.JOINTS_NOT_FINITE, not np.isfinite(position))
        found |= bit(Fault.JOINTS_IMPLAUSIBLE, is_impossible)
        most = np.minimum(limit.tracking_error, REST_ERROR + limit.lag_error * joint.slack)
        is_off, is_frozen = abs(position - joint.expected) > most, joint.still_time > FROZEN_TIME
        of_commands |= bit(Fault.JOINTS_IMPLAUSIBLE, abs(position - joint.explained) > limit.escape)
        of_commands |= bit(Fault.JOINT_SPEED, abs(joint.speed) > limit.joint_speed)
        num_off += is_off and limit.is_arm
        of_commands |= bit(Fault.JOINTS_FROZEN, is_frozen and limit.is_arm)
        is_ahead = limit.is_arm and abs(joint.ahead) > LEAST_AHEAD
        num_ahead += is_ahead
        num_following += is_ahead and joint.lag * joint.speed / joint.ahead > LEAST_FOLLOWING
        is_ignored = num_off > 0 and num_ahead > 1 and num_following == 0
        of_commands |= bit(Fault.TRACKING_ERROR, is_off and limit.is_arm)
        of_commands |= bit(Fault.COMMANDS_IGNORED, is_ignored and limit.is_last)
        num_fingers += limit.is_finger
        num_frozen += is_frozen and limit.is_finger
    of_commands |= bit(Fault.JOINTS_FROZEN, num_frozen == num_fingers and num_fingers > 0)
    if of_commands & Fault.COMMANDS_IGNORED.value:
        of_commands ^= Fault.TRACKING_ERROR.value
    return found | of_commands if is_commanded else found


def hand_faults(robot: Record, joints: Records, inputs: Record, limits: Records) -> int:
    """Update how long fingers move freely, and return the faults of free fingers that do not follow.

    Until an object touches it, a hand follows its commands as an arm does; a swing of the arm drags several
    joints alike. It is free up to the ramp, for `FREE_TIME` from its first quick motion on, and again after
    it was calm for `CALM_TIME`. In a planned motion it may hold something, and is not watched.
    """
    is_quick, is_calm, is_astray, is_frozen, largest, second = False, True, False, False, 0.0, 0.0
    for number in range(len(joints)):
        joint, limit = joints[number], limits[number]
        if limit.is_finger:
            error = abs(joint.measured - joint.expected) - limit.lag_error * joint.slack
            joint.astray_time = joint.astray_time + limit.dt if error > HAND_ERROR else 0.0
            second, largest = max(second, min(largest, error)), max(largest, error)
            is_quick |= abs(joint.command - joint.expected) > QUICK_LEAD
            is_calm &= error < CALM_ERROR
            is_astray |= joint.astray_time > HAND_TIME
            is_frozen |= joint.still_time > FROZEN_TIME
    dt = limits[0].dt
    robot.lone_time = robot.lone_time + dt if largest - second > LONE_ERROR else 0.0
    is_astray |= robot.lone_time > LONE_TIME
    robot.calm_time = robot.calm_time + dt if is_calm and not is_quick else 0.0
    if robot.mode != Mode.RUN or robot.calm_time > CALM_TIME or inputs.is_planned:
        robot.free_time = FREE_TIME
    elif is_quick or robot.free_time < FREE_TIME:
        robot.free_time -= dt
    is_free = robot.free_time > 0.0 and not inputs.is_planned
    return bit(Fault.HAND_ASTRAY, is_astray and is_free) | bit(Fault.JOINTS_FROZEN, is_frozen and is_free)


def update_estimates(
    joint: Record, position: float, stamp: float, is_commanded: bool, limits: Record
) -> bool:
    """Update a joint's estimates by a position [rad] and its stamp [s]; return whether it jumped.

    A joint with a lag has the speed (command - position) / lag, and so have the means of both.
    """
    command, expected = joint.command, joint.expected
    is_new = np.isfinite(position) and np.isfinite(stamp) and not stamp <= joint.stamp
    is_next = is_new and np.isfinite(joint.stamp)
    elapsed = stamp - joint.stamp if is_next else 0.0
    moved = position - joint.measured if is_next else 0.0
    is_jump = abs(moved) > limits.jump_speed * (elapsed + JITTER)
    share = np.minimum(elapsed / SMOOTHING, 1.0)
    joint.speed *= 1.0 - share
    joint.speed += 0.0 if is_jump else moved / np.maximum(elapsed, SMOOTHING)
    if np.isfinite(position):
        least = np.minimum(np.minimum(command, expected), joint.explained) if is_commanded else position
        most = np.maximum(np.maximum(command, expected), joint.explained) if is_commanded else position
        joint.explained = np.maximum(least, np.minimum(position, most))
    decayed = joint.slack * (1.0 - limits.dt / (SLACK_LAGS * limits.lag))
    joint.slack = np.maximum(abs(command - expected), decayed)
    if not (is_commanded and moved == 0.0):
        joint.anchor = command
    is_still = abs(command - joint.anchor) > FROZEN_ANGLE
    joint.still_time = joint.still_time + limits.dt if is_still else 0.0
    ahead = (1.0 - share) * joint.ahead + (command - joint.measured if is_next else 0.0) * share
    joint.ahead = ahead if is_commanded else 0.0
    estimate_lag(joint, joint.speed * elapsed if is_commanded else 0.0, limits)
    if is_new:
        joint.measured, joint.stamp = position, stamp
    return is_jump


def estimate_lag(joint: Record, way: float, limits: Record) -> None:
    """Update the lag of a joint by a distance that it moved [rad].

    Up to the specified lag, the estimate with a margin is used; beyond it, the estimate within its error.
    """
    joint.evidence = np.minimum(joint.evidence + way * joint.speed, MOST_EVIDENCE)
    error = joint.ahead - joint.estimated_lag * joint.speed
    joint.estimated_lag += way * error / np.maximum(joint.evidence, 1e-9)
    joint.is_lag_estimated = limits.is_arm and joint.evidence >= LEAST_EVIDENCE
    joint.lag = limits.lag
    if joint.is_lag_estimated:
        most = np.minimum(np.maximum(limits.lag, joint.estimated_lag), (1.0 + limits.lag_error) * limits.lag)
        joint.lag = np.minimum(np.maximum(LAG_MARGIN * joint.estimated_lag, LEAST_LAG), most)


def update_expected(joint: Record, limits: Record) -> None:
    """Predict where the joint is a tick later, by its lag behind the command."""
    joint.expected += np.minimum(limits.dt / joint.lag, 1.0) * (joint.command - joint.expected)


def is_driven(robot: Record) -> bool:
    """Return whether the policy moves the robot, in the ramp or in the run."""
    return Mode.RAMP <= robot.mode <= Mode.RUN


def is_active(robot: Record) -> bool:
    """Return whether a fault would stop the robot."""
    return Mode.ARMED <= robot.mode <= Mode.RUN
