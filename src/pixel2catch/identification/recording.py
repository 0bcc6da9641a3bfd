"""Recorded motion of joints, trajectories of targets, and the joints of a work cell that both name."""

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import pi
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Float64, Shaped

from pixel2catch.arrays import read_arrays, write_arrays
from pixel2catch.errors import InvalidValueError, RecordingError, UnknownNameError
from pixel2catch.files import json_object, reading, take_version
from pixel2catch.robots.spec import JointGroup, JointSpec
from pixel2catch.robots.workcell import WorkcellSpec
from pixel2catch.scene.constants import SPEED_MARGIN
from pixel2catch.workcells import find_workcell
from pixel2catch.workcells.ur5e_allegro import UR5E_ALLEGRO

FORMAT_VERSION = 1  #: Version of the trajectory files.
ARRAYS = ("joints", "t_cmd", "q_cmd", "t_meas", "q")  # of the file of a recording
REST = 1.0  # least rest at each end of a trajectory [s] (ours; half of it is not compared, as servos settle)
TOLERANCE = 1e-9  # excess of a limit that is rounding [rad, s]


@dataclass(frozen=True, kw_only=True)
class MotionRange:
    """Range of the joints of a role, and of the motion that excites them."""

    reach: float  #: largest valid position of a joint in either direction; beyond it data are refused [rad]
    margin: float  #: distance of an excitation's commands from a joint's limits [rad]
    swing: float  #: largest distance from the middle of the excitation [rad]
    acceleration: float  #: largest acceleration of smooth commands [rad/s²]


MOTION_RANGES = {
    "arm": MotionRange(reach=2.0 * pi + 0.1, margin=0.03, swing=0.35, acceleration=15.0),
    "hand": MotionRange(reach=pi, margin=0.06, swing=0.4, acceleration=100.0),
}
"""By the role of a joint group. Source: reach of arms: UR, ±360°, and 0.1 rad for calibration; of hands: the
limits of ours end at 1.72 rad. The others are ours: the palm stays within 0.5 m of its start and 0.18 m above
the table. UR limits the torque only: 15 rad/s² of all joints at once take 51 N·m of the UR5e's 150. A fast
arm shakes the hand; fingers do not meet; 100 rad/s² take at most 0.22 of the Allegro hand's 0.5 N·m, several
times the dry friction, as for the arm."""


def parts(workcell: WorkcellSpec) -> dict[str, tuple[str, ...]]:
    """Return the joints of everything that can be identified alone: arms, hands, joint groups, all."""
    found = {}
    for placed in workcell.robots:
        part = placed.robot
        while part is not None:
            tool = part.tool.robot if part.tool else None
            name = part.name.removesuffix(f"_{tool.name}") if tool else part.name
            joints = (joint for group in part.groups for joint in group.joints)
            found[placed.prefix + name] = tuple(placed.prefix + joint.name for joint in joints)
            part = tool
    found |= {group.name: tuple(joint.name for joint in group.joints) for group in workcell.groups}
    return found | {workcell.name: tuple(joint.name for joint in workcell.joints)}


def joints_of(workcell: WorkcellSpec, part: str | None) -> tuple[str, ...]:
    """Return the joints of one of the `parts`, all by default; an end after `_` may be left out if unique."""
    known, name = parts(workcell), part or workcell.name
    longer = [each for each in known if each.startswith(f"{name}_")]
    name = longer[0] if name not in known and len(longer) == 1 else name
    if not known.get(name):
        raise UnknownNameError("robot", str(part), known)
    return known[name]


def specs_of(workcell: WorkcellSpec) -> dict[str, JointSpec]:
    """Return all joints by name, in joint order."""
    return {spec.name: spec for spec in workcell.joints}


def groups_of(workcell: WorkcellSpec) -> dict[str, JointGroup]:
    """Return the group of each joint, by the joint's name."""
    return {spec.name: group for group in workcell.groups for spec in group.joints}


def largest_step(joint: JointSpec) -> float:
    """Return the largest change of a target [rad] that keeps a joint at rest below its speed limit.

    A servo whose damping dominates moves at stiffness / damping times the distance of its target.
    """
    return SPEED_MARGIN * joint.velocity_limit * joint.damping / joint.stiffness


def held(
    times: Shaped[np.ndarray, " num_values"],
    values: Float[np.ndarray, "num_values num_joints"],
    at: Shaped[np.ndarray, " num_times"],
) -> Float[np.ndarray, "num_times num_joints"]:
    """Return the commands at some times: each holds until the next one, the first also before its time."""
    return values[np.maximum(np.searchsorted(times, at, side="right") - 1, 0)]


@dataclass(frozen=True, kw_only=True, eq=False)
class Recording:
    """Motion of some joints: commands at their send times, measurements at the controller's own times.

    A shape, time or value that is impossible raises RecordingError, as do files.
    """

    name: str = "recording"  #: name in messages and reports
    workcell: WorkcellSpec = UR5E_ALLEGRO  #: work cell of the joints
    joints: tuple[str, ...]  #: names of the joints, the columns of all arrays
    t_cmd: Float64[np.ndarray, " num_commands"]  #: send times of the commands [s], not decreasing
    q_cmd: Float64[np.ndarray, "num_commands num_joints"]  #: commands [rad]; each holds until the next
    t_meas: Float64[np.ndarray, " num_samples"]  #: times of the measurements [s], not decreasing
    q: Float64[np.ndarray, "num_samples num_joints"]  #: measured positions [rad]

    def __post_init__(self) -> None:
        for name, time, positions in (("q_cmd", self.t_cmd, self.q_cmd), ("q", self.t_meas, self.q)):
            require_motion(f"{self.name}: {name}", self.joints, time, positions, self.workcell)

    def held(self, time: Float[np.ndarray, " num_times"]) -> Float[np.ndarray, "num_times num_joints"]:
        """Return the newest command at each time of the commands' clock [s], as the function `held`."""
        return held(self.t_cmd, self.q_cmd, time)

    def select(self, joints: tuple[str, ...]) -> "Recording":
        """Return the motion of some joints in the given order."""
        require_joints(self.name, joints, self.joints)
        columns = [self.joints.index(joint) for joint in joints]
        return replace(self, joints=joints, q_cmd=self.q_cmd[:, columns], q=self.q[:, columns])

    def save(self, path: Path) -> None:
        """Write an npz file of the arrays, by the names of the fields; raise if the file exists."""
        arrays = {name: getattr(self, name) for name in ARRAYS[1:]}
        write_arrays(path, joints=np.array(self.joints), **arrays)

    @staticmethod
    def load(
        path: Path, workcell: WorkcellSpec = UR5E_ALLEGRO, names: Mapping[str, str] | None = None
    ) -> "Recording":
        """Read a file that `save` wrote; `names` are the work cell's names of joints by the file's."""
        with reading("recording", path, "Record or convert it again.", RecordingError):
            arrays = read_arrays(path, ARRAYS)
            if missing := [name for name in ARRAYS if name not in arrays]:
                raise RecordingError(f"no array {', '.join(missing)}; a recording has {', '.join(ARRAYS)}")
            joints = tuple((names or {}).get(name, name) for name in _texts(arrays.pop("joints")))
            arrays = {name: _numbers(values) for name, values in arrays.items()}
        if unknown := [joint for joint in joints if joint not in workcell.joint_names]:
            problem = f"{path}: work cell '{workcell.name}' has no joint {', '.join(unknown)}"
            fix = f"it has {', '.join(workcell.joint_names)}. Rename these in the file, or leave them out"
            raise RecordingError(f"{problem}; {fix}.")
        return Recording(name=str(path), workcell=workcell, joints=joints, **arrays)


def _texts(array: np.ndarray) -> tuple[str, ...]:
    if array.dtype.kind != "U":
        raise InvalidValueError(f"names of joints are of the type {array.dtype}; they must be text")
    return tuple(map(str, array.ravel()))


def _numbers(array: np.ndarray) -> np.ndarray:
    if array.dtype.kind == "U":
        raise InvalidValueError("it has text where numbers are needed")
    return array.astype(np.float64)


def require_joints(source: str, joints: Iterable[str], recorded: Iterable[str]) -> None:
    """Raise RecordingError if a source lacks one of the joints."""
    recorded = tuple(recorded)
    missing = [joint for joint in joints if joint not in recorded]
    if missing:
        raise RecordingError(
            f"{source}: no joint {', '.join(missing)}; it has {', '.join(recorded)}. Record the missing "
            "joints, name the --profile that has their names, or choose another --robot."
        )


def require_motion(
    source: str, joints: tuple[str, ...], time: np.ndarray, positions: np.ndarray, workcell: WorkcellSpec
) -> None:
    """Refuse motion that is impossible for a robot: positions [rad], a row per time [s]."""
    groups = groups_of(workcell)
    if unknown := [joint for joint in joints if joint not in groups]:
        raise UnknownNameError("joint", unknown[0], groups)
    if time.ndim != 1 or len(time) < 2:
        raise RecordingError(f"{source}: no motion, shape {time.shape}; record two rows at least.")
    if positions.shape != (len(time), len(joints)):
        raise RecordingError(
            f"{source}: shape {positions.shape}, but there are {len(time)} times and {len(joints)} joints; "
            "give every time one row and every joint one column."
        )
    times, clock = time[:, None], ("time",)
    for columns, values in ((joints, positions), (clock, times)):
        _refuse(source, columns, values, ~np.isfinite(values), "is not a number; cut the recording before it")
    is_back = np.diff(times, axis=0, prepend=times[:1]) < 0
    _refuse(source, clock, times, is_back, "s is before the row above; split the recording here, or sort it")
    reach = np.array([MOTION_RANGES[groups[joint].role].reach for joint in joints])
    too_far = "rad is farther than the joint's reach of {:.2f} rad; if the file is in degrees, convert it"
    _refuse(source, joints, positions, np.abs(positions) > reach, too_far, reach)


def _refuse(
    source: str,
    columns: Sequence[str],
    values: np.ndarray,
    is_bad: np.ndarray,
    reason: str,
    limits: np.ndarray | None = None,
) -> None:
    """Raise RecordingError with the first bad value of a table; `limits` of the columns are in the reason."""
    if is_bad.any():
        row, column = map(int, np.argwhere(is_bad)[0])
        reason = reason if limits is None else reason.format(limits[column])
        place = f"{source}, row {row}, column {columns[column]}"
        raise RecordingError(f"{place}: {values[row, column]:g} {reason}.")


@dataclass(frozen=True, kw_only=True, eq=False)
class Trajectory:
    """Targets of some joints that a robot can follow; it begins and ends at rest in the same pose.

    The file is an npz: `joints` (names), `times` [s], `positions` [rad], and `header`, a JSON text with the
    work cell and the targets' origin. A value that is not a number, or that a robot should not follow, raises
    RecordingError with its row.
    """

    workcell: WorkcellSpec = UR5E_ALLEGRO  #: work cell of the joints
    joints: tuple[str, ...]  #: names of the columns, in joint order; other joints hold the start pose
    times: Float64[np.ndarray, " num_targets"]  #: when each target is due [s], from 0
    positions: Float64[np.ndarray, "num_targets num_joints"]  #: the targets [rad]
    header: dict[str, Any] = field(default_factory=dict)  #: their origin: any content of JSON

    def __post_init__(self) -> None:
        require_motion("targets", self.joints, self.times, self.positions, self.workcell)
        known = specs_of(self.workcell)
        if not self.joints or list(self.joints) != [name for name in known if name in self.joints]:
            raise InvalidValueError(f"joints are {self.joints}; name each once, in the order {[*known]}")
        times, positions = self.times[:, None], self.positions
        is_late = np.diff(times, axis=0, prepend=-1.0) <= 0.0
        is_late[0] = times[0] != 0.0
        _refuse("targets", ("time",), times, is_late, "s: times must begin at 0 and increase")
        specs = [known[name] for name in self.joints]
        lower, upper, largest = np.array([(spec.lower, spec.upper, largest_step(spec)) for spec in specs]).T
        steps = np.abs(np.diff(positions, axis=0, prepend=positions[:1]))
        is_end = (self.times <= REST) | (self.times >= self.duration - REST)
        is_beyond = np.maximum(lower - positions, positions - upper) > TOLERANCE
        moves = (np.abs(positions - positions[0]) > TOLERANCE) & is_end[:, None]
        for is_bad, reason in (
            (is_beyond, "rad is beyond the joint's limits"),
            (steps > largest + TOLERANCE, "rad is farther from the row above than the servo's speed allows"),
            (moves, f"rad: the first and last {REST:g} s must be at rest in the start pose"),
        ):
            _refuse("targets", self.joints, positions, is_bad, reason)
        if self.duration < 2 * REST:
            raise InvalidValueError(f"it lasts {self.duration:g} s; it needs {REST:g} s of rest at each end")

    @property
    def duration(self) -> float:
        """Return the time of the last target [s]."""
        return float(self.times[-1])

    def at(self, time: Float64[np.ndarray, " num_times"]) -> Float64[np.ndarray, "num_times num_joints"]:
        """Return the targets that are due at some times [s]; the last one holds."""
        return held(self.times, self.positions, time)

    def save(self, path: Path) -> None:
        """Write the file; raise InvalidValueError if it exists."""
        header = {"format_version": FORMAT_VERSION, "workcell": self.workcell.name, **self.header}
        arrays = {"joints": np.array(self.joints), "times": self.times, "positions": self.positions}
        write_arrays(path, header=np.array(json.dumps(header, allow_nan=False)), **arrays)

    @staticmethod
    def load(path: Path) -> "Trajectory":
        """Read a file with all checks; raise InvalidValueError for no trajectory."""
        with reading("trajectory", path, "Write it again with 'pixel2catch excite'."):
            arrays = read_arrays(path, ("header", "joints", "times", "positions"))
            header = json_object(str(arrays["header"]))
            take_version(header, FORMAT_VERSION)
            return Trajectory(
                workcell=find_workcell(header.pop("workcell")),
                joints=_texts(arrays["joints"]),
                times=_numbers(arrays["times"]),
                positions=_numbers(arrays["positions"]),
                header=header,
            )
