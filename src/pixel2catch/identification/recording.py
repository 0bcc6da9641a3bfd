"""What was commanded and what was measured, each on its own clock: the input of the identification."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, fields
from pathlib import Path
from zipfile import BadZipFile

import numpy as np
from jaxtyping import Float64
from numpy.lib.npyio import NpzFile

from pixel2catch.errors import RecordingError, UnknownNameError
from pixel2catch.identification.rules import Place, require_motion
from pixel2catch.robot.constants import ARM_JOINTS, HAND_JOINTS, JOINTS, JointSpec

JOINT_SPECS: dict[str, JointSpec] = {spec.name: spec for spec in JOINTS}
"""All joints that can be identified, by name, in joint order."""

ROBOTS: dict[str, tuple[str, ...]] = {
    "ur5e": tuple(spec.name for spec in ARM_JOINTS),
    "allegro": tuple(spec.name for spec in HAND_JOINTS),
    "ur5e_allegro": tuple(JOINT_SPECS),
}
"""Joint names of each robot, in joint order."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Recording:
    """Motion of some joints: commands at their send times, measurements at the controller's times.

    The two clocks are never merged: their offset is a result, not an assumption.

    Attributes:
        name: What messages and reports call it.
        joints: Names of the joints, the columns of all arrays.
        t_cmd: Send times of the commands [s], not decreasing.
        q_cmd: Commanded positions [rad]; each holds until the next.
        t_meas: Times of the measurements [s], not decreasing.
        q: Measured positions [rad].
        qd: Measured speeds [rad/s], if they were recorded.
        effort: Measured torques [N·m], if they were recorded.

    Raises:
        RecordingError: If a shape, time or value cannot be; the message says where.
        UnknownNameError: If the robot has no such joint.
    """

    name: str = "recording"
    joints: tuple[str, ...]
    t_cmd: Float64[np.ndarray, " num_commands"]
    q_cmd: Float64[np.ndarray, "num_commands num_joints"]
    t_meas: Float64[np.ndarray, " num_samples"]
    q: Float64[np.ndarray, "num_samples num_joints"]
    qd: Float64[np.ndarray, "num_samples num_joints"] | None = None
    effort: Float64[np.ndarray, "num_samples num_joints"] | None = None

    def __post_init__(self) -> None:
        """Refuse what no robot can have done."""
        for joint in self.joints:
            if joint not in JOINT_SPECS:
                raise UnknownNameError("joint", joint, JOINT_SPECS)
        require_motion(Place(source=f"{self.name}: q_cmd"), self.joints, self.t_cmd, self.q_cmd)
        measured = Place(source=f"{self.name}: q, qd, effort")
        extra = [values for values in (self.qd, self.effort) if values is not None]
        require_motion(measured, self.joints, self.t_meas, self.q, *extra)

    def select(self, joints: tuple[str, ...]) -> "Recording":
        """The motion of some of the joints, in the order given.

        Raises:
            RecordingError: If the recording lacks one of them.
        """
        missing = [joint for joint in joints if joint not in self.joints]
        if missing:
            raise RecordingError(
                f"{self.name}: no joint {', '.join(missing)}; recorded are {', '.join(self.joints)}. "
                "Record the missing joints, rename them (--rename OURS=THEIRS), or choose another --robot."
            )
        columns = [self.joints.index(joint) for joint in joints]
        arrays = {
            name: values if name.startswith("t_") else values[:, columns]
            for name, values in self._arrays().items()
        }
        return Recording(name=self.name, joints=joints, **arrays)

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
    def load(path: Path, ours: Callable[[Iterable[str]], tuple[str, ...]] = tuple) -> "Recording":
        """Read a canonical file.

        Args:
            path: The file.
            ours: What makes our names of the file's names of joints.

        Raises:
            RecordingError: If it is no such file, or what it says cannot be.
        """
        try:
            with np.load(path, allow_pickle=False) as file:
                return _read(path, file, ours)
        except (OSError, EOFError, BadZipFile, ValueError) as error:
            raise RecordingError(
                f"{path}: not a readable npz file ({error}); record or convert it again."
            ) from None

    def _arrays(self) -> dict[str, np.ndarray]:
        """The arrays that are there, by name."""
        arrays = {field.name: getattr(self, field.name) for field in fields(self)[2:]}
        return {name: values for name, values in arrays.items() if values is not None}


def _read(path: Path, file: NpzFile, ours: Callable[[Iterable[str]], tuple[str, ...]]) -> Recording:
    """The recording in an open npz."""
    required = ("joints", "t_cmd", "q_cmd", "t_meas", "q")
    missing = [name for name in required if name not in file]
    if missing:
        raise RecordingError(
            f"{path}: no array {', '.join(missing)}; a recording has {', '.join(required)}, "
            "and may have qd and effort."
        )
    present = [name for name in (*required[1:], "qd", "effort") if name in file]
    arrays = {name: np.asarray(file[name], dtype=np.float64) for name in present}
    recorded = ours(map(str, np.atleast_1d(file["joints"])))
    unknown = [joint for joint in recorded if joint not in JOINT_SPECS]
    if unknown:
        raise RecordingError(
            f"{path}: {', '.join(unknown)} are no joints of ours; rename them (--rename OURS=THEIRS), "
            f"or leave them out. Ours are {', '.join(JOINT_SPECS)}."
        )
    return Recording(name=str(path), joints=recorded, **arrays)
