"""The servo between policy and robot as a state machine: one tick every 2 ms, no clock, no transport.

    idle ──arm──► armed ──first target──► ramp ──1 s──► run
                  ▲   │                    │             │
                 arm  └──────fault─────────┴────fault────┘
                  │   ▼
                 stopped ──moved by somebody else──► idle

Armed, it holds the pose. In the ramp it goes over to the policy's targets, in the run it follows them: as in
training, a command moves evenly from where it is to the newest target, which it reaches after a control step.
A fault stops: evenly the commands give up their lead of the joints, which slows these down evenly whatever
their lag is, and within `STOP_TIME` they stand still. Where joints are not measured the commands slow down as
evenly. It takes a new request to arm for the robot to move again; where somebody else moves the stopped
robot, nothing is sent any more. Whatever the servo is told, no command passes a limit.

Rows are independent robots: one in the laboratory, thousands in tests.
"""

from dataclasses import dataclass, fields

import numpy as np
from jaxtyping import Bool, Float64, Int64

from pixel2catch.errors import DeploymentError
from pixel2catch.installation import needs_extra
from pixel2catch.servo.limits import ServoLimits

Rows = Float64[np.ndarray, "rows joints"]
Times = Float64[np.ndarray, " rows"]
Flags = Bool[np.ndarray, " rows"]
Bits = Int64[np.ndarray, " rows"]

ROBOT_STATE = np.dtype(
    [
        ("mode", np.int64),  # a `Mode`
        ("ticks", np.int64),  # ticks since the mode began
        ("stopped_by", np.int64),  # the `Fault` bits that it was stopped by; none in other modes
        ("wrong", np.int64),  # `Fault` bits of robot, operator and clock that were found in the last tick
        ("wrong_policy", np.int64),  # likewise of what the policy sees and says
        ("refused", np.int64),  # `Fault` bits for which a request to arm was refused in it
        ("clamped", np.int64),  # `Clamp` bits: what held the command back in it
        ("now", np.float64),  # time of that tick [s]
        ("arm_stamp", np.float64),  # stamp of the last request to arm that was heeded, granted or not [s]
        ("used_press", np.float64),  # when the switch was pressed that was held at the last stop [s]
        ("begun", np.float64),  # when the motion to the newest target began [s]
        ("target_stamp", np.float64),  # stamp of that target [s]
        ("is_returning", np.bool_),  # whether the joints have been measured since the last stop
    ],
    align=True,
)
"""What is known of a robot."""

JOINT_STATE = np.dtype(
    [
        ("position", np.float64),  # where the motion is of which commands are means [rad]
        ("velocity", np.float64),  # speed of the tick that led there [rad/s]
        ("command", np.float64),  # the command [rad]
        ("hold", np.float64),  # the command when the mode last changed to armed or stopped [rad]
        ("lead", np.float64),  # how far it was ahead of the joint at the last stop [rad]
        ("start", np.float64),  # where the motion to the newest target began [rad]
        ("end", np.float64),  # that target [rad]
        ("expected", np.float64),  # where the joint should be, by the lag of its servo [rad]
        ("joint_pos", np.float64),  # measured position; the command where there is no number [rad]
        ("measured", np.float64),  # newest position that was a number [rad]
        ("stamp", np.float64),  # when it was measured [s]
        ("speed", np.float64),  # estimated speed [rad/s]
        ("explained", np.float64),  # position nearest to it to which the commands may have led, or
        # something stopped [rad]
        ("slack", np.float64),  # how far behind its command it may still be, by the motion of late [rad]
        ("anchor", np.float64),  # where the command was when the measurement last changed [rad]
        ("still_time", np.float64),  # how long that has not changed, though the command has moved [s]
        ("ahead", np.float64),  # how far the command is ahead, in the mean of the time of the speed [rad]
        ("seen_lag", np.float64),  # how much that is for its speed, by its motion of late [s]
        ("evidence", np.float64),  # how much motion that is known of [rad²/s]
        ("lag", np.float64),  # how long it is behind its command: as told, or as seen as soon as it is [s]
        ("is_lag_seen", np.bool_),  # whether it, of an arm, has moved enough for its lag to be known by that
    ],
    align=True,
)
"""What is known of a joint."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ServoInputs:
    """What the servo is told in a tick, one row per robot, joints in joint order."""

    now: Times  #: Time of this tick [s].
    joint_pos: Rows  #: Newest measured joint positions [rad].
    joint_stamp: Rows  #: When each was measured [s].
    joint_pos_target: Rows  #: Newest targets of the policy [rad].
    target_stamp: Times  #: When they were decided [s].
    image_stamp: Times  #: When the newest image was taken [s].
    box_stamp: Times  #: When the newest image was taken in which the object was seen [s].
    is_perception_sound: Flags  #: Whether what perception says can be true.
    dead_man_stamp: Times  #: When the operator last held the dead-man switch [s].
    #: When the switch was last pressed after it had been let go, or silent for too long [s].
    pressed_stamp: Times
    arm_stamp: Times  #: When the operator last asked to arm [s].
    is_stop_requested: Flags  #: Whether the operator, or anything else, asks to stop.
    is_safe: Flags  #: Whether the robot's program runs in its normal safety mode.
    speed_scaling: Times  #: Share of the full speed at which the robot runs its program; 1 is full.
    is_status_known: Flags  #: Whether the drivers have said all that is watched of them, and it holds.
    has_controller: Flags  #: Whether the controllers that take our commands are active.
    has_other_publisher: Flags  #: Whether anybody else sends commands to the robot.
    has_other_operator: Flags  #: Whether several hold the switch, or ask to arm.
    has_subscriber: Flags  #: Whether somebody takes the commands of each driver.
    has_other_subscriber: Flags  #: Whether several take the commands of one.


ROBOT_INPUT, JOINT_INPUT = (
    np.dtype(
        [
            (entry.name, np.bool_ if entry.type is Flags else np.float64)
            for entry in fields(ServoInputs)
            if (entry.type is Rows) == is_of_joints
        ],
        align=True,
    )
    for is_of_joints in (False, True)
)
"""What is told of a robot, and of a joint."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ServoState:
    """The state of every row."""

    robots: np.ndarray  #: A `ROBOT_STATE` of each row.
    joints: np.ndarray  #: A `JOINT_STATE` of each joint (rows, joints).
    #: Newest positions of the motion of which commands are means, oldest first [rad].
    recent: Float64[np.ndarray, "rows joints ticks"]

    @classmethod
    def idle(cls, num_rows: int, limits: ServoLimits) -> "ServoState":
        """The state in which everything begins."""
        robots, joints = np.zeros(num_rows, ROBOT_STATE), np.zeros((num_rows, limits.num_joints), JOINT_STATE)
        robots["now"] = joints["measured"] = joints["stamp"] = np.nan
        for name in ("arm_stamp", "used_press", "target_stamp"):
            robots[name] = -np.inf
        recent = np.zeros((*joints.shape, limits.motion.window.max()))
        return cls(robots=robots, joints=joints, recent=recent)


@dataclass(frozen=True, kw_only=True, eq=False)
class Output:
    """What the servo says in a tick."""

    #: Commands for the robot [rad]; NaN where nothing is to be sent: while idle, and after a stop because
    #: somebody else commands the robot, whom it must not fight.
    command: Rows
    mode: Bits  #: A `Mode`.
    stopped_by: Bits  #: `Fault` bits that a stop is for.
    found: Bits  #: `Fault` bits found in this tick, be the robot armed or not.
    refused: Bits  #: `Fault` bits for which a request to arm was refused in this tick.
    clamped: Bits  #: `Clamp` bits: what held the command back in this tick.


class ServoCore:
    """The state machine under some limits.

    Example:
        core = ServoCore(limits)
        state = ServoState.idle(1, limits)
        state, output = core.tick(state, inputs)  # every 2 ms
    """

    def __init__(self, limits: ServoLimits) -> None:
        """Keep to limits; compile the tick, if that has not been done on this machine, in some seconds.

        Raises:
            DeploymentError: The compiler is missing.
        """
        with needs_extra("deployment", error=DeploymentError):
            from pixel2catch.servo.tick import Limits, tick_all
        self.limits = limits
        self._tick_all = tick_all
        self._kept_to = Limits(limits.robot_records, limits.joint_records, limits.workspace.space)
        idle = ServoState.idle(1, limits)
        told = np.zeros(1, ROBOT_INPUT), np.zeros(idle.joints.shape, JOINT_INPUT)
        tick_all(self._kept_to, idle.robots, idle.joints, idle.recent, *told, np.empty(idle.joints.shape))
        tick_all.disable_compile()

    def tick(self, state: ServoState, inputs: ServoInputs) -> tuple[ServoState, Output]:
        """Decide on the commands of this tick; one that is late must not be made up for by two at once."""
        robots, joints, recent = state.robots.copy(), state.joints.copy(), state.recent.copy()
        told, told_joints = np.empty(robots.shape, ROBOT_INPUT), np.empty(joints.shape, JOINT_INPUT)
        for entries in (told, told_joints):
            for name in entries.dtype.names or ():
                entries[name] = getattr(inputs, name)
        command = np.empty(joints.shape)
        self._tick_all(self._kept_to, robots, joints, recent, told, told_joints, command)
        return ServoState(robots=robots, joints=joints, recent=recent), Output(
            command=command,
            mode=robots["mode"],
            stopped_by=robots["stopped_by"],
            found=robots["wrong"] | robots["wrong_policy"],
            refused=robots["refused"],
            clamped=robots["clamped"],
        )
