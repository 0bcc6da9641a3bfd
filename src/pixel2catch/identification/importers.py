"""Reading a recording, whatever wrote it."""

from pathlib import Path

from pixel2catch.errors import RecordingError, UnknownNameError
from pixel2catch.identification.names import Names
from pixel2catch.identification.recording import ROBOTS, Recording
from pixel2catch.identification.rtde import COMMAND_FILE, MEASURED_FILE, read_rtde

FORMATS = (
    f"an .npz file in the canonical layout, a folder with {MEASURED_FILE} and {COMMAND_FILE}, "
    "or a rosbag2: its folder, .mcap or .db3 file"
)
"""What can be read, in words."""


def read_recording(path: Path, robot: str = "ur5e_allegro", names: Names | None = None) -> Recording:
    """Read the motion of a robot's joints, in joint order.

    Args:
        path: A file or folder; what it is chooses the reader.
        robot: Which joints are wanted: a name in `ROBOTS`.
        names: What the recording calls topics and joints, if not as we do.

    Raises:
        RecordingError: If it is of no known format, lacks a joint, or says what cannot be.
        UnknownNameError: If there is no such robot.
    """
    if robot not in ROBOTS:
        raise UnknownNameError("robot", robot, ROBOTS)
    names = names or Names()
    if not path.exists():
        raise RecordingError(f"{path}: there is no such file or folder.")
    if path.suffix in (".mcap", ".db3") or (path / "metadata.yaml").exists():
        return _read_rosbag(path, ROBOTS[robot], names)
    if path.is_dir() and any((path / name).exists() for name in (MEASURED_FILE, COMMAND_FILE)):
        return read_rtde(path).select(ROBOTS[robot])
    if path.suffix == ".npz":
        return Recording.load(path, names.ours).select(ROBOTS[robot])
    if path.suffix == ".parquet":
        raise RecordingError(
            f"{path}: parquet is not read; save its columns with numpy.savez as an .npz file of the arrays "
            "joints, t_cmd, q_cmd, t_meas and q."
        )
    raise RecordingError(f"{path}: unknown format; a recording is {FORMATS}.")


def _read_rosbag(path: Path, joints: tuple[str, ...], names: Names) -> Recording:
    """Read a bag; only here the optional library is needed."""
    try:
        from pixel2catch.identification.rosbag import read_rosbag
    except ModuleNotFoundError as error:
        raise RecordingError(
            f"{path}: reading bags needs {error.name}; pip install 'pixel2catch[identification]'."
        ) from None
    return read_rosbag(path, joints, names)
