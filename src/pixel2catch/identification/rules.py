"""What every recorded motion must obey, whatever file it came from."""

from dataclasses import dataclass
from math import pi

import numpy as np

from pixel2catch.errors import RecordingError
from pixel2catch.robot.constants import HAND_JOINTS

HAND_REACH = pi
"""No hand joint gets so far from 0 [rad]. Source: the limits in `robot.constants` end at 1.72 rad."""

ARM_REACH = 2.0 * pi + 0.1
"""No arm joint gets so far from 0 [rad]. Source: UR, ±360°, and 0.1 rad for calibration."""

REACH = {spec.name: HAND_REACH for spec in HAND_JOINTS}
"""Reach of the joints whose reach is not `ARM_REACH` [rad]."""


@dataclass(frozen=True, kw_only=True)
class Place:
    """Where rows of numbers come from, for messages.

    Attributes:
        source: File, or topic of a bag.
        row: What a row is called there.
        first_row: Number of the first one.
    """

    source: str
    row: str = "row"
    first_row: int = 0

    def at(self, index: int) -> str:
        """The place of a row."""
        return f"{self.source}, {self.row} {self.first_row + index}"


def require_motion(
    place: Place, joints: tuple[str, ...], time: np.ndarray, positions: np.ndarray, *others: np.ndarray
) -> None:
    """Refuse motion that no robot can have done.

    Args:
        place: Where the rows come from.
        joints: Names of the columns.
        time: Times [s], shape (rows,).
        positions: Positions [rad], shape (rows, joints).
        others: More columns of the same shape, such as speeds.

    Raises:
        RecordingError: If there are no rows, shapes part, a value is not finite, time runs backwards or
            positions are beyond every joint's reach.
    """
    if time.ndim != 1 or len(time) < 2:
        raise RecordingError(f"{place.source}: no motion, shape {time.shape}; at least two rows are needed.")
    for values in (positions, *others):
        _require_shape(place, values, (len(time), len(joints)))
        _require_finite(place, joints, values)
    _require_finite(place, ("time",), time[:, None])
    _require_forward(place, time)
    _require_radians(place, joints, positions)


def _require_shape(place: Place, values: np.ndarray, shape: tuple[int, int]) -> None:
    if values.shape != shape:
        raise RecordingError(
            f"{place.source}: shape {values.shape}, but {shape[0]} times and {shape[1]} joints need {shape}; "
            "give every time one row and every joint one column."
        )


def _require_finite(place: Place, columns: tuple[str, ...], values: np.ndarray) -> None:
    if not np.isfinite(values).all():
        row, column = map(int, np.argwhere(~np.isfinite(values))[0])
        raise RecordingError(
            f"{place.at(row)}, column {columns[column]}: {values[row, column]} is no number; "
            "cut the recording before this row or record again."
        )


def _require_forward(place: Place, time: np.ndarray) -> None:
    backwards = np.flatnonzero(np.diff(time) < 0)
    if len(backwards):
        row = int(backwards[0]) + 1
        raise RecordingError(
            f"{place.at(row)}: time runs backwards, {time[row]:.6f} s after {time[row - 1]:.6f} s; "
            "split the recording here, or sort it if two writers shared the file."
        )


def _require_radians(place: Place, joints: tuple[str, ...], positions: np.ndarray) -> None:
    reach = np.array([REACH.get(joint, ARM_REACH) for joint in joints])
    beyond = np.argwhere(np.abs(positions) > reach)
    if len(beyond):
        row, column = map(int, beyond[0])
        raise RecordingError(
            f"{place.at(row)}, column {joints[column]}: {positions[row, column]:g} rad is beyond "
            f"the joint's reach of {reach[column]:.2f} rad; if the file is in degrees, convert it to radians."
        )
