"""Joint targets over time, for a robot to follow: the file that `pixel2catch excite` writes.

The file is an npz: `joints` (names), `times` [s], `positions` [rad], and `header`, a JSON text that says
where the targets come from. A target holds until the next one, as a command in a recording does: whoever
follows the trajectory sends, in every turn of its loop, the target that is due (`Trajectory.at`).
"""

import io
import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
from jaxtyping import Float64

from pixel2catch.errors import InvalidValueError, Pixel2CatchError, UnknownNameError
from pixel2catch.files import write_atomically
from pixel2catch.identification.recording import Place, held, require_motion
from pixel2catch.identification.robot import ROBOT, Robot, largest_step

FORMAT_VERSION = 1

REST = 1.0
"""Least time at rest, at the beginning and at the end [s].

Source: ours; a recording's first half second is not compared, and a servo settles in about as long.
"""

UNREADABLE = (
    OSError,
    EOFError,
    BadZipFile,
    ValueError,
    KeyError,
    TypeError,
    AttributeError,
    Pixel2CatchError,
)
"""What reading a file that is no trajectory, or none to follow, can raise."""

TOLERANCE = 1e-9  # excess of a limit that is rounding [rad, s]


@dataclass(frozen=True, kw_only=True, eq=False)
class Trajectory:
    """Targets of some joints that a robot can be let loose on; it begins and ends at rest in the same pose.

    Raises:
        InvalidValueError: If a robot should not follow it; the message says where.
        RecordingError: If a value is no number, or times and positions do not fit together.
        UnknownNameError: If the robot has no such joint.
    """

    robot: Robot = ROBOT  # whose joints they are
    # names of the joints, the columns, in joint order; the others hold the start pose
    joints: tuple[str, ...]
    times: Float64[np.ndarray, " num_targets"]  # when each target is due [s], from 0
    positions: Float64[np.ndarray, "num_targets num_joints"]  # the targets [rad]
    header: dict[str, Any] = field(default_factory=dict)  # where they come from: anything that JSON can hold

    def __post_init__(self) -> None:
        """Refuse what no robot should be sent."""
        known = list(self.robot.specs)
        for joint in self.joints:
            if joint not in known:
                raise UnknownNameError("joint", joint, known)
        if not self.joints or list(self.joints) != [name for name in known if name in self.joints]:
            raise InvalidValueError(f"joints are {list(self.joints)}; name each once, in the order {known}")
        require_motion(Place(source="targets"), self.joints, self.times, self.positions, robot=self.robot)
        self._require_clock()
        self._require_limits()
        self._require_rest()

    @property
    def duration(self) -> float:
        """Time of the last target [s]."""
        return float(self.times[-1])

    def at(self, time: Float64[np.ndarray, " num_times"]) -> Float64[np.ndarray, "num_times num_joints"]:
        """The targets that are due at some times [s]; before the first and after the last they hold."""
        return held(self.times, self.positions, time)

    def save(self, path: Path) -> None:
        """Write the file.

        Raises:
            InvalidValueError: If it exists; nothing is overwritten.
        """
        if path.exists():
            raise InvalidValueError(f"{path} exists; choose another name or remove it.")
        header = json.dumps({"format_version": FORMAT_VERSION, **self.header}, allow_nan=False)
        arrays = {"joints": np.array(self.joints), "times": self.times, "positions": self.positions}
        buffer = io.BytesIO()
        np.savez_compressed(buffer, allow_pickle=False, header=np.array(header), **arrays)
        write_atomically({path: buffer.getvalue()})

    @staticmethod
    def load(path: Path) -> "Trajectory":
        """Read a file, with all checks.

        Raises:
            InvalidValueError: If it is no such file, or a robot should not follow it.
        """
        try:
            with np.load(path, allow_pickle=False) as file:
                header = json.loads(str(file["header"]))
                version = header.pop("format_version")
                if version != FORMAT_VERSION:
                    raise InvalidValueError(f"format_version is {version}, this code reads {FORMAT_VERSION}")
                return Trajectory(
                    joints=tuple(map(str, np.atleast_1d(file["joints"]))),
                    times=np.asarray(file["times"], dtype=np.float64),
                    positions=np.asarray(file["positions"], dtype=np.float64),
                    header=header,
                )
        except UNREADABLE as error:
            raise InvalidValueError(
                f"cannot follow the trajectory '{path}': {error}. Write it again with 'pixel2catch excite'."
            ) from error

    def _require_clock(self) -> None:
        late = np.flatnonzero(np.diff(self.times) <= 0.0)
        if self.times[0] != 0.0 or len(late):
            row = int(late[0]) + 1 if len(late) else 0
            raise InvalidValueError(
                f"target {row} is due at {self.times[row]:g} s; times begin at 0 and grow"
            )

    def _require_limits(self) -> None:
        specs = [self.robot.specs[name] for name in self.joints]
        lower, upper = np.array([(spec.lower, spec.upper) for spec in specs]).T
        excess = np.maximum(lower - self.positions, self.positions - upper)
        self._refuse(excess > TOLERANCE, "is beyond the joint's limits")
        steps = np.abs(np.diff(self.positions, axis=0, prepend=self.positions[:1]))
        allowed = np.array([largest_step(spec) for spec in specs])
        self._refuse(
            steps > allowed + TOLERANCE, "is farther from the target before than the servo's speed allows"
        )

    def _require_rest(self) -> None:
        is_end = (self.times <= REST) | (self.times >= self.duration - REST)
        moves = (np.abs(self.positions - self.positions[0]) > TOLERANCE) & is_end[:, None]
        self._refuse(moves, f"parts from the start pose in the first or last {REST:g} s, which are for rest")
        if self.duration < 2 * REST:
            raise InvalidValueError(f"it lasts {self.duration:g} s; it needs {REST:g} s of rest at each end")

    def _refuse(self, is_bad: np.ndarray, reason: str) -> None:
        """Name the first bad target."""
        if is_bad.any():
            row, column = map(int, np.argwhere(is_bad)[0])
            raise InvalidValueError(
                f"target {row} ({self.times[row]:.3f} s) of {self.joints[column]}, "
                f"{self.positions[row, column]:.4f} rad, {reason}"
            )
