"""What keeps commands in the workspace: a tick is taken only if the arms can brake inside after it."""

import numpy as np

from pixel2catch.servo.clearance import is_inside
from pixel2catch.servo.compilation import Record, Records, compiled
from pixel2catch.servo.motion import braked, braking
from pixel2catch.servo.workspace import Space


@compiled
def keep_inside(
    space: Space, joints: Records, recent: np.ndarray, wanted: np.ndarray, limits: Records
) -> None:
    """Let as much be of the speeds wanted of a tick [rad/s] as lets the arms brake inside their workspace.

    All joints may brake: that was found a tick ago. One after the other is let go on, if then the arms can
    still brake. Recent positions are (joints, ticks) [rad], oldest first.
    """
    moves, goal = False, wanted.copy()
    for joint in space.columns:
        moves |= wanted[joint] != 0.0
    if not moves or can_stop(space, joints, recent, wanted, limits):
        return
    for joint in space.columns:
        wanted[joint] = braking(joints[joint].velocity, limits[joint])
    for joint in space.columns:
        slower = wanted[joint]
        wanted[joint] = goal[joint]
        if goal[joint] != slower and not can_stop(space, joints, recent, wanted, limits):
            wanted[joint] = slower


@compiled
def can_stop(space: Space, joints: Records, recent: np.ndarray, speeds: np.ndarray, limits: Records) -> bool:
    """Whether arms that go on with such speeds stay in the workspace at every tick of braking after it."""
    longest = 0.0
    for joint in space.columns:
        longest = max(longest, np.ceil(abs(speeds[joint]) / limits[joint].change) + limits[joint].window)
    command = np.empty(len(space.columns))
    for tick in range(int(longest)):
        for place, joint in enumerate(space.columns):
            command[place] = coming(joints[joint], recent[joint], float(speeds[joint]), tick, limits[joint])
        if not is_inside(space, command):
            return False
    return True


@compiled
def coming(joint: Record, recent: np.ndarray, speed: float, tick: int, limits: Record) -> float:
    """The command that many ticks after one with a speed [rad/s], if the joint brakes from then on [rad]."""
    command, start = 0.0, joint.position + speed * limits.dt
    for number in range(tick + 1 - limits.window, tick + 1):
        if number < 0:
            command += recent[len(recent) + number] * limits.share
        else:
            command += braked(start, speed, number, limits) * limits.share
    return command
