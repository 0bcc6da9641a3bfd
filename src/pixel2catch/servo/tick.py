"""The servo between policy and robot as a state machine: one tick every 2 ms, without clock or transport.

    idle ──arm──► armed ──first target──► ramp ──1 s──► run
                  ▲   │                    │             │
                 arm  └──────fault─────────┴────fault────┘
                  │   ▼
                 stopped ──moved by somebody else──► idle

Armed, the robot holds its pose. In the ramp, commands go over to the policy's targets; in the run they
follow them. As in training, a command moves uniformly from its place to the newest target, and reaches it
after a control step.

A fault stops the robot: within `STOP_TIME`, the commands return to the joints and brake. The robot moves
again only after a new request to arm. No command passes a limit, whatever the inputs are.

Rows are independent robots: one in the laboratory, thousands in tests.
"""

from dataclasses import dataclass, fields
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64

from pixel2catch.errors import DeploymentError
from pixel2catch.installation import needs_extra
from pixel2catch.servo.laws import (
    Record,
    Records,
    bit,
    clipped,
    compiled,
    entry,
    interpolated,
    is_active,
    is_driven,
    is_recent,
    joint_faults,
    limited_speed,
    moving_mean,
    policy_faults,
    robot_faults,
    stop_speed,
    target_speed,
    update_expected,
)
from pixel2catch.servo.limits import STOP_TIME, ServoLimits
from pixel2catch.servo.link import Clamp, Fault, Mode
from pixel2catch.servo.workspace import Space, is_inside, limit_to_workspace

Rows = Float64[np.ndarray, "rows joints"]
Times = Float64[np.ndarray, " rows"]
Flags = Bool[np.ndarray, " rows"]

ROUNDING = 1e-6  #: Excess of a limit that is rounding: policies have single precision [rad, rad/s].
_BAD_TARGET = (Fault.TARGET_NOT_FINITE | Fault.TARGET_FAR).value
_NOT_MEASURED = (Fault.JOINTS_STALE | Fault.JOINTS_NOT_FINITE | Fault.JOINTS_IMPLAUSIBLE).value

ROBOT_STATE = np.dtype(
    [
        ("mode", np.int64),  # a `Mode`
        ("ticks", np.int64),  # ticks since the mode began
        ("stopped_by", np.int64),  # `Fault` bits that caused the stop; 0 in other modes
        ("faults", np.int64),  # `Fault` bits of robot, operator and clock in the last tick
        ("policy_faults", np.int64),  # `Fault` bits of perception and policy in the last tick
        ("found", np.int64),  # both
        ("refused", np.int64),  # `Fault` bits that made the servo refuse to arm in the last tick
        ("clamped", np.int64),  # `Clamp` bits: limits that changed the command in the last tick
        ("now", np.float64),  # time of the last tick [s]
        ("arm_stamp", np.float64),  # stamp of the last request to arm, granted or not [s]
        ("used_press", np.float64),  # time of the switch's last press before the last stop [s]
        ("target_begun", np.float64),  # time at which the motion to the newest target began [s]
        ("target_stamp", np.float64),  # stamp of that target [s]
        ("is_returning", np.bool_),  # whether the joints have been measured since the last stop
    ],
    align=True,
)
"""State of a robot."""

JOINT_STATE = np.dtype(
    [
        ("position", np.float64),  # position before averaging [rad]
        ("velocity", np.float64),  # speed of the tick that led there [rad/s]
        ("command", np.float64),  # mean of the newest positions [rad]
        ("sent", np.float64),  # command that is sent to the driver [rad]; NaN if none is
        ("hold", np.float64),  # command when the mode last changed to armed or stopped [rad]
        ("lead", np.float64),  # distance of the command ahead of the joint at the last stop [rad]
        ("start", np.float64),  # start of the motion to the newest target [rad]
        ("end", np.float64),  # that target [rad]
        ("expected", np.float64),  # position predicted from the commands by the lag [rad]
        ("joint_pos", np.float64),  # measured position; the command if that is not finite [rad]
        ("measured", np.float64),  # newest finite measured position [rad]
        ("stamp", np.float64),  # its stamp [s]
        ("speed", np.float64),  # estimated speed [rad/s]
        ("explained", np.float64),  # `explained_position` [rad]
        ("slack", np.float64),  # distance behind the command that recent motion allows [rad]
        ("anchor", np.float64),  # command when the measurement last changed [rad]
        ("still_time", np.float64),  # time without a change while the command moved [s]
        ("ahead", np.float64),  # mean distance of the command ahead of the joint [rad]
        ("estimated_lag", np.float64),  # that distance per speed [s]
        ("evidence", np.float64),  # motion from which it is estimated [rad²/s]
        ("lag", np.float64),  # lag that is used: specified, or estimated once there is evidence [s]
        ("is_lag_estimated", np.bool_),  # whether there is enough evidence; arms only
    ],
    align=True,
)
"""State of a joint."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ServoInputs:
    """Inputs of a tick, one row for each robot, joints in joint order."""

    now: Times  #: Time of the tick [s].
    joint_pos: Rows  #: Newest measured joint positions [rad].
    joint_stamp: Rows  #: Their arrival times [s].
    joint_pos_target: Rows  #: Newest targets of the policy [rad].
    target_stamp: Times  #: Time of their decision [s].
    image_stamp: Times  #: Exposure time of the newest image [s].
    box_stamp: Times  #: Exposure time of the newest image in which the object was found [s].
    is_perception_sound: Flags  #: Whether images and boxes are plausible.
    dead_man_stamp: Times  #: Last time at which the dead-man's switch was held [s].
    pressed_stamp: Times  #: Last time at which it was pressed after a release or a silence [s].
    arm_stamp: Times  #: Time of the last request to arm [s].
    is_stop_requested: Flags  #: Whether operator or control loop request a stop.
    is_safe: Flags  #: Whether the robot's program runs in the normal safety mode.
    speed_scaling: Times  #: Share of the full speed at which the robot runs its program.
    is_status_known: Flags  #: Whether each driver's status is known from one sender.
    has_controller: Flags  #: Whether the controllers that take the commands are active.
    has_other_publisher: Flags  #: Whether another program sends commands to the robot.
    has_other_operator: Flags  #: Whether several programs hold the switch or request to arm.
    has_subscriber: Flags  #: Whether each driver receives its commands.
    has_other_subscriber: Flags  #: Whether several programs receive the commands of one driver.


ROBOT_INPUT, JOINT_INPUT = (
    np.dtype(
        [
            (field.name, np.bool_ if field.type is Flags else np.float64)
            for field in fields(ServoInputs)
            if (field.type is Rows) == is_of_joints
        ],
        align=True,
    )
    for is_of_joints in (False, True)
)
"""Inputs of a robot, and of a joint."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ServoState:
    """State of all rows."""

    robots: np.ndarray  #: `ROBOT_STATE` (rows).
    joints: np.ndarray  #: `JOINT_STATE` (rows, joints).
    recent: Float64[np.ndarray, "rows joints ticks"]  #: Newest positions, oldest first [rad].

    @classmethod
    def idle(cls, num_rows: int, limits: ServoLimits) -> "ServoState":
        """Return the initial state."""
        robots, joints = np.zeros(num_rows, ROBOT_STATE), np.zeros((num_rows, limits.num_joints), JOINT_STATE)
        robots["now"] = joints["measured"] = joints["stamp"] = np.nan
        for name in ("arm_stamp", "used_press", "target_stamp"):
            robots[name] = -np.inf
        recent = np.zeros((*joints.shape, limits.joint_records["window"].max()))
        return cls(robots=robots, joints=joints, recent=recent)

    def __getitem__(self, name: str) -> np.ndarray:
        """Return a field of all robots, or of all joints."""
        return (self.robots if name in (ROBOT_STATE.names or ()) else self.joints)[name]


class ServoCore:
    """The state machine under given limits: call `tick` every 2 ms, first with `ServoState.idle`."""

    def __init__(self, limits: ServoLimits) -> None:
        """Compile the tick, if that was not done on this machine, in some seconds.

        Raises:
            DeploymentError: numba is missing.
        """
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
    limits: Limits,
    robots: Records,
    joints: Records,
    recent: np.ndarray,
    robot_inputs: Records,
    joint_inputs: Records,
) -> None:
    """Advance all robots by a tick, in place; recent positions are (rows, joints, ticks) [rad]."""
    own_limits = Limits(limits.robot[0], limits.joints, limits.space)
    for row in range(len(robots)):
        robot = robots[row]
        read_inputs(robot, joints[row], robot_inputs[row], joint_inputs[row], own_limits)
        update_mode(robot, joints[row], recent[row], robot_inputs[row], own_limits)
        read_target(robot, joints[row], robot_inputs[row], joint_inputs[row], own_limits)
        step_motion(robot, joints[row], recent[row], own_limits)
        robot.found = robot.faults | robot.policy_faults
        is_silent = robot.mode == Mode.IDLE or has_other_publisher(robot)
        for joint in joints[row]:
            joint.sent = np.nan if is_silent else joint.command


@compiled
def has_other_publisher(robot: Record) -> bool:
    """Return whether the robot was stopped because another program commands it: nothing is sent then."""
    return robot.stopped_by & Fault.OTHER_PUBLISHER.value != 0


@compiled
def is_measured(robot: Record) -> bool:
    """Return whether the positions of all joints are recent and plausible."""
    return robot.faults & _NOT_MEASURED == 0


@compiled
def read_inputs(
    robot: Record, joints: Records, inputs: Record, joint_inputs: Records, limits: Limits
) -> None:
    """Find the faults of this tick, and update joint positions and estimates."""
    is_commanded = is_active(robot) and robot.ticks > 0
    robot.faults = robot_faults(robot.now, inputs, limits.robot)
    robot.faults |= joint_faults(joints, joint_inputs, inputs.now, is_commanded, limits.joints)
    is_finite, is_far = True, False
    for number in range(len(joints)):
        joint, measured, target = joints[number], joint_inputs[number], joint_inputs[number].joint_pos_target
        joint.joint_pos = measured.joint_pos if np.isfinite(measured.joint_pos) else joint.command
        is_finite &= np.isfinite(target)
        is_far |= abs(target - joint.hold) > limits.joints[number].start_distance
    robot.policy_faults = policy_faults(inputs, is_finite, limits.robot)
    robot.policy_faults |= bit(Fault.TARGET_FAR, robot.mode == Mode.ARMED and is_far)


@compiled
def update_mode(robot: Record, joints: Records, recent: np.ndarray, inputs: Record, limits: Limits) -> None:
    """Change the mode, and grant or refuse a request to arm."""
    is_requested, robot.refused = False, 0
    is_new = inputs.arm_stamp > robot.arm_stamp
    if is_new and is_recent(inputs.now, inputs.arm_stamp, limits.robot.operator_age):
        robot.arm_stamp, is_requested = inputs.arm_stamp, not is_active(robot)
    is_free = robot.mode == Mode.IDLE or has_other_publisher(robot)
    if is_requested:
        robot.refused = refusals(robot, joints, is_free, inputs.pressed_stamp, limits)
    stop = stopping_faults(robot)
    next_mode(robot, joints, stop, limits)
    robot.is_returning = (stop != 0 or robot.is_returning) and is_measured(robot)
    robot.now = inputs.now
    if stop != 0:
        robot.stopped_by = stop
        if inputs.pressed_stamp > robot.used_press:
            robot.used_press = inputs.pressed_stamp
        for joint in joints:
            joint.hold, joint.lead = joint.command, joint.command - joint.joint_pos
    elif robot.mode != Mode.STOPPED:
        robot.stopped_by = 0
    if is_requested and robot.refused == 0:
        arm(robot, joints, recent, is_free, limits)


@compiled
def stopping_faults(robot: Record) -> int:
    """Return the faults that stop the robot; armed, those of a policy count once it sends targets."""
    found = robot.policy_faults if is_driven(robot) else 0
    if robot.mode == Mode.ARMED and robot.policy_faults & Fault.POLICY_LATE.value == 0:
        found = robot.policy_faults & _BAD_TARGET
    return robot.faults | found if is_active(robot) else 0


@compiled
def next_mode(robot: Record, joints: Records, stop: int, limits: Limits) -> None:
    """Change to the mode of this tick, by the faults that stop the robot."""
    mode, time = robot.mode, robot.ticks * limits.robot.dt
    if stop != 0:
        mode = Mode.STOPPED.value
    elif mode == Mode.ARMED and robot.policy_faults == 0:
        mode = Mode.RAMP.value
    elif mode == Mode.RAMP and time >= limits.robot.ramp_time:
        mode = Mode.RUN.value
    elif mode == Mode.STOPPED and time >= STOP_TIME and was_moved(robot, joints, limits):
        mode = Mode.IDLE.value
    robot.ticks = robot.ticks + 1 if mode == robot.mode else 0
    robot.mode = mode


@compiled
def was_moved(robot: Record, joints: Records, limits: Limits) -> bool:
    """Return whether somebody moved the stopped robot."""
    is_away = False
    for number in range(len(joints)):
        distance = abs(joints[number].joint_pos - joints[number].command)
        is_away |= distance > limits.joints[number].moved_error
    return is_away and is_measured(robot)


@compiled
def first_command(joint: Record, is_free: bool, limit: Record) -> float:
    """Return the command of a joint on arming: its position if it is free, else its last command [rad]."""
    return clipped(joint.joint_pos, limit.lower, limit.upper) if is_free else joint.command


@compiled
def refusals(robot: Record, joints: Records, is_free: bool, pressed_stamp: float, limits: Limits) -> int:
    """Return the faults that make arming impossible."""
    carriers, is_off = np.empty(len(limits.space.columns)), False
    for number in range(len(joints)):
        first = first_command(joints[number], is_free, limits.joints[number])
        is_off |= abs(joints[number].joint_pos - first) > limits.joints[number].start_error
    for place, number in enumerate(limits.space.columns):
        carriers[place] = first_command(joints[number], is_free, limits.joints[number])
    is_stopping = robot.mode == Mode.STOPPED and robot.ticks * limits.robot.dt < STOP_TIME
    return (
        robot.faults
        | bit(Fault.START_POSE, is_off)
        | bit(Fault.WORKSPACE, not is_inside(limits.space, carriers))
        | bit(Fault.STILL_STOPPING, is_stopping)
        | bit(Fault.SWITCH_NOT_PRESSED, not pressed_stamp > robot.used_press)
    )


@compiled
def arm(robot: Record, joints: Records, recent: np.ndarray, is_free: bool, limits: Limits) -> None:
    """Arm the robot, at rest at its first command."""
    robot.mode, robot.ticks, robot.stopped_by = Mode.ARMED.value, 0, 0
    robot.target_stamp = -np.inf
    for number in range(len(joints)):
        joint = joints[number]
        first = first_command(joint, is_free, limits.joints[number])
        joint.position, joint.velocity, joint.command, joint.hold = first, 0.0, first, first
        joint.start, joint.end, joint.expected = first, first, joint.joint_pos
        recent[number, :] = first


@compiled
def read_target(
    robot: Record, joints: Records, inputs: Record, joint_inputs: Records, limits: Limits
) -> None:
    """Begin the motion to a newer target."""
    robot.clamped = 0
    if not is_driven(robot):
        return
    is_new, elapsed = inputs.target_stamp > robot.target_stamp, robot.now - robot.target_begun
    for number in range(len(joints)):
        joint, limit, target = joints[number], limits.joints[number], joint_inputs[number].joint_pos_target
        allowed = clipped(target, limit.lower, limit.upper)
        robot.clamped |= bit(Clamp.POSITION, abs(allowed - target) > ROUNDING)
        if is_new:
            joint.start = interpolated(joint.start, joint.end, elapsed, limit.control_dt)
            joint.end = allowed
    if is_new:
        robot.target_begun, robot.target_stamp = robot.now, inputs.target_stamp


@compiled
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
