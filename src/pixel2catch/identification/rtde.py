"""Recordings of a UR5e: an RTDE file of what was measured and a file of what was sent."""

from pathlib import Path

from pixel2catch.identification.recording import ROBOTS, Recording
from pixel2catch.identification.rules import require_motion
from pixel2catch.identification.tables import Table, read_table

MEASURED_FILE = "rtde.csv"
"""Measurements: `timestamp, actual_q_0` … `actual_q_5`, perhaps `actual_qd_*`. Source: the names of RTDE."""

COMMAND_FILE = "commands.csv"
"""Commands: `t, q_0` … `q_5`, written by whoever sent them. RTDE's `target_q` is what the controller made of
them, with hardly any lag, and not the command."""

ARM = ROBOTS["ur5e"]


def read_rtde(folder: Path) -> Recording:
    """Read a folder with `rtde.csv` and `commands.csv`.

    RTDE's currents are in ampere and its moments are targets, so that there is no effort.

    Args:
        folder: Holds the two files, with times in seconds and angles in radians.

    Raises:
        RecordingError: If a file or column is missing, or a value cannot be.
    """
    command = read_table(folder / COMMAND_FILE)
    measured = read_table(folder / MEASURED_FILE)
    t_cmd, q_cmd = command.column("t"), command.columns(_names("q"))
    require_motion(command.place, ARM, t_cmd, q_cmd)
    t_meas, q = measured.column("timestamp"), measured.columns(_names("actual_q"))
    qd = measured.columns(_names("actual_qd")) if _has_speed(measured) else None
    require_motion(measured.place, ARM, t_meas, q, *([] if qd is None else [qd]))
    return Recording(name=str(folder), joints=ARM, t_cmd=t_cmd, q_cmd=q_cmd, t_meas=t_meas, q=q, qd=qd)


def _names(prefix: str) -> list[str]:
    return [f"{prefix}_{i}" for i in range(len(ARM))]


def _has_speed(table: Table) -> bool:
    return any(name.startswith("actual_qd_") for name in table.names)
