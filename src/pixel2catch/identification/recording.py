"""What joints were commanded and did, each on its own clock, and targets that they shall follow; as files."""

import json
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Float64, Shaped

from pixel2catch.archives import read_arrays, write_arrays
from pixel2catch.errors import InvalidValueError, RecordingError, UnknownNameError
from pixel2catch.files import json_object, reading
from pixel2catch.identification.joints import MOTION_RANGES, groups_of, largest_step, specs_of
from pixel2catch.robots.workcell import WorkcellSpec
from pixel2catch.workcells import known_workcell
from pixel2catch.workcells.ur5e_allegro import UR5E_ALLEGRO

REMEDY = "Record the missing joints, rename them (--rename OURS=THEIRS), or choose another --robot."
"""What to do about joints that are not there."""

FORMAT_VERSION = 1  #: Version of the trajectory files.

REST = 1.0
"""Least time at rest, at the beginning and at the end of a trajectory [s]. Source: ours; a recording's first
half second is not compared, and a servo settles in about as long."""

TOLERANCE = 1e-9  # excess of a limit that is rounding [rad, s]


@dataclass(frozen=True, kw_only=True)
class Place:
    """Where rows of numbers come from, for messages."""

    source: str  #: file, or topic of a bag
    row: str = "row"  #: what a row is called there
    first_row: int = 0  #: number of the first one

    def at(self, index: int) -> str:
        """The place of a row."""
        return f"{self.source}, {self.row} {self.first_row + index}"


def held(
    times: Shaped[np.ndarray, " num_values"],
    values: Float[np.ndarray, "num_values num_joints"],
    at: Shaped[np.ndarray, " num_times"],
) -> Float[np.ndarray, "num_times num_joints"]:
    """Commands at some times: each holds until the next, the first also before it was sent."""
    return values[np.maximum(np.searchsorted(times, at, side="right") - 1, 0)]


@dataclass(frozen=True, kw_only=True, eq=False)
class Recording:
    """Motion of some joints: commands at their send times, measurements at the controller's times.

    The two clocks are never merged: their offset is a result, not an assumption.

    Raises:
        RecordingError: If a shape, time or value cannot be; the message says where.
        UnknownNameError: If the work cell has no such joint.
    """

    name: str = "recording"  #: what messages and reports call it
    workcell: WorkcellSpec = UR5E_ALLEGRO  #: whose joints they are
    joints: tuple[str, ...]  #: names of the joints, the columns of all arrays
    t_cmd: Float64[np.ndarray, " num_commands"]  #: send times of the commands [s], not decreasing
    q_cmd: Float64[np.ndarray, "num_commands num_joints"]  #: commands [rad]; each holds until the next
    t_meas: Float64[np.ndarray, " num_samples"]  #: times of the measurements [s], not decreasing
    q: Float64[np.ndarray, "num_samples num_joints"]  #: measured positions [rad]
    qd: Float64[np.ndarray, "num_samples num_joints"] | None = None  #: speeds [rad/s], if recorded
    effort: Float64[np.ndarray, "num_samples num_joints"] | None = None  #: torques [N·m], if recorded

    def __post_init__(self) -> None:
        """Refuse what no robot can have done."""
        _require_known(self.joints, self.workcell)
        commanded = Place(source=f"{self.name}: q_cmd")
        require_motion(commanded, self.joints, self.t_cmd, self.q_cmd, workcell=self.workcell)
        measured = Place(source=f"{self.name}: q, qd, effort")
        extra = [values for values in (self.qd, self.effort) if values is not None]
        require_motion(measured, self.joints, self.t_meas, self.q, *extra, workcell=self.workcell)

    def held(self, time: Float[np.ndarray, " num_times"]) -> Float[np.ndarray, "num_times num_joints"]:
        """The command at some times of its own clock [s]; see `held`."""
        return held(self.t_cmd, self.q_cmd, time)

    def select(self, joints: tuple[str, ...]) -> "Recording":
        """The motion of some of the joints, in the order given.

        Raises:
            RecordingError: If the recording lacks one of them.
        """
        missing = [joint for joint in joints if joint not in self.joints]
        if missing:
            recorded = ", ".join(self.joints)
            raise RecordingError(
                f"{self.name}: no joint {', '.join(missing)}; recorded are {recorded}. {REMEDY}"
            )
        columns = [self.joints.index(joint) for joint in joints]
        arrays = {
            name: values if name.startswith("t_") else values[:, columns]
            for name, values in self._arrays().items()
        }
        return Recording(name=self.name, joints=joints, workcell=self.workcell, **arrays)

    def save(self, path: Path) -> None:
        """Write the canonical file: an npz with the arrays under the names of the fields.

        Raises:
            InvalidValueError: If the file exists; nothing is overwritten.
        """
        write_arrays(path, joints=np.array(self.joints), **self._arrays())

    @staticmethod
    def load(
        path: Path,
        ours: Callable[[Iterable[str]], tuple[str, ...]] = tuple,
        workcell: WorkcellSpec = UR5E_ALLEGRO,
    ) -> "Recording":
        """Read a canonical file; `ours` makes our names of its names of joints.

        Raises:
            RecordingError: If it is no such file, or what it says cannot be.
        """
        required = ("joints", "t_cmd", "q_cmd", "t_meas", "q")
        with reading("recording", path, "Record or convert it again.", RecordingError):
            arrays = read_arrays(path, (*required, "qd", "effort"))
            missing = [name for name in required if name not in arrays]
            if missing:
                raise RecordingError(
                    f"no array {', '.join(missing)}; a recording has {', '.join(required)}, and may have qd "
                    "and effort"
                )
            joints = ours(_texts(arrays.pop("joints")))
            arrays = {name: _numbers(values) for name, values in arrays.items()}
        known = specs_of(workcell)
        unknown = [joint for joint in joints if joint not in known]
        if unknown:
            raise RecordingError(
                f"{path}: {', '.join(unknown)} are no joints of ours; rename them (--rename OURS=THEIRS), "
                f"or leave them out. Ours are {', '.join(known)}."
            )
        return Recording(name=str(path), workcell=workcell, joints=joints, **arrays)

    def _arrays(self) -> dict[str, np.ndarray]:
        arrays = {field.name: getattr(self, field.name) for field in fields(self)[3:]}
        return {name: values for name, values in arrays.items() if values is not None}


def _texts(array: np.ndarray) -> tuple[str, ...]:
    if array.dtype.kind != "U":
        raise InvalidValueError(f"names of joints are of the type {array.dtype}; they must be text")
    return tuple(map(str, array.ravel()))


def _numbers(array: np.ndarray) -> np.ndarray:
    if array.dtype.kind == "U":
        raise InvalidValueError("it has text where numbers are needed")
    return array.astype(np.float64)


def _require_known(joints: Iterable[str], workcell: WorkcellSpec) -> None:
    for joint in joints:
        if joint not in specs_of(workcell):
            raise UnknownNameError("joint", joint, specs_of(workcell))


def require_motion(
    place: Place,
    joints: tuple[str, ...],
    time: np.ndarray,
    positions: np.ndarray,
    *others: np.ndarray,
    workcell: WorkcellSpec = UR5E_ALLEGRO,
) -> None:
    """Refuse motion that no robot can have done, whatever file it came from.

    Times [s] are of shape (rows,), positions [rad] and others, such as speeds, of shape (rows, joints).

    Raises:
        RecordingError: If there are no rows, shapes part, a value is not finite, time runs backwards or
            positions are beyond every joint's reach.
    """
    if time.ndim != 1 or len(time) < 2:
        raise RecordingError(f"{place.source}: no motion, shape {time.shape}; at least two rows are needed.")
    for values in (positions, *others):
        shape = (len(time), len(joints))
        if values.shape != shape:
            raise RecordingError(
                f"{place.source}: shape {values.shape}, but {shape[0]} times and {shape[1]} joints need "
                f"{shape}; give every time one row and every joint one column."
            )
    for columns, values in (*((joints, each) for each in (positions, *others)), (("time",), time[:, None])):
        if not np.isfinite(values).all():
            row, column = map(int, np.argwhere(~np.isfinite(values))[0])
            raise RecordingError(
                f"{place.at(row)}, column {columns[column]}: {values[row, column]} is no number; "
                "cut the recording before this row or record again."
            )
    backwards = np.flatnonzero(np.diff(time) < 0)
    if len(backwards):
        row = int(backwards[0]) + 1
        raise RecordingError(
            f"{place.at(row)}: time runs backwards, {time[row]:.6f} s after {time[row - 1]:.6f} s; "
            "split the recording here, or sort it if two writers shared the file."
        )
    groups = groups_of(workcell)
    reach = np.array([MOTION_RANGES[groups[joint].role].reach for joint in joints])
    beyond = np.argwhere(np.abs(positions) > reach)
    if len(beyond):
        row, column = map(int, beyond[0])
        raise RecordingError(
            f"{place.at(row)}, column {joints[column]}: {positions[row, column]:g} rad is beyond "
            f"the joint's reach of {reach[column]:.2f} rad; if the file is in degrees, convert it to radians."
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class Trajectory:
    """Targets of some joints that a robot can be let loose on; it begins and ends at rest in the same pose.

    A target holds until the next one, as a command in a recording does: whoever follows the trajectory sends,
    in every turn of its loop, the target that is due (`at`). The file is an npz: `joints` (names), `times`
    [s], `positions` [rad], and `header`, a JSON text that says whose joints they are, and where the targets
    come from.

    Raises:
        InvalidValueError: If a robot should not follow it; the message says where.
        RecordingError: If a value is no number, or times and positions do not fit together.
        UnknownNameError: If the work cell has no such joint.
    """

    workcell: WorkcellSpec = UR5E_ALLEGRO  #: whose joints they are
    joints: tuple[str, ...]  #: names of the columns, in joint order; other joints hold the start pose
    times: Float64[np.ndarray, " num_targets"]  #: when each target is due [s], from 0
    positions: Float64[np.ndarray, "num_targets num_joints"]  #: the targets [rad]
    header: dict[str, Any] = field(default_factory=dict)  #: where they come from: anything that JSON can hold

    def __post_init__(self) -> None:
        """Refuse what no robot should be sent."""
        known = specs_of(self.workcell)
        _require_known(self.joints, self.workcell)
        if not self.joints or list(self.joints) != [name for name in known if name in self.joints]:
            raise InvalidValueError(
                f"joints are {list(self.joints)}; name each once, in the order {list(known)}"
            )
        place = Place(source="targets")
        require_motion(place, self.joints, self.times, self.positions, workcell=self.workcell)
        late = np.flatnonzero(np.diff(self.times) <= 0.0)
        if self.times[0] != 0.0 or len(late):
            row = int(late[0]) + 1 if len(late) else 0
            raise InvalidValueError(
                f"target {row} is due at {self.times[row]:g} s; times begin at 0 and grow"
            )
        self._require_limits()
        is_end = (self.times <= REST) | (self.times >= self.duration - REST)
        moves = (np.abs(self.positions - self.positions[0]) > TOLERANCE) & is_end[:, None]
        self._refuse(moves, f"parts from the start pose in the first or last {REST:g} s, which are for rest")
        if self.duration < 2 * REST:
            raise InvalidValueError(f"it lasts {self.duration:g} s; it needs {REST:g} s of rest at each end")

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
        header = {"format_version": FORMAT_VERSION, "workcell": self.workcell.name, **self.header}
        arrays = {"joints": np.array(self.joints), "times": self.times, "positions": self.positions}
        write_arrays(path, header=np.array(json.dumps(header, allow_nan=False)), **arrays)

    @staticmethod
    def load(path: Path) -> "Trajectory":
        """Read a file, with all checks; one that names no work cell is of the paper's.

        Raises:
            InvalidValueError: If it is no such file, or a robot should not follow it.
        """
        with reading("trajectory", path, "Write it again with 'pixel2catch excite'."):
            arrays = read_arrays(path, ("header", "joints", "times", "positions"))
            header = json_object(str(arrays["header"]))
            version = header.pop("format_version")
            if version != FORMAT_VERSION:
                raise InvalidValueError(f"format_version is {version}, this code reads {FORMAT_VERSION}")
            return Trajectory(
                workcell=known_workcell(header.pop("workcell", UR5E_ALLEGRO.name)),
                joints=_texts(arrays["joints"]),
                times=_numbers(arrays["times"]),
                positions=_numbers(arrays["positions"]),
                header=header,
            )

    def _require_limits(self) -> None:
        specs = [specs_of(self.workcell)[name] for name in self.joints]
        lower, upper = np.array([(spec.lower, spec.upper) for spec in specs]).T
        excess = np.maximum(lower - self.positions, self.positions - upper)
        self._refuse(excess > TOLERANCE, "is beyond the joint's limits")
        steps = np.abs(np.diff(self.positions, axis=0, prepend=self.positions[:1]))
        allowed = np.array([largest_step(spec) for spec in specs])
        is_far = steps > allowed + TOLERANCE
        self._refuse(is_far, "is farther from the target before than the servo's speed allows")

    def _refuse(self, is_bad: np.ndarray, reason: str) -> None:
        """Name the first bad target."""
        if is_bad.any():
            row, column = map(int, np.argwhere(is_bad)[0])
            raise InvalidValueError(
                f"target {row} ({self.times[row]:.3f} s) of {self.joints[column]}, "
                f"{self.positions[row, column]:.4f} rad, {reason}"
            )
