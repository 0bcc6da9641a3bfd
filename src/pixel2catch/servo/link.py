"""Targets and commands between control loop and servo, their socket, and priorities.

Neither side waits for the other: what does not fit into the socket is dropped and counted. Each end detects
that the other process has ended.
"""

import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from enum import IntEnum, IntFlag, auto
from typing import Generic, Self, TypeVar, final

import numpy as np
from jaxtyping import Float64

BUFFER_SIZE = 1 << 20  #: Memory requested for each direction [bytes]; the system may give less. Source: ours.
_LONGEST = 4096  #: Larger than any packet [bytes].
_FLAGS = socket.MSG_DONTWAIT | socket.MSG_NOSIGNAL

SERVO, CONTROL_LOOP = -10, -8  #: Niceness of servo, and of perception and policy. Source: ours.
#: Real-time priorities of servo, of perception and policy, and of the recorder. Source: ours, below drivers'.
SERVO_PRIORITY, LOOP_PRIORITY, RECORDER_PRIORITY = 10, 5, 1

Joints = Float64[np.ndarray, " joints"]


class Mode(IntEnum):
    """Modes of the servo; `tick` has the transitions."""

    IDLE = 0
    ARMED = 1
    RAMP = 2
    RUN = 3
    STOPPED = 4


class Clamp(IntFlag):
    """Limits that changed a command."""

    POSITION = 1
    LEAD = 2
    SPEED = 4
    ACCELERATION = 8
    WORKSPACE = 16


class Fault(IntFlag):
    """Reasons to stop the robot, or not to arm it. Recordings contain the numbers: append only."""

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
    COMMANDS_IGNORED = auto()
    HAND_ASTRAY = auto()


def flag_names(kind: type[IntFlag], found: int) -> list[str]:
    """Return the names of the bits that are set, such as "image stale"."""
    return [str(flag.name).lower().replace("_", " ") for flag in kind if flag & found] if found else []


class Row:
    """A dataclass that is sent and recorded as a row: its numbers, then its arrays, in their order."""

    @classmethod
    def of(cls, row: Float64[np.ndarray, " size"]) -> Self:
        kinds = cls.__annotations__
        num = sum(kind in (bool, int, float) for kind in kinds.values())
        numbers = [kind(value) for kind, value in zip(kinds.values(), row[:num].tolist(), strict=False)]
        arrays = row[num:].reshape(len(kinds) - num, -1)
        return cls(**dict(zip(kinds, [*numbers, *arrays], strict=True)))

    @property
    def row(self) -> Float64[np.ndarray, " size"]:
        return np.hstack([*vars(self).values()])


@dataclass(frozen=True, kw_only=True, eq=False)
class JointTargets(Row):
    """Targets of the policy for the servo."""

    target_stamp: float  #: Time of the decision, `Clock.now` [s].
    image_stamp: float  #: Exposure time of the newest image, `Clock.now` [s].
    box_stamp: float  #: Exposure time of the newest image in which the object was found, `Clock.now` [s].
    is_perception_sound: bool = True  #: Whether images and boxes are plausible.
    is_stop_requested: bool = False  #: Whether the servo must stop the robot.
    is_planned: bool = False  #: Whether the targets are of a planned motion, which uses no image.
    joint_pos_target: Joints  #: Target of each joint, in joint order [rad].

    @classmethod
    def none(cls, num_joints: int) -> "JointTargets":
        """Return the targets before the first decision: NaN, infinitely old."""
        unknown = np.full(num_joints, np.nan)
        return cls(joint_pos_target=unknown, target_stamp=-np.inf, image_stamp=-np.inf, box_stamp=-np.inf)


@dataclass(frozen=True, kw_only=True, eq=False)
class Command(Row):
    """Command and mode of one tick of the servo."""

    time: float  #: Time of the tick, `Clock.now` [s].
    duration: float  #: Computing time of the tick [s].
    target_stamp: float  #: `JointTargets.target_stamp` of the newest targets [s].
    image_stamp: float  #: `JointTargets.image_stamp` of the newest targets [s].
    mode: int  #: A `Mode`.
    stopped_by: int  #: `Fault` bits that caused a stop.
    found: int  #: `Fault` bits found in this tick.
    refused: int  #: `Fault` bits that made the servo refuse to arm in this tick.
    clamped: int  #: `Clamp` bits: limits that changed the command in this tick.
    joint_pos_command: Joints  #: Commanded joint positions in joint order [rad]; NaN while none are sent.
    joint_pos: Joints  #: Newest measured joint positions [rad].


Sent = TypeVar("Sent", JointTargets, Command)
Received = TypeVar("Received", JointTargets, Command)


@final
class LinkEnd(Generic[Sent, Received]):
    """One end of the link; it can be passed to a process that is being started."""

    def __init__(self, end: socket.socket, received: type[Received]) -> None:
        end.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, BUFFER_SIZE)
        self._socket, self._received = end, received
        self.num_dropped = 0  #: Packets that did not fit, or were sent after the other end had closed.
        self.is_closed = False  #: Whether this end or the other one is closed.

    def send(self, message: Sent) -> None:
        """Send a packet, or drop it."""
        try:
            self._socket.send(message.row.tobytes(), _FLAGS)
        except (BlockingIOError, BrokenPipeError, ConnectionResetError):
            self.num_dropped += 1

    def receive(self) -> list[Received]:
        """Return what arrived since the last call, oldest first."""
        messages: list[Received] = []
        with suppress(BlockingIOError):
            while not self.is_closed:
                data = b""
                with suppress(ConnectionResetError):
                    data = self._socket.recv(_LONGEST, _FLAGS)
                self.is_closed = not data
                if data:
                    messages.append(self._received.of(np.frombuffer(data)))
        return messages

    def close(self) -> None:
        """Close this end; the other end detects it."""
        self.is_closed = True
        self._socket.close()


LoopEnd = LinkEnd[JointTargets, Command]
ServoEnd = LinkEnd[Command, JointTargets]


def link() -> tuple[LoopEnd, ServoEnd]:
    """Return the two ends of a new link."""
    loop, servo = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    return LinkEnd(loop, Command), LinkEnd(servo, JointTargets)


def set_niceness(niceness: int) -> None:
    """Set the niceness of this thread and those that it starts, if the system permits it."""
    with suppress(OSError):
        os.setpriority(os.PRIO_PROCESS, 0, niceness)


def set_real_time(priority: int) -> None:
    """Make this thread and those that it starts real-time threads, if the system permits it."""
    with suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))


def give_way(priority: int) -> None:
    """Lower the priority of this thread, if it is a real-time one."""
    if os.sched_getscheduler(0) == os.SCHED_FIFO:
        set_real_time(priority)


@contextmanager
def scheduled(policy: int, priority: int) -> Iterator[bool]:
    """Change the scheduling of this thread in the context; yield whether the system permits it."""
    before, is_granted = (os.sched_getscheduler(0), os.sched_getparam(0)), False
    with suppress(OSError):
        os.sched_setscheduler(0, policy, os.sched_param(priority))
        is_granted = True
    try:
        yield is_granted
    finally:
        with suppress(OSError):
            os.sched_setscheduler(0, *before)
