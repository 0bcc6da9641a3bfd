"""A robot that follows a trajectory instead of a policy: that of `excite`, or a slow motion to a pose."""

import json
from collections.abc import Callable
from math import inf
from typing import Any

import numpy as np

from pixel2catch.deployment.control_loop import Connection
from pixel2catch.deployment.paths import Motion
from pixel2catch.deployment.recorder import TARGETS
from pixel2catch.deployment.statistics import RunStatistics
from pixel2catch.errors import DeploymentError
from pixel2catch.ros2 import messages
from pixel2catch.ros2.transport import Topic
from pixel2catch.servo.limits import STOP_TIME, Joints, ServoLimits
from pixel2catch.servo.link import Command, JointTargets, Mode

PERIOD = 0.01  #: Time between two targets [s]. Source: ours.
START_ERROR = 0.02  #: Largest distance of a joint from the start of a trajectory [rad]. Source: ours.


def follow(
    trajectory: Callable[[float], Joints],
    duration: float,
    connection: Connection,
    is_over: Callable[[], bool],
    on_status: Callable[[dict[str, Any]], None],
    start: Joints | None = None,
    on_command: Callable[[Command], None] = lambda _: None,
) -> bool:
    """Wait until the servo is armed, then follow a trajectory once; operator and servo guard the robot.

    In the servo's ramp, the robot moves to the first targets.

    Args:
        trajectory: Joint targets in joint order [rad], by the time since the start of the trajectory [s].
        duration: Duration of the trajectory [s].
        connection: Network, servo, clock and recording.
        is_over: Ends it early.
        on_status: Gets a status with every target; "done" is the share of the trajectory that was sent.
        start: Pose in which the trajectory begins [rad]. A robot that is elsewhere does not begin it.
        on_command: Gets every command of the servo.

    Returns:
        Whether it was followed to its end.

    Raises:
        DeploymentError: The servo process has ended, or it has stopped the robot.
    """
    statistics, recording, clock = RunStatistics(), connection.recording, connection.clock
    armed_at, elapsed, due = inf, -inf, clock.now()
    while elapsed <= duration and not is_over():
        armed_at = _armed_at(connection, statistics, armed_at, on_command)
        is_begun = elapsed > -inf
        if start is not None and not is_begun and statistics.is_away_from(start, START_ERROR):
            return False
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


def move(
    plan: Callable[[Joints], Motion],
    what: str,
    connection: Connection,
    topic: Topic,
    is_over: Callable[[], bool],
    on_status: Callable[[dict[str, Any]], None],
    on_command: Callable[[Command], None] = lambda _: None,
) -> bool:
    """Plan a motion from the measured pose, announce it with its purpose, and follow it as `follow` does.

    It is planned again if somebody moves the robot before. The announcement is in the status, which is also
    published on the topic.

    Raises:
        DeploymentError: There is no such motion, or `follow` raises it.
    """
    publisher = connection.transport.publisher(topic)
    while not is_over():
        start = _measured(connection)
        if start is None:
            connection.clock.sleep_until(connection.clock.now() + PERIOD)
            continue
        motion = plan(start)

        def report(status: dict[str, Any], words: str = f"{what}: {motion.in_words}") -> None:
            status["message"] = f"{words} {status['message']}".rstrip()
            publisher.publish(messages.text(json.dumps(status)))
            on_status(status)

        if follow(motion.at, motion.duration, connection, is_over, report, start, on_command):
            return True
    return False


def _measured(connection: Connection) -> Joints | None:
    """Return the measured pose of the servo's newest command [rad]; None if a joint is unknown."""
    for command in reversed([*connection.receive()]):
        return command.joint_pos if np.isfinite(command.joint_pos).all() else None
    return None


def _armed_at(
    connection: Connection,
    statistics: RunStatistics,
    before: float,
    on_command: Callable[[Command], None],
) -> float:
    """Count new commands of the servo; return when it was first armed: `before`, if that is finite [s]."""
    for command in connection.receive():
        statistics.note_command(command)
        on_command(command)
        if command.mode == Mode.STOPPED and before < inf:
            raise DeploymentError(
                f"the robot was stopped ({', '.join(statistics.stops)}) {command.time - before:.1f} s after "
                "it was armed: remove the reason, and begin again."
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
