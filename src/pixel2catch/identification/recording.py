"""What was commanded and what was measured, each on its own clock: the input of the identification."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, fields
from pathlib import Path
from zipfile import BadZipFile

import numpy as np
from jaxtyping import Float, Float64, Shaped

from pixel2catch.errors import RecordingError, UnknownNameError
from pixel2catch.identification.robot import ROBOT, Robot

REMEDY = "Record the missing joints, rename them (--rename OURS=THEIRS), or choose another --robot."
"""What to do about joints that are not there."""


@dataclass(frozen=True, kw_only=True)
class Place:
    """Where rows of numbers come from, for messages."""

    source: str  # file, or topic of a bag
    row: str = "row"  # what a row is called there
    first_row: int = 0  # number of the first one

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
        UnknownNameError: If the robot has no such joint.
    """

    name: str = "recording"  # what messages and reports call it
    robot: Robot = ROBOT  # whose joints they are
    joints: tuple[str, ...]  # names of the joints, the columns of all arrays
    t_cmd: Float64[np.ndarray, " num_commands"]  # send times of the commands [s], not decreasing
    # commanded positions [rad]; each holds until the next
    q_cmd: Float64[np.ndarray, "num_commands num_joints"]
    t_meas: Float64[np.ndarray, " num_samples"]  # times of the measurements [s], not decreasing
    q: Float64[np.ndarray, "num_samples num_joints"]  # measured positions [rad]
    # measured speeds [rad/s], if they were recorded
    qd: Float64[np.ndarray, "num_samples num_joints"] | None = None
    # measured torques [N·m], if they were recorded
    effort: Float64[np.ndarray, "num_samples num_joints"] | None = None

    def __post_init__(self) -> None:
        """Refuse what no robot can have done."""
        for joint in self.joints:
            if joint not in self.robot.specs:
                raise UnknownNameError("joint", joint, self.robot.specs)
        commanded = Place(source=f"{self.name}: q_cmd")
        require_motion(commanded, self.joints, self.t_cmd, self.q_cmd, robot=self.robot)
        measured = Place(source=f"{self.name}: q, qd, effort")
        extra = [values for values in (self.qd, self.effort) if values is not None]
        require_motion(measured, self.joints, self.t_meas, self.q, *extra, robot=self.robot)

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
        return Recording(name=self.name, joints=joints, robot=self.robot, **arrays)

    def save(self, path: Path) -> None:
        """Write the canonical file: an npz with the arrays under the names of the attributes.

        Raises:
            RecordingError: If the file exists; nothing is overwritten.
        """
        try:
            with path.open("xb") as file:
                np.savez_compressed(file, allow_pickle=False, joints=np.array(self.joints), **self._arrays())
        except FileExistsError:
            raise RecordingError(f"{path} exists; choose another name or remove it.") from None

    @staticmethod
    def load(
        path: Path, ours: Callable[[Iterable[str]], tuple[str, ...]] = tuple, robot: Robot = ROBOT
    ) -> "Recording":
        """Read a canonical file; `ours` makes our names of its names of joints.

        Raises:
            RecordingError: If it is no such file, or what it says cannot be.
        """
        required = ("joints", "t_cmd", "q_cmd", "t_meas", "q")
        try:
            with np.load(path, allow_pickle=False) as file:
                arrays = {name: file[name] for name in (*required, "qd", "effort") if name in file}
                missing = [name for name in required if name not in arrays]
                if missing:
                    raise RecordingError(
                        f"{path}: no array {', '.join(missing)}; a recording has {', '.join(required)}, "
                        "and may have qd and effort."
                    )
                joints = ours(map(str, np.atleast_1d(arrays.pop("joints"))))
                arrays = {name: np.asarray(values, dtype=np.float64) for name, values in arrays.items()}
        except (OSError, EOFError, BadZipFile, ValueError) as error:
            raise RecordingError(
                f"{path}: not a readable npz file ({error}); record or convert it again."
            ) from None
        unknown = [joint for joint in joints if joint not in robot.specs]
        if unknown:
            raise RecordingError(
                f"{path}: {', '.join(unknown)} are no joints of ours; rename them (--rename OURS=THEIRS), "
                f"or leave them out. Ours are {', '.join(robot.specs)}."
            )
        return Recording(name=str(path), robot=robot, joints=joints, **arrays)

    def _arrays(self) -> dict[str, np.ndarray]:
        arrays = {field.name: getattr(self, field.name) for field in fields(self)[3:]}
        return {name: values for name, values in arrays.items() if values is not None}


def require_motion(
    place: Place,
    joints: tuple[str, ...],
    time: np.ndarray,
    positions: np.ndarray,
    *others: np.ndarray,
    robot: Robot = ROBOT,
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
        _require_finite(place, joints, values)
    _require_finite(place, ("time",), time[:, None])
    backwards = np.flatnonzero(np.diff(time) < 0)
    if len(backwards):
        row = int(backwards[0]) + 1
        raise RecordingError(
            f"{place.at(row)}: time runs backwards, {time[row]:.6f} s after {time[row - 1]:.6f} s; "
            "split the recording here, or sort it if two writers shared the file."
        )
    reach = np.array([robot.group_of[joint].reach for joint in joints])
    beyond = np.argwhere(np.abs(positions) > reach)
    if len(beyond):
        row, column = map(int, beyond[0])
        raise RecordingError(
            f"{place.at(row)}, column {joints[column]}: {positions[row, column]:g} rad is beyond "
            f"the joint's reach of {reach[column]:.2f} rad; if the file is in degrees, convert it to radians."
        )


def _require_finite(place: Place, columns: tuple[str, ...], values: np.ndarray) -> None:
    if not np.isfinite(values).all():
        row, column = map(int, np.argwhere(~np.isfinite(values))[0])
        raise RecordingError(
            f"{place.at(row)}, column {columns[column]}: {values[row, column]} is no number; "
            "cut the recording before this row or record again."
        )


@dataclass(frozen=True, kw_only=True)
class Table:
    """A text table: cells become numbers when a column is asked for."""

    path: Path
    names: tuple[str, ...]  # names of the columns
    rows: tuple[tuple[str, ...], ...]  # cells as text, row by row
    place: Place  # what rows are called in messages: lines of the file, counted from 1

    def column(self, name: str) -> np.ndarray:
        """The numbers of a column.

        Raises:
            RecordingError: If there is no such column, or a cell is no number.
        """
        if name not in self.names:
            raise RecordingError(
                f"{self.path}: no column {name}; it has {', '.join(self.names)}. "
                "Record this column, or give it this name in the first line."
            )
        index = self.names.index(name)
        numbers = np.empty(len(self.rows))
        for i, row in enumerate(self.rows):
            try:
                numbers[i] = float(row[index])
            except ValueError:
                raise RecordingError(
                    f"{self.place.at(i)}, column {name}: '{row[index]}' is no number; "
                    "correct or cut this line."
                ) from None
        return numbers

    def columns(self, names: Iterable[str]) -> np.ndarray:
        """The numbers of several columns, shape (rows, columns); raises as `column` does."""
        return np.stack([self.column(name) for name in names], axis=-1)


def read_table(path: Path, names: tuple[str, ...] = ()) -> Table:
    """Read a table of cells between commas, or between spaces where there is no comma.

    Its first line names the columns, unless their names are given.

    Raises:
        RecordingError: If the file cannot be read, is empty, or a line has too few or too many cells.
    """
    try:
        lines = path.read_text(encoding="utf-8-sig").strip().splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise RecordingError(f"{path}: not a readable text file ({error}).") from None
    cells = [line.split(",") if "," in line else line.split() for line in lines]
    rows = tuple(tuple(cell.strip() for cell in row) for row in cells)
    first = 0 if names else 1
    if len(rows) <= first:
        raise RecordingError(f"{path}: empty, there is no line of numbers; record again.")
    place = Place(source=str(path), row="line", first_row=1 + first)
    table = Table(path=path, names=names or rows[0], rows=rows[first:], place=place)
    for i, row in enumerate(table.rows):
        if len(row) != len(table.names):
            raise RecordingError(
                f"{place.at(i)}: {len(row)} columns instead of {len(table.names)}; "
                "correct or cut this line (the last one may have been cut off while recording)."
            )
    return table
