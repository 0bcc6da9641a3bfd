"""What is wrong with what the servo of one robot is told.

All stamps are of one monotonic clock. A stamp that is no number, or of the future, is as bad as an old one.
"""

from enum import IntFlag

import numpy as np

from pixel2catch.servo.compilation import Record, Records, compiled
from pixel2catch.servo.flags import Fault
from pixel2catch.servo.limits import REST_ERROR

JITTER = 0.015  #: How much earlier or later a position may arrive than others do [s]. Source: ours.
SMOOTHING = 0.04  #: Time over which the speed of a joint is estimated [s]. Source: ours.
SLACK_LAGS = 3.0
"""In how many lags a distance from the command is forgotten that a motion explains. Source: ours."""

FROZEN_ANGLE = 0.01
"""Motion of a command in which its joint must be measured elsewhere by a bit at least [rad]. Source: ours."""

FROZEN_TIME = 0.15  #: Time that a joint has for that [s]. Source: ours, more than the lag of any servo here.
LAG_MARGIN = 1.05
"""Share of the lag that is seen that counts. Source: ours, half of what the speed has to spare."""

LEAST_LAG = 0.002  #: Lag that any joint has [s]. Source: ours, a tick.

LEAST_EVIDENCE, MOST_EVIDENCE = 0.003, 0.15
"""Motion from which the lag of a joint is known, and that of which it is the mean: v² t [rad²/s].

Source: ours; 0.03 s after the beginning of a swing, and 0.02 s of the fastest.
"""

CLOCK_ERROR = 1e-3  #: How far ahead a stamp may be [s]. Source: ours; processes read the clock in turn.


@compiled
def is_recent(now: float, stamp: float, age: float) -> bool:
    """Whether a stamp is of the time up to an age ago [s]."""
    elapsed = now - stamp
    return (elapsed >= -CLOCK_ERROR) and (elapsed <= age)


@compiled
def bit(fault: IntFlag, holds: bool) -> int:
    """A flag if it holds, as a number."""
    return fault.value if holds else 0


@compiled
def faults_of_robot(last_tick: float, told: Record, limits: Record) -> int:
    """What is wrong with robot, operator and clock, by what is told and the time of the tick before [s]."""
    elapsed = told.now - last_tick
    return (
        bit(Fault.CLOCK, not ((elapsed > 0.0) and (elapsed <= limits.tick_age)))
        | bit(Fault.SAFETY_MODE, not told.is_safe)
        | bit(Fault.SPEED_SCALING, told.speed_scaling != 1.0)
        | bit(Fault.STATUS_UNKNOWN, not told.is_status_known)
        | bit(Fault.CONTROLLER, not told.has_controller)
        | bit(Fault.NO_SUBSCRIBER, not told.has_subscriber)
        | bit(Fault.OTHER_SUBSCRIBER, told.has_other_subscriber)
        | bit(Fault.OTHER_PUBLISHER, told.has_other_publisher)
        | bit(Fault.OTHER_OPERATOR, told.has_other_operator)
        | bit(Fault.DEAD_MAN, not is_recent(told.now, told.dead_man_stamp, limits.operator_age))
        | bit(Fault.STOP_REQUEST, told.is_stop_requested)
    )


@compiled
def faults_of_policy(told: Record, is_finite: bool, limits: Record) -> int:
    """What is wrong with what the policy sees and says; whether all of its targets are numbers is given."""
    return (
        bit(Fault.IMAGE_STALE, not is_recent(told.now, told.image_stamp, limits.image_age))
        | bit(Fault.POLICY_LATE, not is_recent(told.now, told.target_stamp, limits.target_age))
        | bit(Fault.TARGET_NOT_FINITE, not is_finite)
        | bit(Fault.OBJECT_LOST, not is_recent(told.now, told.box_stamp, limits.box_age))
        | bit(Fault.PERCEPTION_UNSOUND, not told.is_perception_sound)
    )


@compiled
def follow(joint: Record, position: float, stamp: float, is_followed: bool, limits: Record) -> bool:
    """Note a measured position [rad] and its stamp [s]; say whether the joint went there as none can.

    A joint that follows with a lag has the speed (command - position) / lag, whatever the command does; so
    has every mean of both. Up to the lag that is told, a little more than is seen counts; beyond it, what is
    seen.
    """
    command, expected = joint.command, joint.expected
    is_new = np.isfinite(position) and np.isfinite(stamp) and not stamp <= joint.stamp
    is_next = is_new and np.isfinite(joint.stamp)
    elapsed = stamp - joint.stamp if is_next else 0.0
    moved = position - joint.measured if is_next else 0.0
    is_jump = abs(moved) > limits.jump_speed * (elapsed + JITTER)
    share = np.minimum(elapsed / SMOOTHING, 1.0)
    joint.speed *= 1.0 - share
    joint.speed += 0.0 if is_jump else moved / np.maximum(elapsed, SMOOTHING)
    if np.isfinite(position):
        joint.explained = nearest_explained(joint, position) if is_followed else position
    joint.slack = np.maximum(
        abs(command - expected), joint.slack * (1.0 - limits.dt / (SLACK_LAGS * limits.lag))
    )
    if not (is_followed and moved == 0.0):
        joint.anchor = command
    is_still = abs(command - joint.anchor) > FROZEN_ANGLE
    joint.still_time = joint.still_time + limits.dt if is_still else 0.0
    ahead = (1.0 - share) * joint.ahead + (command - joint.measured if is_next else 0.0) * share
    joint.ahead = ahead if is_followed else 0.0
    see_lag(joint, joint.speed * elapsed if is_followed else 0.0, limits)
    if is_new:
        joint.measured, joint.stamp = position, stamp
    return is_jump


@compiled
def nearest_explained(joint: Record, position: float) -> float:
    """The position nearest to a measured one to which commands may have led, or something stopped [rad]."""
    least = np.minimum(np.minimum(joint.command, joint.expected), joint.explained)
    most = np.maximum(np.maximum(joint.command, joint.expected), joint.explained)
    return np.maximum(least, np.minimum(position, most))


@compiled
def see_lag(joint: Record, way: float, limits: Record) -> None:
    """Learn the lag of a joint from a way that it has gone [rad]."""
    joint.evidence = np.minimum(joint.evidence + way * joint.speed, MOST_EVIDENCE)
    wrong = joint.ahead - joint.seen_lag * joint.speed
    joint.seen_lag += way * wrong / np.maximum(joint.evidence, 1e-9)
    joint.is_lag_seen = limits.is_arm and joint.evidence >= LEAST_EVIDENCE
    joint.lag = limits.lag
    if joint.is_lag_seen:
        most = np.minimum(np.maximum(limits.lag, joint.seen_lag), (1.0 + limits.lag_error) * limits.lag)
        joint.lag = np.minimum(np.maximum(LAG_MARGIN * joint.seen_lag, LEAST_LAG), most)


@compiled
def expect(joint: Record, limits: Record) -> None:
    """Where the joint should be a tick later by its lag, from where it should have been before."""
    joint.expected += np.minimum(limits.dt / joint.lag, 1.0) * (joint.command - joint.expected)


@compiled
def faults_of_joints(joints: Records, told: Records, now: float, is_followed: bool, limits: Records) -> int:
    """Note what is measured, and say what is wrong with it.

    An arm's joint is where its servo has it: near its command at rest, and as far behind as the lag explains
    in motion. A finger may be stopped by what it holds; it does not leave its command by itself. Robots are
    followed that have been commanded, from the same pose on, for a tick at least.
    """
    found, of_commands, num_fingers, num_frozen = 0, 0, 0, 0
    for number in range(len(joints)):
        joint, position, stamp = joints[number], told[number].joint_pos, told[number].joint_stamp
        limit = limits[number]
        is_jump = follow(joint, position, stamp, is_followed, limit)
        is_impossible = (position < limit.least) or (position > limit.most) or is_jump
        found |= bit(Fault.JOINTS_STALE, not is_recent(now, stamp, limit.position_age))
        found |= bit(Fault.JOINTS_NOT_FINITE, not np.isfinite(position))
        found |= bit(Fault.JOINTS_IMPLAUSIBLE, is_impossible)
        most = np.minimum(limit.tracking_error, REST_ERROR + limit.lag_error * joint.slack)
        is_off, is_still = abs(position - joint.expected) > most, joint.still_time > FROZEN_TIME
        of_commands |= bit(Fault.JOINTS_IMPLAUSIBLE, abs(position - joint.explained) > limit.escape)
        of_commands |= bit(Fault.JOINT_SPEED, abs(joint.speed) > limit.joint_speed)
        of_commands |= bit(Fault.TRACKING_ERROR, is_off and limit.is_arm)
        of_commands |= bit(Fault.JOINTS_FROZEN, is_still and limit.is_arm)
        num_fingers += limit.is_finger
        num_frozen += is_still and limit.is_finger
    of_commands |= bit(Fault.JOINTS_FROZEN, num_frozen == num_fingers and num_fingers > 0)
    return found | of_commands if is_followed else found
