"""A robot that follows a motion instead of a policy: that of `excite`, a way to a pose, or a joint check.

In the joint check each joint moves by a few degrees, and the encoder that follows is compared.
"""

import json
import re
from collections.abc import Callable
from dataclasses import replace
from datetime import date
from math import inf
from pathlib import Path
from typing import Any

import numpy as np

from pixel2catch.deployment.control_loop import Connection
from pixel2catch.deployment.paths import Motion, blind_targets
from pixel2catch.deployment.statistics import RunStatistics
from pixel2catch.errors import DeploymentError
from pixel2catch.ros2 import messages
from pixel2catch.ros2.profile import Profile
from pixel2catch.ros2.transport import Topic
from pixel2catch.servo.laws import USER_CACHE
from pixel2catch.servo.limits import STOP_TIME, Joints, ServoLimits
from pixel2catch.servo.link import Command, Fault, Mode, flag_names

PERIOD = 0.01  #: Time between two targets [s]. Source: ours.
START_ERROR = 0.02  #: Motion of a joint after which a motion is planned again [rad]. Source: ours.

ANGLES = {"arm": 0.035, "hand": 0.1}  #: Motion of a joint by its role [rad]. Source: ours; 2° and 6°.
SPEEDS = {"arm": 0.1, "hand": 0.25}  #: Largest speed by role [rad/s]. Source: ours.
LEAST_MOTION = 0.003  #: Motion of a command that is compared [rad]. Source: ours.
LEAST_GAIN = 0.4  #: Motion of an encoder over that of the command that it follows. Source: ours.
GAIN_ERROR = 0.3  #: Largest error of that ratio. Source: ours; lag and friction reduce it.
LAGS = np.arange(0.0, 0.3, 0.004)  #: Lags that are compared [s].
LAG_ERROR = 0.08  #: Time by which a joint may follow later than twice its lag [s]. Source: ours.


def follow(
    plan: Callable[[Joints], Motion],
    what: str,
    connection: Connection,
    topic: Topic,
    is_over: Callable[[], bool],
    on_status: Callable[[dict[str, Any]], None],
    on_command: Callable[[Command], None] = lambda _: None,
) -> bool:
    """Plan a motion from the measured pose, announce it, and follow it once, when the servo is armed.

    It is planned again if somebody moves the robot before. In the servo's ramp, the robot moves to the first
    targets. Operator and servo guard it. A status is published with every target; its "done" is the share of
    the motion that was sent. Returns whether the motion was followed to its end, not ended by `is_over`.
    Raises DeploymentError if there is no such motion, or servo or robot have stopped.
    """
    statistics, clock = RunStatistics(tick=connection.tick), connection.clock
    publisher = connection.transport.publisher(topic)
    motion, targets, start, joint_pos = None, None, np.array(inf), np.array(np.nan)
    armed_at, share, due, announced = inf, 0.0, clock.now(), ""
    while share < 1.0 and not is_over():
        for command in connection.receive():
            statistics.note_command(command)
            on_command(command)
            joint_pos, armed_at = command.joint_pos, _armed_at(command, armed_at)
        if targets is None and np.abs(joint_pos - start).max() > START_ERROR:
            motion, start = plan(joint_pos), joint_pos
            armed_at = max(armed_at, clock.now())
            announced = f"{what}: {motion.duration:.0f} s of motion. "
        if motion and armed_at < inf:
            now = clock.now()
            elapsed = now - armed_at - ServoLimits.ramp_time
            share = min(max(elapsed / motion.duration, 0.0), 1.0)
            targets = blind_targets(motion.at(elapsed), now)
            connection.servo.send(targets)
        status = statistics.status(None, announced + connection.record(targets))
        publisher.publish(messages.text(json.dumps(status)))
        on_status(status | {"done": share})
        due = max(due + PERIOD, clock.now())
        clock.sleep_until(due)
    if targets:
        connection.servo.send(replace(targets, target_stamp=clock.now(), is_stop_requested=True))
    clock.sleep_until(clock.now() + STOP_TIME)
    connection.record()
    return share == 1.0


def _armed_at(command: Command, before: float) -> float:
    """Return when the servo was first armed, `before` if finite [s]; raise if it has stopped since."""
    if command.mode == Mode.STOPPED and before < inf:
        raise DeploymentError(
            f"the robot was stopped ({', '.join(flag_names(Fault, command.stopped_by))}) "
            f"{command.time - before:.1f} s after it was armed: remove the reason, and begin again."
        )
    return min(before, command.time) if command.mode == Mode.ARMED else before


class JointCheck:
    """Plans the motion, keeps the servo's commands, and finds the joints that do not fit the profile."""

    def __init__(self, limits: ServoLimits) -> None:
        workcell, self._limits = limits.workspace.workcell, limits
        self._names = workcell.joint_names
        self._roles = [group.role for group in workcell.groups for _ in group.joints]
        self._rows: list[tuple[float, Joints, Joints]] = []

    def plan(self, start: Joints) -> Motion:
        """Return the motion of one joint after the other from a pose and back [rad]."""
        middle = (self._limits.joints.lower + self._limits.joints.upper) / 2.0
        steps = np.diag(np.copysign([ANGLES[role] for role in self._roles], middle - start))
        poses = np.array([start, *(pose for step in steps for pose in (start + step, start))])
        speeds = [SPEEDS[role] for role in self._roles]
        return Motion.along(poses, np.minimum(speeds, self._limits.joint_records["even_speed"]))

    def note(self, command: Command) -> None:
        """Keep a command of the servo, if it has commanded and measured positions."""
        if np.isfinite([command.joint_pos_command, command.joint_pos]).all():
            self._rows.append((command.time, command.joint_pos_command, command.joint_pos))

    def findings(self) -> list[str]:
        """Return the faults in the order of the joints; a joint that was not moved has none."""
        if not self._rows:
            return []
        times, commands, measured = map(np.array, zip(*self._rows, strict=True))
        commands, measured = (commands - commands[0]).T, (measured - measured[0]).T
        moved = [i for i, moves in enumerate(commands) if np.abs(moves).max() > LEAST_MOTION]
        found = [(self._names[i], self._fault(i, times, commands[i], measured)) for i in moved]
        return [f"{name} {fault}" for name, fault in found if fault]

    def _fault(self, number: int, times: Joints, moves: Joints, measured: np.ndarray) -> str:
        """Return the fault of a joint by the motions of its command and of all encoders; empty without."""
        rows = np.abs(moves) > LEAST_MOTION
        followed = np.array([[np.interp(times[rows] + lag, times, q) for q in measured] for lag in LAGS])
        gains = followed @ moves[rows] / (moves[rows] @ moves[rows])
        best = int(np.abs(gains).max(axis=1).argmax())
        own, first, lag = gains[best, number], int(np.abs(gains[best]).argmax()), LAGS[best]
        expected = self._limits.joints.lag[number]
        if abs(gains[best, first]) < LEAST_GAIN:
            return "does not follow: check its drive, the order in the profile, and the driver"
        if abs(own) < LEAST_GAIN:
            return f"is exchanged: {self._names[first]} follows its command; correct the profile"
        if own < 0.0:
            return "is inverted: it moves against its command"
        if abs(own - 1.0) > GAIN_ERROR:
            return f"has another scale: it moves {own:.2f} times as far as its command"
        return f"follows after {lag:.2f} s, not {expected:.2f} s" if lag > 2.0 * expected + LAG_ERROR else ""


def check_joints(
    connection: Connection,
    profile: Profile,
    limits: ServoLimits,
    is_over: Callable[[], bool],
    on_status: Callable[[dict[str, Any]], None],
) -> None:
    """Let each joint move by some degrees, and write the record of today; for the arguments see `follow`.

    Raises DeploymentError if a joint does not fit the profile, or not all were moved.
    """
    check, topic, reason = JointCheck(limits), profile.operator.status, "it was ended"
    try:
        is_done = follow(check.plan, "joint check", connection, topic, is_over, on_status, check.note)
    except DeploymentError as error:
        is_done, reason = False, str(error)
    if wrong := [*check.findings(), *([] if is_done else [reason])]:
        raise DeploymentError(f"joint check: {'; '.join(wrong)}")
    path = record_of_today(profile.name)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.touch()


def record_of_today(profile: str) -> Path:
    """Return the file that exists once the joints of a profile of this name were checked today."""
    name = re.sub(r"\W", "_", profile)[:64]  # the name is from a file, and may contain a path
    return USER_CACHE.expanduser() / f"joints-{name}-{date.today():%Y-%m-%d}"
