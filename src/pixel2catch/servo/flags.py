"""What the servo says in numbers: its mode, what is wrong, and what held a command back."""

from enum import IntEnum, IntFlag, auto


class Mode(IntEnum):
    """What the servo is doing."""

    IDLE = 0
    ARMED = 1
    RAMP = 2
    RUN = 3
    STOPPED = 4


class Clamp(IntFlag):
    """What kept a command from where the policy wants it."""

    POSITION = 1
    LEAD = 2
    SPEED = 4
    ACCELERATION = 8
    WORKSPACE = 16


class Fault(IntFlag):
    """What stops the robot, or keeps it from being armed; recordings have the numbers: append."""

    CLOCK = auto()
    JOINTS_STALE = auto()
    JOINTS_NOT_FINITE = auto()
    IMAGE_STALE = auto()
    POLICY_LATE = auto()
    TARGET_NOT_FINITE = auto()
    TARGET_FAR = auto()
    TRACKING_ERROR = auto()
    SAFETY_MODE = auto()
    SPEED_SCALING = auto()
    OTHER_PUBLISHER = auto()
    DEAD_MAN = auto()
    STOP_REQUEST = auto()
    START_POSE = auto()
    WORKSPACE = auto()
    STILL_STOPPING = auto()
    JOINTS_IMPLAUSIBLE = auto()
    JOINT_SPEED = auto()
    OTHER_OPERATOR = auto()
    SWITCH_NOT_PRESSED = auto()
    OBJECT_LOST = auto()
    PERCEPTION_UNSOUND = auto()
    STATUS_UNKNOWN = auto()
    NO_SUBSCRIBER = auto()
    OTHER_SUBSCRIBER = auto()
    CONTROLLER = auto()
    JOINTS_FROZEN = auto()


def flag_names(kind: type[IntFlag], found: int) -> list[str]:
    """The flags that are set, in words, such as "image stale"."""
    return [str(flag.name).lower().replace("_", " ") for flag in kind if flag & found] if found else []
