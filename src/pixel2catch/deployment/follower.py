"""A robot that follows a trajectory instead of a policy, such as one that `excite` wrote."""

from collections.abc import Callable
from typing import Any

import numpy as np

from pixel2catch.deployment.recorder import ORDERS, Connection
from pixel2catch.deployment.statistics import RunStatistics
from pixel2catch.errors import DeploymentError
from pixel2catch.servo.limits import STOP_TIME, Joints
from pixel2catch.servo.link import JointTargets, Mode

PERIOD = 0.01  #: Time between two commands [s]. Source: ours.


class TrajectoryFollower:
    """Gives the servo the targets that are due; the operator arms, and the servo guards, as with a policy.

    The servo moves evenly to a new target within a control step. What it sent is what a recording has.
    """

    def __init__(
        self, targets: Callable[[float], Joints], duration: float, ramp_time: float, connection: Connection
    ) -> None:
        """Wait to be armed.

        The targets of all joints, in joint order [rad], are by the time since the trajectory's beginning [s],
        and it ends after its duration [s]. In the ramp time [s] before it, the servo goes to the first
        target.
        """
        self.statistics = RunStatistics()
        self.is_done = False  #: Whether the trajectory was followed to its end.
        self._targets, self._duration, self._ramp_time = targets, duration, ramp_time
        self._connection = connection
        self._armed_at = np.inf
        self._mode = int(Mode.IDLE)

    def run(self, is_over: Callable[[], bool], on_status: Callable[[dict[str, Any]], None]) -> None:
        """Follow it once, or until it is over before, with a status for every command.

        Raises:
            DeploymentError: The servo process is gone, or it has stopped the robot.
        """
        clock, due = self._connection.clock, self._connection.clock.now()
        while not (is_over() or self.is_done):
            self._hear()
            self._command(clock.now())
            recording = self._connection.recording
            on_status(self.statistics.status(None, recording.trouble if recording else ""))
            due = max(due + PERIOD, clock.now())
            clock.sleep_until(due)
        self._rest()

    def _hear(self) -> None:
        """Record everything; begin when the servo is armed, and give up when it is stopped."""
        connection = self._connection
        for command in connection.hear():
            self.statistics.note_command(command, connection.servo_dt)
            if command.mode == Mode.ARMED and self._mode != Mode.ARMED:
                self._armed_at = command.time
            if command.mode == Mode.STOPPED and np.isfinite(self._armed_at):
                reasons, elapsed = ", ".join(self.statistics.stops), command.time - self._armed_at
                raise DeploymentError(
                    f"the robot was stopped ({reasons}) {elapsed:.1f} s after it was armed; the recording "
                    "ends there: mend the reason, and record anew."
                )
            self._mode = command.mode
        if connection.recording:
            connection.recording.record_messages()

    def _command(self, now: float) -> None:
        if not np.isfinite(self._armed_at):
            return
        elapsed = now - self._armed_at - self._ramp_time
        joint_targets = self._order(now, elapsed)
        if self._connection.recording:
            self._connection.recording.record_row(ORDERS, joint_targets.row, now)
        self.is_done = elapsed > self._duration

    def _order(self, now: float, elapsed: float, *, is_stop_requested: bool = False) -> JointTargets:
        """Give the servo now [s] the target of a time since the trajectory's beginning [s]."""
        joint_targets = JointTargets(
            joint_pos_target=self._targets(elapsed),
            **dict.fromkeys(("target_stamp", "image_stamp", "box_stamp"), now),
            is_stop_requested=is_stop_requested,
        )
        self._connection.servo.send(joint_targets)
        return joint_targets

    def _rest(self) -> None:
        """Have the servo stop, and record that, too."""
        connection = self._connection
        if np.isfinite(self._armed_at):
            self._order(connection.clock.now(), self._duration, is_stop_requested=True)
        connection.clock.sleep_until(connection.clock.now() + STOP_TIME)
        if connection.recording:
            connection.recording.record_messages()
