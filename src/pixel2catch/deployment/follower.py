"""A robot that follows a trajectory of `excite` instead of a policy."""

from collections.abc import Callable
from typing import Any

import numpy as np

from pixel2catch.deployment.control_loop import Connection
from pixel2catch.deployment.recorder import TARGETS
from pixel2catch.deployment.statistics import RunStatistics
from pixel2catch.errors import DeploymentError
from pixel2catch.servo.limits import STOP_TIME, Joints
from pixel2catch.servo.link import JointTargets, Mode

PERIOD = 0.01  #: Time between two targets [s]. Source: ours.


class TrajectoryFollower:
    """Sends the targets of a trajectory to an armed servo; operator and servo guard the robot."""

    def __init__(
        self, targets: Callable[[float], Joints], duration: float, ramp_time: float, connection: Connection
    ) -> None:
        """Wait to be armed.

        Args:
            targets: Joint targets in joint order [rad], by the time since the start of the trajectory [s].
            duration: Duration of the trajectory [s].
            ramp_time: Time from arming to the start, in which the servo moves to the first target [s].
            connection: Network, servo, clock and recording.
        """
        self.statistics = RunStatistics()
        self.is_done = False  #: Whether the trajectory was followed to its end.
        self._targets, self._duration, self._ramp_time = targets, duration, ramp_time
        self._connection, self._clock = connection, connection.clock
        self._armed_at = np.inf
        self._mode = int(Mode.IDLE)

    def run(self, is_over: Callable[[], bool], on_status: Callable[[dict[str, Any]], None]) -> None:
        """Follow the trajectory once; the function gets a status with every target.

        Raises:
            DeploymentError: The servo process has ended, or it has stopped the robot.
        """
        recording, due = self._connection.recording, self._clock.now()
        while not (is_over() or self.is_done):
            self._receive()
            if np.isfinite(self._armed_at):
                self._follow(self._clock.now())
            on_status(self.statistics.status(None, recording.trouble if recording else ""))
            due = max(due + PERIOD, self._clock.now())
            self._clock.sleep_until(due)
        if np.isfinite(self._armed_at):
            self._send(self._clock.now(), self._duration, is_stop_requested=True)
        self._clock.sleep_until(self._clock.now() + STOP_TIME)
        if recording:
            recording.record_messages()

    def _receive(self) -> None:
        """Record; start when the servo is armed, and give up when it has stopped the robot."""
        connection = self._connection
        for command in connection.receive():
            self.statistics.note_command(command, connection.servo_dt)
            if command.mode == Mode.ARMED and self._mode != Mode.ARMED:
                self._armed_at = command.time
            if command.mode == Mode.STOPPED and np.isfinite(self._armed_at):
                reasons, elapsed = ", ".join(self.statistics.stops), command.time - self._armed_at
                raise DeploymentError(
                    f"the robot was stopped ({reasons}) {elapsed:.1f} s after it was armed; the recording "
                    "ends there: remove the reason, and record again."
                )
            self._mode = command.mode
        if connection.recording:
            connection.recording.record_messages()

    def _follow(self, now: float) -> None:
        elapsed = now - self._armed_at - self._ramp_time
        targets = self._send(now, elapsed)
        if self._connection.recording:
            self._connection.recording.record_row(TARGETS, targets.row, now)
        self.is_done = elapsed > self._duration

    def _send(self, now: float, elapsed: float, *, is_stop_requested: bool = False) -> JointTargets:
        """Send the targets of a time since the start of the trajectory [s]."""
        targets = JointTargets(
            joint_pos_target=self._targets(elapsed),
            **dict.fromkeys(("target_stamp", "image_stamp", "box_stamp"), now),
            is_stop_requested=is_stop_requested,
        )
        self._connection.servo.send(targets)
        return targets
