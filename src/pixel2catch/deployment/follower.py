"""A robot that follows a trajectory of `excite` instead of a policy."""

from collections.abc import Callable
from math import inf
from typing import Any

from pixel2catch.deployment.control_loop import Connection
from pixel2catch.deployment.recorder import TARGETS
from pixel2catch.deployment.statistics import RunStatistics
from pixel2catch.errors import DeploymentError
from pixel2catch.servo.limits import STOP_TIME, Joints, ServoLimits
from pixel2catch.servo.link import JointTargets, Mode

PERIOD = 0.01  #: Time between two targets [s]. Source: ours.


def follow(
    trajectory: Callable[[float], Joints],
    duration: float,
    connection: Connection,
    is_over: Callable[[], bool],
    on_status: Callable[[dict[str, Any]], None],
) -> bool:
    """Wait until the servo is armed, then follow a trajectory once; operator and servo guard the robot.

    In the servo's ramp, the robot moves to the first targets.

    Args:
        trajectory: Joint targets in joint order [rad], by the time since the start of the trajectory [s].
        duration: Duration of the trajectory [s].
        connection: Network, servo, clock and recording.
        is_over: Ends it early.
        on_status: Gets a status with every target; "done" is the share of the trajectory that was sent.

    Returns:
        Whether it was followed to its end.

    Raises:
        DeploymentError: The servo process has ended, or it has stopped the robot.
    """
    statistics, recording, clock = RunStatistics(), connection.recording, connection.clock
    armed_at, elapsed, due = inf, -inf, clock.now()
    while elapsed <= duration and not is_over():
        armed_at = _armed_at(connection, statistics, armed_at)
        if armed_at < inf:
            now = clock.now()
            elapsed = now - armed_at - ServoLimits.ramp_time
            targets = _targets(trajectory(elapsed), now)
            connection.servo.send(targets)
            if recording:
                recording.record_row(TARGETS, targets.row, now)
        if recording:
            recording.record_messages()
        status = statistics.status(None, recording.trouble if recording else "")
        on_status(status | {"done": min(max(elapsed / duration, 0.0), 1.0)})
        due = max(due + PERIOD, clock.now())
        clock.sleep_until(due)
    if armed_at < inf:
        connection.servo.send(_targets(trajectory(duration), clock.now(), is_stop_requested=True))
    clock.sleep_until(clock.now() + STOP_TIME)
    if recording:
        recording.record_messages()
    return elapsed > duration


def _armed_at(connection: Connection, statistics: RunStatistics, before: float) -> float:
    """Count the servo's commands; return when it was armed, `before` or since then [s]."""
    for command in connection.receive():
        statistics.note_command(command)
        if command.mode == Mode.STOPPED and before < inf:
            raise DeploymentError(
                f"the robot was stopped ({', '.join(statistics.stops)}) {command.time - before:.1f} s after "
                "it was armed; the recording ends there: remove the reason, and record again."
            )
        if command.mode == Mode.ARMED:
            before = min(before, command.time)
    return before


def _targets(joint_pos: Joints, now: float, *, is_stop_requested: bool = False) -> JointTargets:
    return JointTargets(
        joint_pos_target=joint_pos,
        **dict.fromkeys(("target_stamp", "image_stamp", "box_stamp"), now),
        is_stop_requested=is_stop_requested,
    )
