"""State and inputs of the servo, one row for each robot, as the compiled tick reads and writes them."""

from dataclasses import dataclass, fields

import numpy as np
from jaxtyping import Bool, Float64

Rows = Float64[np.ndarray, "rows joints"]
Times = Float64[np.ndarray, " rows"]
Flags = Bool[np.ndarray, " rows"]

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
        ("lone_time", np.float64),  # time for which one finger joint alone has been off its position [s]
        ("calm_time", np.float64),  # time for which the fingers have been near their expected positions [s]
        ("free_time", np.float64),  # time for which no object touches the fingers yet [s]
        ("is_returning", np.bool_),  # whether the joints have been measured since the last stop
    ],
    align=True,
)

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
        ("explained", np.float64),  # measured position, clipped to what recent commands can explain [rad]
        ("slack", np.float64),  # distance behind the command that recent motion allows [rad]
        ("anchor", np.float64),  # command when the measurement last changed [rad]
        ("still_time", np.float64),  # time without a change while the command moved [s]
        ("astray_time", np.float64),  # time for which a finger has been off its expected position [s]
        ("ahead", np.float64),  # mean distance of the command ahead of the joint [rad]
        ("estimated_lag", np.float64),  # that distance per speed [s]
        ("evidence", np.float64),  # motion from which it is estimated [rad²/s]
        ("lag", np.float64),  # lag that is used: specified, or estimated once there is evidence [s]
        ("is_lag_estimated", np.bool_),  # whether there is enough evidence; arms only
    ],
    align=True,
)


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
    is_planned: Flags  #: Whether the targets are of a planned motion.
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
