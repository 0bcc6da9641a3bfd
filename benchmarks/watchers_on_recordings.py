"""Play recordings of real arms to the servo's watchers: how often they stop for nothing, and what they miss.

python benchmarks/watchers_on_recordings.py FOLDER_OR_CSV...

A recording is a folder of log files (ur5_recordings.py), a table with the columns q_0 to q_5 and tq_0 to tq_5
(measured, target; 125 Hz), or one with time, q_des and q_act of a joint that moves alone. Its targets are the
commands. The watchers are told the lag that joints have in the first recording, or only the nominal one.
Then the same motion is played with faults that nobody recorded: from a moment on, the measurement of a joint
is changed. Each is to be found within a second.

Source of recordings: repositories kkufieta/ur5_modeling_force_estimate, MingyuTang0728/Universal-Robots-Notts
and Yuxuan-Liang-git/UR5e_Torque.
"""

import argparse
import json
from collections import Counter, defaultdict
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table
from ur5_recordings import read_ur5

from pixel2catch.arrays import read_table
from pixel2catch.robots.joint_dynamics import JointDynamics
from pixel2catch.servo.laws import entry, joint_faults, update_expected
from pixel2catch.servo.limits import JointLimits, ServoLimits
from pixel2catch.servo.link import Fault, flag_names
from pixel2catch.servo.tick import JOINT_INPUT, ServoState
from pixel2catch.workcells.ur5e_allegro import UR5E_ALLEGRO

NUM_JOINTS, TRAVEL = 6, 2.0 * np.pi + 0.3
BEFORE, AFTER = 1.0, 1.5  # seconds of a motion before and after its fault begins
FOUND = 1.0  # seconds in which a fault is to be found
MOVES = 0.1  # rad that the target of a joint goes within FOUND, where a fault shows in motion only
NUM_TIMES = 6  # moments of a recording at which each fault begins, in each joint


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
        recording = read_ur5(path)
        t_cmd, q_cmd, t_meas, q = recording.t_cmd, recording.q_cmd, recording.t_meas, recording.q
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


Change = Callable[[np.ndarray, int, int, np.random.Generator], None]


def frozen(measured: np.ndarray, begin: int, joint: int, _: np.random.Generator) -> None:
    measured[begin:, joint] = measured[begin, joint]


def all_frozen(measured: np.ndarray, begin: int, *_: object) -> None:
    measured[begin:] = measured[begin]


def held_fast(measured: np.ndarray, begin: int, joint: int, rng: np.random.Generator) -> None:
    measured[begin:, joint] = measured[begin, joint] + 1e-4 * rng.standard_normal(len(measured) - begin)


def offset(measured: np.ndarray, begin: int, joint: int, _: np.random.Generator) -> None:
    measured[begin:, joint] += 0.1


def drift(measured: np.ndarray, begin: int, joint: int, _: np.random.Generator) -> None:
    measured[begin:, joint] += np.minimum(np.arange(len(measured) - begin) / 400.0, 1.0) * 0.2


def spike(measured: np.ndarray, begin: int, joint: int, _: np.random.Generator) -> None:
    measured[begin : begin + 4, joint] += 0.3


def reversed_sign(measured: np.ndarray, begin: int, joint: int, _: np.random.Generator) -> None:
    measured[begin:, joint] = 2.0 * measured[begin, joint] - measured[begin:, joint]


def swapped(measured: np.ndarray, begin: int, joint: int, _: np.random.Generator) -> None:
    pair = [joint, (joint + 1) % NUM_JOINTS]
    measured[begin:, pair] = measured[begin:, pair[::-1]]


def runaway(measured: np.ndarray, begin: int, joint: int, _: np.random.Generator) -> None:
    measured[begin:, joint] += 0.5 * 0.002 * np.arange(len(measured) - begin)


def old(measured: np.ndarray, begin: int, *_: object) -> None:
    measured[begin:] = measured[begin - 100 : len(measured) - 100].copy()


FAULTS: dict[str, tuple[Change, bool]] = {
    "frozen joint": (frozen, True),
    "frozen arm": (all_frozen, True),
    "held fast": (held_fast, True),
    "0.1 rad off": (offset, False),
    "drift of 0.2 rad in 0.8 s": (drift, False),
    "spike of 0.3 rad, 8 ms": (spike, False),
    "wrong sign": (reversed_sign, True),
    "two joints exchanged": (swapped, False),
    "runs away at 0.5 rad/s": (runaway, False),
    "0.2 s old": (old, True),
}
"""What is done to the measurement, and whether it shows only where the joint moves."""


def limits_of_arm(lag: np.ndarray | None) -> ServoLimits:
    """The limits of a UR5e alone with all its travel, told this lag [s] or none."""
    dynamics = JointDynamics.nominal()
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
    """Faults (ticks, rows) of motions (ticks, rows, joints), and what is known of the joints in the end."""
    joints = ServoState.idle(command.shape[1], limits).joints
    joints["expected"] = measured[0]
    told = np.empty(command.shape, JOINT_INPUT)
    told["joint_pos"], told["joint_pos_target"] = measured, command
    told["joint_stamp"] = stamp.reshape(len(command), -1, 1)
    found = np.zeros(command.shape[:2], dtype=np.int64)
    watch(joints, told, found, limits.joint_records, ends)
    return found, joints


@entry
def watch(joints: np.ndarray, told: np.ndarray, found: np.ndarray, limits: np.ndarray, ends: bool) -> None:
    """The same tick by tick, or up to the first fault; what is told is as new as it can be."""
    for row in range(len(joints)):
        for tick in range(1, len(told)):
            before, present = told[tick - 1, row], told[tick, row]
            for number in range(len(present)):
                joints[row, number].command = before[number].joint_pos_target
            now = present[0].joint_stamp
            found[tick, row] = joint_faults(joints[row], present, now, tick > 1, limits)
            for number in range(len(present)):
                joints[row, number].command = present[number].joint_pos_target
                update_expected(joints[row, number], limits[number])
            if ends and found[tick, row] != 0:
                break


def false_stops(motion: Played, limits: ServoLimits) -> list[str]:
    """The faults of a motion as it was recorded, of which each stops it for a second."""
    stops, begin, second = list[str](), 0, round(FOUND / limits.dt)
    while begin + second < len(motion.command):
        parts = (motion.command[begin:, None], motion.measured[begin:, None], motion.stamp[begin:, None])
        found, _ = watched(*parts, limits, ends=True)
        ticks = np.flatnonzero(found)
        if not len(ticks):
            break
        reasons = " + ".join(flag_names(Fault, int(found[ticks[0], 0])))
        soon = motion.command[max(begin + int(ticks[0]) - second // 5, 0) :][: second // 5]
        is_fast = (np.abs(np.diff(soon, axis=0)) / limits.dt > limits.joints.lead / limits.joints.lag).any()
        stops.append(f"{reasons} (faster than the servo lets joints be)" if is_fast else reasons)
        begin += int(ticks[0]) + second
    return stops


def moments(motion: Played, joint: int, moves: bool, dt: float, rng: np.random.Generator) -> np.ndarray:
    """When a fault of a joint begins [ticks]."""
    first, last = round(BEFORE / dt), len(motion.command) - round(AFTER / dt)
    ticks = np.arange(first, last, 25)
    soon = motion.command[ticks + round(0.5 * FOUND / dt), joint]
    if moves:
        ticks = ticks[np.abs(soon - motion.command[ticks, joint]) > MOVES]
    return rng.choice(ticks, min(NUM_TIMES, len(ticks)), replace=False) if len(ticks) else ticks


def missed(motion: Played, limits: ServoLimits, rng: np.random.Generator) -> dict[str, list[float]]:
    """Times until each fault was found [s], infinite if it was not; where nothing was wrong before it."""
    before, after = round(BEFORE / limits.dt), round(AFTER / limits.dt)
    names, parts = list[str](), list[tuple[np.ndarray, np.ndarray, np.ndarray]]()
    for name, (change, moves) in FAULTS.items():
        for joint in range(NUM_JOINTS):
            for moment in moments(motion, joint, moves, limits.dt, rng):
                cut = slice(moment - before, moment + after)
                measured = motion.measured[cut].copy()
                change(measured, before, joint, rng)
                distance = np.abs(measured - motion.measured[cut])[before : before + round(FOUND / limits.dt)]
                if distance.max() > 0.06:  # less is no fault worth a stop
                    names.append(name)
                    parts.append((motion.command[cut], measured, motion.stamp[cut]))
    if not names:
        return {}
    command, measured, stamp = (np.stack(arrays, axis=1) for arrays in zip(*parts, strict=True))
    found, _ = watched(command, measured, stamp[..., None], limits)
    times = defaultdict[str, list[float]](list)
    for name, faults in zip(names, found.T, strict=True):
        if not faults[:before].any():
            ticks = np.flatnonzero(faults[before:])
            delay = ticks[0] * limits.dt if len(ticks) else np.inf
            times[name].append(delay if delay <= FOUND else np.inf)
    return times


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument(
        "recordings", nargs="+", type=Path, help="folders and tables; the first tells the lag"
    )
    parser.add_argument("--out", type=Path, help="JSON file for the figures")
    args = parser.parse_args()
    unknown = limits_of_arm(None)
    motions = [played(path, unknown.dt) for path in args.recordings]
    first = motions[0]
    parts = (first.command[:, None], first.measured[:, None], first.stamp[:, None])
    lag = watched(*parts, unknown)[1]["seen_lag"][0].clip(unknown.dt)
    console, report = Console(width=150), dict[str, object]()
    console.print(f"lag in {motions[0].name} [ms]: {np.round(1e3 * lag, 1)}")
    for told, limits in (("told that lag", limits_of_arm(lag)), ("not identified", unknown)):
        stops, times = Table("recording", "s", "rad/s", "false stops"), defaultdict[str, list[float]](list)
        for number, motion in enumerate(motions):
            counted = Counter(false_stops(motion, limits))
            speed = np.abs(np.diff(motion.command, axis=0)).max() / limits.dt
            said = ", ".join(f"{count} {name}" for name, count in counted.items())
            stops.add_row(motion.name, f"{limits.dt * len(motion.command):.0f}", f"{speed:.2f}", said or "0")
            for name, found in missed(motion, limits, np.random.default_rng(number)).items():
                times[name] += found
        faults = Table("fault", "times", "missed", "median s until it is found")
        for name, found in times.items():
            is_missed = np.isinf(found)
            median = f"{np.median(found):.2f}"
            faults.add_row(name, str(len(found)), str(int(is_missed.sum())), median)
        for table in (stops, faults):
            table.title = told
            console.print(table)
        report[told] = {name: [len(found), int(np.isinf(found).sum())] for name, found in times.items()}
    if args.out:
        args.out.write_text(json.dumps(report, indent=2) + "\n")


if __name__ == "__main__":
    main()
