"""A robot that follows a motion instead of a policy: that of `excite`, a joint check, or a way to a pose."""

import json
from collections.abc import Callable
from dataclasses import replace
from math import inf
from typing import Any

import numpy as np

from pixel2catch.deployment.control_loop import Connection
from pixel2catch.deployment.paths import Motion, blind_targets
from pixel2catch.deployment.statistics import RunStatistics
from pixel2catch.errors import DeploymentError
from pixel2catch.ros2 import messages
from pixel2catch.ros2.transport import Topic
from pixel2catch.servo.limits import STOP_TIME, Joints, ServoLimits
from pixel2catch.servo.link import Command, Fault, Mode, flag_names

PERIOD = 0.01  #: Time between two targets [s]. Source: ours.
START_ERROR = 0.02  #: Motion of a joint after which a motion is planned again [rad]. Source: ours.


def follow(
    plan: Callable[[Joints], Motion],
    what: str,
    connection: Connection,
    topic: Topic,
    is_over: Callable[[], bool],
    on_status: Callable[[dict[str, Any]], None],
    on_command: Callable[[Command], None] = lambda _: None,
) -> bool:
    """Plan a motion from the measured pose, announce it, and follow it once, when the servo is armed.

    It is planned again if somebody moves the robot before. In the servo's ramp, the robot moves to the first
    targets. Operator and servo guard it. A status is published with every target; its "done" is the share of
    the motion that was sent. Returns whether the motion was followed to its end, not ended by `is_over`.
    Raises DeploymentError if there is no such motion, or servo or robot have stopped.
    """
    statistics, clock = RunStatistics(), connection.clock
    publisher = connection.transport.publisher(topic)
    motion, targets, start, joint_pos = None, None, np.array(inf), np.array(np.nan)
    armed_at, share, due, announced = inf, 0.0, clock.now(), ""
    while share < 1.0 and not is_over():
        for command in connection.receive():
            statistics.note_command(command)
            on_command(command)
            joint_pos, armed_at = command.joint_pos, _armed_at(command, armed_at)
        if targets is None and np.abs(joint_pos - start).max() > START_ERROR:
            motion, start = plan(joint_pos), joint_pos
            armed_at = max(armed_at, clock.now())
            announced = f"{what}: {motion.duration:.0f} s of motion. "
        if motion and armed_at < inf:
            now = clock.now()
            elapsed = now - armed_at - ServoLimits.ramp_time
            share = min(max(elapsed / motion.duration, 0.0), 1.0)
            targets = blind_targets(motion.at(elapsed), now)
            connection.servo.send(targets)
        status = statistics.status(None, announced + connection.record(targets))
        publisher.publish(messages.text(json.dumps(status)))
        on_status(status | {"done": share})
        due = max(due + PERIOD, clock.now())
        clock.sleep_until(due)
    if targets:
        connection.servo.send(replace(targets, target_stamp=clock.now(), is_stop_requested=True))
    clock.sleep_until(clock.now() + STOP_TIME)
    connection.record()
    return share == 1.0


def _armed_at(command: Command, before: float) -> float:
    """Return when the servo was first armed, `before` if finite [s]; raise if it has stopped since."""
    if command.mode == Mode.STOPPED and before < inf:
        raise DeploymentError(
            f"the robot was stopped ({', '.join(flag_names(Fault, command.stopped_by))}) "
            f"{command.time - before:.1f} s after it was armed: remove the reason, and begin again."
        )
    return min(before, command.time) if command.mode == Mode.ARMED else before
