"""The servo between policy and robot as a state machine: one tick every 2 ms, without clock or transport.

    idle ──arm──► armed ──first target──► ramp ──1 s──► run
                  ▲   │                    │             │
                 arm  └──────fault─────────┴────fault────┘
                  │   ▼
                 stopped ──robot off, or moved by somebody else──► idle

Armed, the robot holds its pose. In the ramp, commands go over to the policy's targets; in the run they
follow them. As in training, a command moves uniformly from its place to the newest target, and reaches it
after a control step.

A fault stops the robot: within `STOP_TIME`, the commands return to the joints and brake. The robot moves
again only after a new request to arm. No command passes a limit, whatever the inputs are. In idle, nothing is
sent: what starts the robot's program again, such as play on a pendant, moves nothing.

Rows are independent robots: one in the laboratory, thousands in tests.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from pixel2catch.errors import DeploymentError
from pixel2catch.installation import needs_extra
from pixel2catch.servo.laws import (
    RETURN_TIME,
    Record,
    Records,
    bit,
    clipped,
    entry,
    hand_faults,
    interpolated,
    is_active,
    is_driven,
    is_recent,
    joint_faults,
    limited_speed,
    moving_mean,
    speed_to,
    update_expected,
)
from pixel2catch.servo.limits import STOP_TIME, ServoLimits
from pixel2catch.servo.link import Clamp, Fault, Mode
from pixel2catch.servo.state import JOINT_INPUT, JOINT_STATE, ROBOT_INPUT, ROBOT_STATE, ServoInputs
from pixel2catch.servo.workspace import Space, is_inside, limit_to_workspace

ROUNDING = 1e-6  #: Excess of a limit that is rounding: policies have single precision [rad, rad/s].
_BAD_TARGET = (Fault.TARGET_NOT_FINITE | Fault.TARGET_FAR).value
_NOT_MEASURED = (Fault.JOINTS_STALE | Fault.JOINTS_NOT_FINITE | Fault.JOINTS_IMPLAUSIBLE).value

#: Faults of a robot that may not follow commands at present, and may follow them at any time again.
_OFF = (Fault.SAFETY_MODE | Fault.SPEED_SCALING | Fault.STATUS_UNKNOWN | Fault.CONTROLLER).value
_OFF |= (Fault.NO_SUBSCRIBER | Fault.JOINTS_STALE).value


@dataclass(frozen=True, kw_only=True, eq=False)
class ServoState:
    """State of all rows."""

    robots: np.ndarray  #: `ROBOT_STATE` (rows).
    joints: np.ndarray  #: `JOINT_STATE` (rows, joints).
    recent: Float64[np.ndarray, "rows joints ticks"]  #: Newest positions, oldest first [rad].

    @classmethod
    def idle(cls, num_rows: int, limits: ServoLimits) -> "ServoState":
        robots, joints = np.zeros(num_rows, ROBOT_STATE), np.zeros((num_rows, limits.num_joints), JOINT_STATE)
        robots["now"] = joints["measured"] = joints["stamp"] = np.nan
        for name in ("arm_stamp", "used_press", "target_stamp"):
            robots[name] = -np.inf
        recent = np.zeros((*joints.shape, limits.joint_records["window"].max()))
        return cls(robots=robots, joints=joints, recent=recent)

    def __getitem__(self, name: str) -> np.ndarray:
        return (self.robots if name in (ROBOT_STATE.names or ()) else self.joints)[name]


class ServoCore:
    """The state machine under given limits: call `tick` every 2 ms, first with `ServoState.idle`."""

    def __init__(self, limits: ServoLimits) -> None:
        """Compile the tick, for some seconds the first time; raise DeploymentError without numba."""
        self._limits = Limits(limits.robot_records, limits.joint_records, limits.workspace.space)
        idle = ServoState.idle(1, limits)
        inputs = np.zeros(1, ROBOT_INPUT), np.zeros(idle.joints.shape, JOINT_INPUT)
        with needs_extra("deployment", error=DeploymentError):
            tick_all(self._limits, idle.robots, idle.joints, idle.recent, *inputs)

    def tick(self, state: ServoState, inputs: ServoInputs) -> ServoState:
        """Return the state of this tick. Missed ticks must not be made up for."""
        robots, joints, recent = state.robots.copy(), state.joints.copy(), state.recent.copy()
        robot_inputs, joint_inputs = np.empty(robots.shape, ROBOT_INPUT), np.empty(joints.shape, JOINT_INPUT)
        for entries in (robot_inputs, joint_inputs):
            for name in entries.dtype.names or ():
                entries[name] = getattr(inputs, name)
        tick_all(self._limits, robots, joints, recent, robot_inputs, joint_inputs)
        return ServoState(robots=robots, joints=joints, recent=recent)


class Limits(NamedTuple):
    """Limits of a robot, as the compiled laws need them."""

    robot: Record
    joints: Records
    space: Space


@entry
def tick_all(
    limits: Limits, robots: Records, joints: Records, recent: np.ndarray, inputs: Records, own_inputs: Records
) -> None:
    """Advance all robots by a tick, in place; recent positions are (rows, joints, ticks) [rad]."""
    own_limits = Limits(limits.robot[0], limits.joints, limits.space)
    for row in range(len(robots)):
        robot = robots[row]
        read_inputs(robot, joints[row], inputs[row], own_inputs[row], own_limits)
        update_mode(robot, joints[row], recent[row], inputs[row], own_limits)
        read_target(robot, joints[row], inputs[row], own_inputs[row], own_limits)
        step_motion(robot, joints[row], recent[row], own_limits)
        robot.found = robot.faults | robot.policy_faults
        is_silent = robot.mode == Mode.IDLE or has_other_publisher(robot)
        for joint in joints[row]:
            joint.sent = np.nan if is_silent else joint.command


def has_other_publisher(robot: Record) -> bool:
    """Return whether the robot was stopped because another program commands it: nothing is sent then."""
    return robot.stopped_by & Fault.OTHER_PUBLISHER.value != 0


def read_inputs(robot: Record, joints: Records, inputs: Record, own_inputs: Records, limits: Limits) -> None:
    """Find the faults of this tick, and update joint positions and estimates."""
    now, own = inputs.now, limits.robot
    is_finite, is_far, is_commanded = True, False, is_active(robot) and robot.ticks > 0
    found = joint_faults(joints, own_inputs, now, is_commanded, limits.joints)
    if is_commanded:
        found |= hand_faults(robot, joints, inputs, limits.joints)
    for number in range(len(joints)):
        joint, measured, target = joints[number], own_inputs[number], own_inputs[number].joint_pos_target
        joint.joint_pos = measured.joint_pos if np.isfinite(measured.joint_pos) else joint.command
        is_finite &= np.isfinite(target)
        is_far |= abs(target - joint.hold) > limits.joints[number].start_distance
    robot.faults = (
        found
        | bit(Fault.CLOCK, not ((now - robot.now > 0.0) and (now - robot.now <= own.tick_age)))
        | bit(Fault.SAFETY_MODE, not inputs.is_safe)
        | bit(Fault.SPEED_SCALING, inputs.speed_scaling != 1.0)
        | bit(Fault.STATUS_UNKNOWN, not inputs.is_status_known)
        | bit(Fault.CONTROLLER, not inputs.has_controller)
        | bit(Fault.NO_SUBSCRIBER, not inputs.has_subscriber)
        | bit(Fault.OTHER_SUBSCRIBER, inputs.has_other_subscriber)
        | bit(Fault.OTHER_PUBLISHER, inputs.has_other_publisher)
        | bit(Fault.OTHER_OPERATOR, inputs.has_other_operator)
        | bit(Fault.DEAD_MAN, not is_recent(now, inputs.dead_man_stamp, own.operator_age))
        | bit(Fault.STOP_REQUEST, inputs.is_stop_requested)
    )
    robot.policy_faults = (
        bit(Fault.IMAGE_STALE, not is_recent(now, inputs.image_stamp, own.image_age))
        | bit(Fault.POLICY_LATE, not is_recent(now, inputs.target_stamp, own.target_age))
        | bit(Fault.TARGET_NOT_FINITE, not is_finite)
        | bit(Fault.TARGET_FAR, robot.mode == Mode.ARMED and is_far)
        | bit(Fault.OBJECT_LOST, not is_recent(now, inputs.box_stamp, own.box_age))
        | bit(Fault.PERCEPTION_UNSOUND, not inputs.is_perception_sound)
    )


def update_mode(robot: Record, joints: Records, recent: np.ndarray, inputs: Record, limits: Limits) -> None:
    """Change the mode, and grant or refuse a request to arm."""
    first, is_requested, robot.refused = np.empty(len(joints)), False, 0
    is_new = inputs.arm_stamp > robot.arm_stamp
    if is_new and is_recent(inputs.now, inputs.arm_stamp, limits.robot.operator_age):
        robot.arm_stamp, is_requested = inputs.arm_stamp, not is_active(robot)
    is_free = robot.mode == Mode.IDLE or has_other_publisher(robot)
    for number in range(len(joints) if is_requested else 0):
        joint, limit = joints[number], limits.joints[number]
        first[number] = clipped(joint.joint_pos, limit.lower, limit.upper) if is_free else joint.command
    if is_requested:
        robot.refused = refusals(robot, joints, first, inputs.pressed_stamp, limits)
    stop = stopping_faults(robot)
    next_mode(robot, joints, stop, limits)
    robot.is_returning = (stop != 0 or robot.is_returning) and robot.faults & _NOT_MEASURED == 0
    robot.now = inputs.now
    if stop != 0:
        robot.stopped_by = stop
        robot.used_press = np.fmax(robot.used_press, inputs.pressed_stamp)
        for joint in joints:
            joint.hold, joint.lead = joint.command, joint.command - joint.joint_pos
    elif robot.mode != Mode.STOPPED:
        robot.stopped_by = 0
    if is_requested and robot.refused == 0:
        arm(robot, joints, recent, first)


def stopping_faults(robot: Record) -> int:
    """Return the faults that stop the robot; armed, those of a policy count once it sends targets."""
    found = robot.policy_faults if is_driven(robot) else 0
    if robot.mode == Mode.ARMED and robot.policy_faults & Fault.POLICY_LATE.value == 0:
        found = robot.policy_faults & _BAD_TARGET
    return robot.faults | found if is_active(robot) else 0


def next_mode(robot: Record, joints: Records, stop: int, limits: Limits) -> None:
    """Change to the mode of this tick, by the faults that stop the robot."""
    mode, time = robot.mode, robot.ticks * limits.robot.dt
    if stop != 0:
        mode = Mode.STOPPED.value
    elif mode == Mode.ARMED and robot.policy_faults == 0:
        mode = Mode.RAMP.value
    elif mode == Mode.RAMP and time >= limits.robot.ramp_time:
        mode = Mode.RUN.value
    elif mode == Mode.STOPPED and time >= STOP_TIME:
        is_off = (robot.faults | robot.stopped_by) & _OFF != 0
        mode = Mode.IDLE.value if is_off or was_moved(robot, joints, limits) else mode
    robot.ticks = robot.ticks + 1 if mode == robot.mode else 0
    robot.mode = mode


def was_moved(robot: Record, joints: Records, limits: Limits) -> bool:
    """Return whether somebody moved the stopped robot."""
    is_away = False
    for number in range(len(joints)):
        distance = abs(joints[number].joint_pos - joints[number].command)
        is_away |= distance > limits.joints[number].moved_error
    return is_away and robot.faults & _NOT_MEASURED == 0


def refusals(robot: Record, joints: Records, first: np.ndarray, pressed_stamp: float, limits: Limits) -> int:
    """Return the faults that make arming with these first commands [rad] impossible."""
    is_off = False
    for number in range(len(joints)):
        is_off |= abs(joints[number].joint_pos - first[number]) > limits.joints[number].start_error
    is_stopping = robot.mode == Mode.STOPPED and robot.ticks * limits.robot.dt < STOP_TIME
    return (
        robot.faults
        | bit(Fault.START_POSE, is_off)
        | bit(Fault.WORKSPACE, not is_inside(limits.space, first[limits.space.columns]))
        | bit(Fault.STILL_STOPPING, is_stopping)
        | bit(Fault.SWITCH_NOT_PRESSED, not pressed_stamp > robot.used_press)
    )


def arm(robot: Record, joints: Records, recent: np.ndarray, commands: np.ndarray) -> None:
    """Arm the robot, at rest at its first commands [rad]."""
    robot.mode, robot.ticks, robot.stopped_by = Mode.ARMED.value, 0, 0
    robot.target_stamp = -np.inf
    for number in range(len(joints)):
        joint, first = joints[number], commands[number]
        joint.position, joint.velocity, joint.command, joint.hold = first, 0.0, first, first
        joint.start, joint.end, joint.expected = first, first, joint.joint_pos
        recent[number, :] = first


def read_target(robot: Record, joints: Records, inputs: Record, own_inputs: Records, limits: Limits) -> None:
    """Begin the motion to a newer target."""
    robot.clamped = 0
    if not is_driven(robot):
        return
    is_new, elapsed = inputs.target_stamp > robot.target_stamp, robot.now - robot.target_begun
    for number in range(len(joints)):
        joint, limit, target = joints[number], limits.joints[number], own_inputs[number].joint_pos_target
        allowed = clipped(target, limit.lower, limit.upper)
        robot.clamped |= bit(Clamp.POSITION, abs(allowed - target) > ROUNDING)
        if is_new:
            joint.start = interpolated(joint.start, joint.end, elapsed, limit.control_dt)
            joint.end = allowed
    if is_new:
        robot.target_begun, robot.target_stamp = robot.now, inputs.target_stamp


def target_speed(robot: Record, joint: Record, limit: Record) -> float:
    """Return the speed of an armed robot's joint to its target, with a limited lead [rad/s]."""
    goal = joint.hold
    if is_driven(robot):
        share = min((robot.ticks + 1) * limit.dt / limit.ramp_time, 1.0) if robot.mode == Mode.RAMP else 1.0
        elapsed = robot.now - robot.target_begun + limit.time_ahead
        wanted = interpolated(joint.start, joint.end, elapsed, limit.control_dt)
        wanted = joint.hold + share * (wanted - joint.hold)
        age = np.fmin(robot.now - joint.stamp, limit.hold)
        reach = limit.even_speed * (joint.lag + limit.delay + age + 0.5 * limit.hold + limit.brake_time)
        goal = clipped(wanted, joint.joint_pos - reach, joint.joint_pos + reach)
        robot.clamped |= bit(Clamp.LEAD, goal != wanted)
    speed = speed_to(joint.position, clipped(goal, limit.lower, limit.upper), limit)
    most = np.inf if joint.is_lag_estimated else limit.unseen_speed
    return clipped(speed, -most, most)


def stop_speed(robot: Record, joint: Record, limit: Record) -> float:
    """Return the speed that brings a joint to rest [rad/s], from its position if that is measured.

    It is at most the speed from which braking ends within `STOP_TIME`.
    """
    time = robot.ticks * limit.dt
    left = limit.stop_time - time
    if robot.is_returning and time < RETURN_TIME:
        speed = joint.speed - joint.lead / limit.stop_time if left > 0.0 else 0.0
        back = joint.joint_pos + joint.lead * max(left / limit.stop_time, 0.0) + speed * limit.time_ahead
        back = clipped(back, joint.hold - limit.stop_reach, joint.hold + limit.stop_reach)
        speed += speed_to(joint.position, clipped(back, limit.lower, limit.upper), limit)
    else:
        slower = clipped(joint.velocity, -limit.even_speed, limit.even_speed)
        speed = slower * max(1.0 - limit.dt / max(left, limit.dt), 0.0)
    fastest = limit.change * max(STOP_TIME / limit.dt - limit.window - robot.ticks, 0.0)
    return clipped(speed, -fastest, fastest)


def step_motion(robot: Record, joints: Records, recent: np.ndarray, limits: Limits) -> None:
    """Move all commands by a tick."""
    speeds, kept = np.empty(len(joints)), np.empty(len(joints))
    for number in range(len(joints)):
        joint, limit = joints[number], limits.joints[number]
        wanted = target_speed(robot, joint, limit) if is_active(robot) else stop_speed(robot, joint, limit)
        speeds[number] = kept[number] = limited_speed(joint.position, joint.velocity, wanted, limit)
        robot.clamped |= bit(Clamp.SPEED, abs(wanted) > limit.speed)
        robot.clamped |= bit(Clamp.ACCELERATION, abs(wanted - joint.velocity) > limit.change + ROUNDING)
    if robot.mode != Mode.IDLE:
        limit_to_workspace(limits.space, joints, recent, kept, limits.joints)
    for number in range(len(joints)):
        joint, limit = joints[number], limits.joints[number]
        robot.clamped |= bit(Clamp.WORKSPACE, kept[number] != speeds[number])
        joint.velocity = kept[number]
        joint.position += joint.velocity * limit.dt
        joint.command = moving_mean(recent[number], joint.position, limit)
        update_expected(joint, limit)
