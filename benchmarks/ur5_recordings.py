"""Read and check recorded motion of a real UR5: folders of log files, one file a signal.

python benchmarks/ur5_recordings.py FOLDER...

A folder has log_q_target.csv and log_q_actual.csv: time [s], then a column for each joint.
Source of such folders: repository kkufieta/ur5_modeling_force_estimate, 125 Hz. `q_target` is the input
of the low-level loop of the controller.
"""

import argparse
from pathlib import Path

import numpy as np
from rich.console import Console

from pixel2catch.arrays import read_table
from pixel2catch.identification.checks import check_recording
from pixel2catch.identification.recording import Recording, joints_of, require_motion
from pixel2catch.identification.report import check_rows, check_title
from pixel2catch.reports import terminal_table
from pixel2catch.workcells.ur5e_allegro import UR5E_ALLEGRO

ARM = joints_of(UR5E_ALLEGRO, "ur5e")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folders", nargs="+", type=Path, help="folders of log files")
    for folder in parser.parse_args().folders:
        checks = check_recording(read_ur5(folder))
        Console(width=120).print(terminal_table(check_title(folder.name, checks), check_rows(checks)))


def read_ur5(folder: Path) -> Recording:
    """The motion in a folder of log files; a UR5's joints have the names of a UR5e's."""
    t_cmd, q_cmd = read_log(folder / "log_q_target.csv")
    t_meas, q = read_log(folder / "log_q_actual.csv")
    return Recording(name=folder.name, joints=ARM, t_cmd=t_cmd, q_cmd=q_cmd, t_meas=t_meas, q=q)


def read_log(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Times and values of one file, which has no line of names."""
    table, _ = read_table(path, ("time", *ARM), names=("time", *ARM))
    time, values = table[:, 0], table[:, 1:]
    require_motion(str(path), ARM, time, values)
    return time, values


if __name__ == "__main__":
    main()
