"""One tick of the state machine that `core` describes, of robots that know nothing of each other."""

from typing import NamedTuple

import numpy as np

from pixel2catch.servo.braking import keep_inside
from pixel2catch.servo.clearance import is_inside
from pixel2catch.servo.compilation import Record, Records, compiled, entry
from pixel2catch.servo.flags import Clamp, Fault, Mode
from pixel2catch.servo.limits import RETURN_TIME, STOP_TIME
from pixel2catch.servo.motion import averaged, clipped, on_the_way, towards, wished
from pixel2catch.servo.watchdogs import (
    bit,
    expect,
    faults_of_joints,
    faults_of_policy,
    faults_of_robot,
    is_recent,
)
from pixel2catch.servo.workspace import Space

ROUNDING = 1e-6  #: Excess of a limit that is rounding: policies are of single precision [rad, rad/s].
_SENSELESS = (Fault.TARGET_NOT_FINITE | Fault.TARGET_FAR).value
_NOT_MEASURED = (Fault.JOINTS_STALE | Fault.JOINTS_NOT_FINITE | Fault.JOINTS_IMPLAUSIBLE).value


class Limits(NamedTuple):
    """What a robot keeps to."""

    robot: Record
    joints: Records
    space: Space


@entry
def tick_all(
    limits: Limits,
    robots: Records,
    joints: Records,
    recent: np.ndarray,
    told: Records,
    told_joints: Records,
    sent: np.ndarray,
) -> None:
    """Change the states of all robots to those of this tick, and write what is sent to their joints.

    States and inputs are of the types in `core`, the limits those of `ServoLimits`; recent positions are
    (rows, joints, ticks), what is sent is (rows, joints) [rad].
    """
    limits_of_one = Limits(limits.robot[0], limits.joints, limits.space)
    for row in range(len(robots)):
        robot = robots[row]
        look(robot, joints[row], told[row], told_joints[row], limits_of_one)
        change(robot, joints[row], recent[row], told[row], limits_of_one)
        turn(robot, joints[row], told[row], told_joints[row], limits_of_one)
        move(robot, joints[row], recent[row], limits_of_one)
        is_silent = robot.mode == Mode.IDLE or is_left_to_others(robot)
        for number in range(joints.shape[1]):
            sent[row, number] = np.nan if is_silent else joints[row, number].command


@compiled
def is_driven(robot: Record) -> bool:
    """Whether the policy moves it, in the ramp or after it."""
    return Mode.RAMP <= robot.mode <= Mode.RUN


@compiled
def is_active(robot: Record) -> bool:
    """Whether a fault stops it."""
    return Mode.ARMED <= robot.mode <= Mode.RUN


@compiled
def is_left_to_others(robot: Record) -> bool:
    """Whether it is stopped because somebody else commands it: nothing is sent to it."""
    return robot.stopped_by & Fault.OTHER_PUBLISHER.value != 0


@compiled
def is_measured(robot: Record) -> bool:
    """Whether the positions of all joints are fresh numbers."""
    return robot.wrong & _NOT_MEASURED == 0


@compiled
def look(robot: Record, joints: Records, told: Record, told_joints: Records, limits: Limits) -> None:
    """Look at everything: what is found wrong, and where the joints are."""
    is_followed = is_active(robot) and robot.ticks > 0
    robot.wrong = faults_of_robot(robot.now, told, limits.robot)
    robot.wrong |= faults_of_joints(joints, told_joints, told.now, is_followed, limits.joints)
    is_finite, is_far = True, False
    for number in range(len(joints)):
        joint, heard = joints[number], told_joints[number]
        joint.joint_pos = heard.joint_pos if np.isfinite(heard.joint_pos) else joint.command
        is_finite &= np.isfinite(heard.joint_pos_target)
        is_far |= abs(heard.joint_pos_target - joint.hold) > limits.joints[number].start_distance
    robot.wrong_policy = faults_of_policy(told, is_finite, limits.robot)
    robot.wrong_policy |= bit(Fault.TARGET_FAR, robot.mode == Mode.ARMED and is_far)


@compiled
def change(robot: Record, joints: Records, recent: np.ndarray, told: Record, limits: Limits) -> None:
    """Go over to the mode of this tick; what is asked for is granted or refused by the mode before."""
    is_asked, robot.refused = False, 0
    if told.arm_stamp > robot.arm_stamp and is_recent(told.now, told.arm_stamp, limits.robot.operator_age):
        robot.arm_stamp, is_asked = told.arm_stamp, not is_active(robot)
    is_free = robot.mode == Mode.IDLE or is_left_to_others(robot)
    if is_asked:
        robot.refused = refusals(robot, joints, is_free, told.pressed_stamp, limits)
    stop = faults_that_stop(robot)
    next_mode(robot, joints, stop, limits)
    robot.is_returning = (stop != 0 or robot.is_returning) and is_measured(robot)
    robot.now = told.now
    if stop != 0:
        robot.stopped_by = stop
        if told.pressed_stamp > robot.used_press:
            robot.used_press = told.pressed_stamp
        for joint in joints:
            joint.hold, joint.lead = joint.command, joint.command - joint.joint_pos
    elif robot.mode != Mode.STOPPED:
        robot.stopped_by = 0
    if is_asked and robot.refused == 0:
        arm(robot, joints, recent, is_free, limits)


@compiled
def faults_that_stop(robot: Record) -> int:
    """What stops the robot in this tick; armed, it waits for a policy, but for one that makes sense."""
    found = robot.wrong_policy if is_driven(robot) else 0
    if robot.mode == Mode.ARMED and robot.wrong_policy & Fault.POLICY_LATE.value == 0:
        found = robot.wrong_policy & _SENSELESS
    return robot.wrong | found if is_active(robot) else 0


@compiled
def next_mode(robot: Record, joints: Records, stop: int, limits: Limits) -> None:
    """Go over to the mode of this tick, by the faults that stop."""
    mode, time = robot.mode, robot.ticks * limits.robot.dt
    if stop != 0:
        mode = Mode.STOPPED.value
    elif mode == Mode.ARMED and robot.wrong_policy == 0:
        mode = Mode.RAMP.value
    elif mode == Mode.RAMP and time >= limits.robot.ramp_time:
        mode = Mode.RUN.value
    elif mode == Mode.STOPPED and time >= STOP_TIME and was_moved(robot, joints, limits):
        mode = Mode.IDLE.value
    robot.ticks = robot.ticks + 1 if mode == robot.mode else 0
    robot.mode = mode


@compiled
def was_moved(robot: Record, joints: Records, limits: Limits) -> bool:
    """Whether somebody else has moved the robot after a stop, such as to its start."""
    is_away = False
    for number in range(len(joints)):
        distance = abs(joints[number].joint_pos - joints[number].command)
        is_away |= distance > limits.joints[number].moved_error
    return is_away and is_measured(robot)


@compiled
def first_command(joint: Record, is_free: bool, limit: Record) -> float:
    """Where a joint would be armed: where it is measured, or where a stop has left its command [rad]."""
    return clipped(joint.joint_pos, limit.lower, limit.upper) if is_free else joint.command


@compiled
def refusals(robot: Record, joints: Records, is_free: bool, pressed_stamp: float, limits: Limits) -> int:
    """Why the robot cannot be armed."""
    watched, is_off = np.empty(len(limits.space.columns)), False
    for number in range(len(joints)):
        first = first_command(joints[number], is_free, limits.joints[number])
        is_off |= abs(joints[number].joint_pos - first) > limits.joints[number].start_error
    for place, number in enumerate(limits.space.columns):
        watched[place] = first_command(joints[number], is_free, limits.joints[number])
    is_stopping = robot.mode == Mode.STOPPED and robot.ticks * limits.robot.dt < STOP_TIME
    return (
        robot.wrong
        | bit(Fault.START_POSE, is_off)
        | bit(Fault.WORKSPACE, not is_inside(limits.space, watched))
        | bit(Fault.STILL_STOPPING, is_stopping)
        | bit(Fault.SWITCH_NOT_PRESSED, not pressed_stamp > robot.used_press)
    )


@compiled
def arm(robot: Record, joints: Records, recent: np.ndarray, is_free: bool, limits: Limits) -> None:
    """Arm the robot, at rest at its first command, until the next target of whatever stamp."""
    robot.mode, robot.ticks, robot.stopped_by = Mode.ARMED.value, 0, 0
    robot.target_stamp = -np.inf
    for number in range(len(joints)):
        joint = joints[number]
        first = first_command(joint, is_free, limits.joints[number])
        joint.position, joint.velocity, joint.command, joint.hold = first, 0.0, first, first
        joint.start, joint.end, joint.expected = first, first, joint.joint_pos
        recent[number, :] = first


@compiled
def turn(robot: Record, joints: Records, told: Record, told_joints: Records, limits: Limits) -> None:
    """Begin the motion to a new target from where it is now; an older one does not replace it."""
    robot.clamped = 0
    if not is_driven(robot):
        return
    is_new, elapsed = told.target_stamp > robot.target_stamp, robot.now - robot.begun
    for number in range(len(joints)):
        joint, limit, target = joints[number], limits.joints[number], told_joints[number].joint_pos_target
        allowed = clipped(target, limit.lower, limit.upper)
        robot.clamped |= bit(Clamp.POSITION, abs(allowed - target) > ROUNDING)
        if is_new:
            joint.start = on_the_way(joint.start, joint.end, elapsed, limit.control_dt)
            joint.end = allowed
    if is_new:
        robot.begun, robot.target_stamp = robot.now, told.target_stamp


@compiled
def move(robot: Record, joints: Records, recent: np.ndarray, limits: Limits) -> None:
    """Move on by a tick."""
    speeds, kept = np.empty(len(joints)), np.empty(len(joints))
    for number in range(len(joints)):
        joint, limit = joints[number], limits.joints[number]
        wish = driven(robot, joint, limit) if is_active(robot) else stopping(robot, joint, limit)
        speeds[number] = kept[number] = towards(joint.position, joint.velocity, wish, limit)
        robot.clamped |= bit(Clamp.SPEED, abs(wish) > limit.speed)
        robot.clamped |= bit(Clamp.ACCELERATION, abs(wish - joint.velocity) > limit.change + ROUNDING)
    if robot.mode != Mode.IDLE:
        keep_inside(limits.space, joints, recent, kept, limits.joints)
    for number in range(len(joints)):
        joint, limit = joints[number], limits.joints[number]
        robot.clamped |= bit(Clamp.WORKSPACE, kept[number] != speeds[number])
        joint.velocity = kept[number]
        joint.position += joint.velocity * limit.dt
        joint.command = averaged(recent[number], joint.position, limit)
        expect(joint, limit)


@compiled
def driven(robot: Record, joint: Record, limit: Record) -> float:
    """The speed that takes an armed robot to where it shall go, near where its joint is [rad/s]."""
    goal = joint.hold
    if is_driven(robot):
        share = min((robot.ticks + 1) * limit.dt / limit.ramp_time, 1.0) if robot.mode == Mode.RAMP else 1.0
        elapsed = robot.now - robot.begun + limit.time_ahead
        wanted = on_the_way(joint.start, joint.end, elapsed, limit.control_dt)
        wanted = joint.hold + share * (wanted - joint.hold)
        reach = limit.even_speed * (joint.lag + limit.delay)
        goal = clipped(wanted, joint.joint_pos - reach, joint.joint_pos + reach)
        robot.clamped |= bit(Clamp.LEAD, goal != wanted)
    wish = wished(joint.position, clipped(goal, limit.lower, limit.upper), limit)
    slow = np.inf if joint.is_lag_seen else limit.unseen_speed
    return clipped(wish, -slow, slow)


@compiled
def stopping(robot: Record, joint: Record, limit: Record) -> float:
    """The speed that brings what is not armed to rest [rad/s]: from where the joint is, if that is known."""
    time = robot.ticks * limit.dt
    left = limit.stop_time - time
    if not (robot.is_returning and time < RETURN_TIME):
        slower = clipped(joint.velocity, -limit.even_speed, limit.even_speed)
        return slower * max(1.0 - limit.dt / max(left, limit.dt), 0.0)
    speed = joint.speed - joint.lead / limit.stop_time if left > 0.0 else 0.0
    back = joint.joint_pos + joint.lead * max(left / limit.stop_time, 0.0) + speed * limit.time_ahead
    back = clipped(back, joint.hold - limit.stop_reach, joint.hold + limit.stop_reach)
    return speed + wished(joint.position, clipped(back, limit.lower, limit.upper), limit)
