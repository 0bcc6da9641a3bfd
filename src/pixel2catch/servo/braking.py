"""What keeps commands in the workspace: a tick is taken only if the arms can brake inside after it."""

import numpy as np

from pixel2catch.servo.motion import Flags, Motion, MotionLimits, Recent, braked, braking
from pixel2catch.servo.workspace import Workspace


class WorkspaceBrake:
    """Arms that brake before they would leave the workspace."""

    def __init__(self, workspace: Workspace, limits: MotionLimits) -> None:
        """Keep all joints to limits, and the arms among them inside."""
        joints = workspace.joints
        together = slice(int(joints[0]), int(joints[-1]) + 1)
        self._workspace = workspace
        #: Joints of the arms: a slice of all where they follow each other, which is faster.
        self._columns = together if len(joints) == together.stop - together.start else joints
        self._arm = limits.only(self._columns)

    def kept_inside(self, motion: Motion, recent: Recent, wanted: Motion, is_watched: Flags) -> Motion:
        """The wanted tick, or as much of it as lets the arms brake without leaving the workspace.

        All joints may brake: that was found a tick ago. One after the other is let go on, if then the arms
        can still brake.
        """
        arm = self._columns
        rows = (is_watched & np.logical_or.reduce(wanted.velocity[:, arm], axis=-1)).nonzero()[0]
        recent = recent[len(recent) + 1 - len(self._arm.weights) :, :, arm]
        if len(rows):
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
        watched = kept[:, arm]
        watched[rows] = velocity
        kept[:, arm] = watched
        return motion.moved(kept, self._arm.dt)

    def _can_stop(self, motion: Motion, recent: Recent) -> Flags:
        """Whether the arms stay in the workspace at every tick of braking, the present one included.

        The recent positions are those that count in a command beside the present one, oldest first.
        """
        longest = np.ceil(np.abs(motion.velocity) / self._arm.change).max()
        ticks = np.arange(int(longest) + len(recent) + 1)
        path = np.concatenate((recent, braked(motion, self._arm, ticks[:, None, None])))
        commands = np.zeros((len(ticks), *motion.position.shape))
        for first, share in enumerate(self._arm.weights):
            commands += share * path[first : first + len(ticks)]
        is_inside = self._workspace.contains(commands.reshape(-1, commands.shape[-1]))
        return np.logical_and.reduce(is_inside.reshape(len(ticks), -1), axis=0)
