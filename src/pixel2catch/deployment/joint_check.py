"""The joint check: each joint moves by a few degrees, and the encoder that follows is compared."""

import re
from collections.abc import Callable
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np

from pixel2catch.deployment.control_loop import Connection
from pixel2catch.deployment.follower import follow
from pixel2catch.deployment.paths import Motion
from pixel2catch.errors import DeploymentError
from pixel2catch.ros2.profile import Profile
from pixel2catch.servo.laws import USER_CACHE
from pixel2catch.servo.limits import Joints, ServoLimits
from pixel2catch.servo.link import Command

ANGLES = {"arm": 0.035, "hand": 0.1}  #: Motion of a joint by its role [rad]. Source: ours; 2° and 6°.
SPEEDS = {"arm": 0.1, "hand": 0.25}  #: Largest speed by role [rad/s]. Source: ours.
LEAST_MOTION = 0.003  #: Motion of a command that is compared [rad]. Source: ours.
LEAST_GAIN = 0.4  #: Motion of an encoder over that of the command that it follows. Source: ours.
GAIN_ERROR = 0.3  #: Largest error of that ratio. Source: ours; lag and friction reduce it.
LAGS = np.arange(0.0, 0.3, 0.004)  #: Lags that are compared [s].
LAG_ERROR = 0.08  #: Time by which a joint may follow later than twice its lag [s]. Source: ours.


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
