"""What keeps commands in the workspace: a tick is taken only if the arms can brake inside after it."""

import numpy as np
from jaxtyping import Float64, Int64
from numpy.lib.stride_tricks import sliding_window_view

from pixel2catch.servo.motion import Flags, Motion, MotionLimits, Recent, braked, braking
from pixel2catch.servo.workspace import Workspace


class WorkspaceBrake:
    """Arms that brake before they would leave the workspace."""

    def __init__(self, workspace: Workspace, limits: MotionLimits) -> None:
        """Keep all joints to limits, and the arms among them inside."""
        self._workspace, self._columns = workspace, workspace.joints
        self._arm = limits.only(self._columns)
        self._weights = self._arm.weights.transpose(1, 2, 0)

    def kept_inside(self, motion: Motion, recent: Recent, wanted: Motion, is_watched: Flags) -> Motion:
        """The wanted tick, or as much of it as lets the arms brake without leaving the workspace.

        All joints may brake: that was found a tick ago. One after the other is let go on, if then the arms
        can still brake.
        """
        arm = self._columns
        rows = np.flatnonzero(is_watched & wanted.velocity[:, arm].any(axis=-1))
        if not len(rows):
            return wanted
        recent = recent[1:, :, arm]
        rows = rows[~self._can_stop(wanted.only(rows, arm), recent[:, rows])]
        if not len(rows):
            return wanted
        recent, before, goal = recent[:, rows], motion.only(rows, arm), wanted.only(rows, arm)
        velocity = braking(before, self._arm)
        for joint in np.flatnonzero((velocity != goal.velocity).any(axis=0)):
            trial = velocity.copy()
            trial[:, joint] = goal.velocity[:, joint]
            may_go = self._can_stop(before.moved(trial, self._arm.dt), recent)
            velocity = np.where(may_go[:, None], trial, velocity)
        kept = wanted.velocity.copy()
        kept[np.ix_(rows, arm)] = velocity
        return motion.moved(kept, self._arm.dt)

    def _can_stop(self, motion: Motion, before: Float64[np.ndarray, "ticks rows joints"]) -> Flags:
        """Whether the arms stay in the workspace at every tick of braking, the present one included.

        The positions before are those that count in a command beside the present one, oldest first.
        """
        longest = np.ceil(np.abs(motion.velocity) / self._arm.change).max(axis=-1) + len(before)
        ticks = np.arange(int(longest.max()) + 1)
        path = np.concatenate((before, braked(motion, self._arm, ticks[:, None, None])))
        commands = np.add.reduce(sliding_window_view(path, len(before) + 1, axis=0) * self._weights, axis=-1)
        is_inside = ticks[:, None] > longest
        is_inside[~is_inside] = self._workspace.contains(commands[~is_inside])
        return np.logical_and.reduce(is_inside, axis=0)
