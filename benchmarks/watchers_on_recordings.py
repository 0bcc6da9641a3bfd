"""Play recordings of real arms to the servo's watchers: how often they stop for nothing.

python benchmarks/watchers_on_recordings.py FOLDER_OR_CSV...

A recording is a folder with log_q_target.csv and log_q_actual.csv (time, then the joints), a table with the
columns q_0 to q_5 and tq_0 to tq_5 (measured, target; 125 Hz), or one with time, q_des and q_act of a joint
that moves alone. Its targets are the commands. The watchers know the lag of the joints in the first
recording, or only the nominal one.

Source of recordings: repositories kkufieta/ur5_modeling_force_estimate, MingyuTang0728/Universal-Robots-Notts
and Yuxuan-Liang-git/UR5e_Torque.
"""

from collections import Counter
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np
import tyro
from rich.console import Console
from tyro.conf import Positional

from pixel2catch.arrays import read_table
from pixel2catch.reports import terminal_table
from pixel2catch.robots.joint_dynamics import JointDynamics
from pixel2catch.servo.laws import entry, joint_faults, update_expected
from pixel2catch.servo.limits import JointLimits, ServoLimits
from pixel2catch.servo.link import Fault, flag_names
from pixel2catch.servo.tick import JOINT_INPUT, ServoState
from pixel2catch.workcells.ur5e_allegro import UR5E_ALLEGRO

NUM_JOINTS, TRAVEL = 6, 2.0 * np.pi + 0.3
PAUSE = 1.0  # seconds after a stop that are left out


@dataclass(frozen=True, kw_only=True)
class Played:
    """A recording at the rate of the servo."""

    name: str
    command: np.ndarray  # (ticks, joints) rad
    measured: np.ndarray  # (ticks, joints) rad, the newest measurement
    stamp: np.ndarray  # (ticks,) s


def played(path: Path, dt: float) -> Played:
    """Read a recording."""
    if path.is_dir():
        names = [f"column {i}" for i in range(1 + NUM_JOINTS)]
        files = (path / f"log_q_{which}.csv" for which in ("target", "actual"))
        logs = (read_table(file, names, names=names)[0] for file in files)
        (t_cmd, q_cmd), (t_meas, q) = ((log[:, 0], log[:, 1:]) for log in logs)
    else:
        with path.open() as file:
            is_of_one_joint = "q_des" in file.readline()
        if is_of_one_joint:
            numbers, _ = read_table(path, ("time", "q_des", "q_act"))
            t_cmd = t_meas = numbers[:, 0]
            q_cmd, q = (np.zeros((len(t_cmd), NUM_JOINTS)) for _ in range(2))
            q_cmd[:, 0], q[:, 0] = numbers[:, 1:].T
        else:
            q_cmd, q = (
                read_table(path, [f"{name}_{i}" for i in range(NUM_JOINTS)])[0] for name in ("tq", "q")
            )
            t_cmd = t_meas = 0.008 * np.arange(len(q))
    time = np.arange(max(t_cmd[0], t_meas[0]), min(t_cmd[-1], t_meas[-1]), dt)
    newest = np.searchsorted(t_meas, time, side="right") - 1
    command = np.stack([np.interp(time, t_cmd, column) for column in q_cmd.T], axis=-1)
    return Played(name=path.stem, command=command, measured=q[newest], stamp=t_meas[newest] - time[0])


def limits_of_arm(lag: np.ndarray | None) -> ServoLimits:
    """The limits of a UR5e alone with all its travel, told this lag [s] or none."""
    dynamics = JointDynamics.of()
    if lag is not None:
        stiffness = dynamics.damping / np.append(lag, np.full(len(dynamics.damping) - NUM_JOINTS, 0.1))
        dynamics = dynamics.with_values(stiffness=stiffness)
    joints = JointLimits.of(UR5E_ALLEGRO, dynamics=dynamics, is_identified=lag is not None)
    arrays = {
        entry.name: getattr(joints, entry.name)[:NUM_JOINTS]
        for entry in fields(joints)
        if isinstance(getattr(joints, entry.name), np.ndarray)
    }
    anywhere = np.full(NUM_JOINTS, TRAVEL)
    joints = replace(joints, **{**arrays, "least": -anywhere, "most": anywhere})
    return ServoLimits.of(UR5E_ALLEGRO, joints)


def watched(
    command: np.ndarray, measured: np.ndarray, stamp: np.ndarray, limits: ServoLimits, *, ends: bool = False
) -> tuple[np.ndarray, np.ndarray]:
    """Faults (ticks,) of a motion (ticks, joints), and what is known of the joints in the end."""
    joints = ServoState.idle(1, limits).joints
    joints["expected"] = measured[0]
    told = np.empty(command.shape, JOINT_INPUT)
    told["joint_pos"], told["joint_pos_target"], told["joint_stamp"] = measured, command, stamp[:, None]
    found = np.zeros(len(command), dtype=np.int64)
    watch(joints[0], told, found, limits.joint_records, ends)
    return found, joints


@entry
def watch(joints: np.ndarray, told: np.ndarray, found: np.ndarray, limits: np.ndarray, ends: bool) -> None:
    """The same tick by tick, or up to the first fault; what is told is as new as it can be."""
    for tick in range(1, len(told)):
        before, present = told[tick - 1], told[tick]
        for number in range(len(present)):
            joints[number].command = before[number].joint_pos_target
        found[tick] = joint_faults(joints, present, present[0].joint_stamp, tick > 1, limits)
        for number in range(len(present)):
            joints[number].command = present[number].joint_pos_target
            update_expected(joints[number], limits[number])
        if ends and found[tick] != 0:
            break


def false_stops(motion: Played, limits: ServoLimits) -> list[str]:
    """The faults of a motion as it was recorded, of which each stops it for a second."""
    stops, begin, second = list[str](), 0, round(PAUSE / limits.dt)
    while begin + second < len(motion.command):
        parts = (motion.command[begin:], motion.measured[begin:], motion.stamp[begin:])
        found, _ = watched(*parts, limits, ends=True)
        ticks = np.flatnonzero(found)
        if not len(ticks):
            break
        reasons = " + ".join(flag_names(Fault, int(found[ticks[0]])))
        soon = motion.command[max(begin + int(ticks[0]) - second // 5, 0) :][: second // 5]
        is_fast = (np.abs(np.diff(soon, axis=0)) / limits.dt > limits.joints.lead / limits.joints.lag).any()
        stops.append(f"{reasons} (faster than the servo lets joints be)" if is_fast else reasons)
        begin += int(ticks[0]) + second
    return stops


def main(recordings: Positional[tuple[Path, ...]]) -> None:
    unknown = limits_of_arm(None)
    motions = [played(path, unknown.dt) for path in recordings]
    first = motions[0]
    lag = watched(first.command, first.measured, first.stamp, unknown)[1]["estimated_lag"][0].clip(unknown.dt)
    print(f"lag in {first.name} [ms]: {np.round(1e3 * lag, 1)}")
    for told, limits in (("told that lag", limits_of_arm(lag)), ("not identified", unknown)):
        rows = [
            {
                "recording": motion.name,
                "s": f"{limits.dt * len(motion.command):.0f}",
                "rad/s": f"{np.abs(np.diff(motion.command, axis=0)).max() / limits.dt:.2f}",
                "false stops": ", ".join(
                    f"{count} {name}" for name, count in Counter(false_stops(motion, limits)).items()
                ),
            }
            for motion in motions
        ]
        Console(width=150).print(terminal_table(told, rows))


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
