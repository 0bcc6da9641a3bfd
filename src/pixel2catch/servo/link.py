"""The link between the control loop and the servo process: two ends of a socket that keeps packets whole.

Neither side ever waits for the other: what does not fit into the socket is dropped and counted. When a
process ends, however it does, the other end is told so.
"""

import socket
from dataclasses import dataclass
from typing import Any, Generic, TypeVar, final

import numpy as np
from jaxtyping import Float64

from pixel2catch.servo.limits import Joints

BUFFER_SIZE = 1 << 20  #: Memory asked for each way [bytes]; Linux gives what its limit allows. Source: ours.
_LONGEST = 4096  #: More than any packet has [bytes].

_FLAGS = socket.MSG_DONTWAIT | socket.MSG_NOSIGNAL

Row = Float64[np.ndarray, " size"]


@dataclass(frozen=True, kw_only=True, eq=False)
class JointTargets:
    """What the policy asks of the servo; a row has the fields in their order."""

    target_stamp: float  #: Time of the decision, `Clock.now` [s].
    image_stamp: float  #: Exposure time of the newest image, `Clock.now` [s].
    box_stamp: float  #: Exposure time of the newest image in which the object was found, `Clock.now` [s].
    is_perception_sound: bool = True  #: Whether images and boxes are plausible.
    is_stop_requested: bool = False  #: Whether the servo must stop the robot.
    joint_pos_target: Joints  #: Target of each joint, in joint order [rad].

    @classmethod
    def none(cls, num_joints: int) -> "JointTargets":
        """Return the targets before the first decision: NaN, infinitely old."""
        unknown = np.full(num_joints, np.nan)
        return cls(joint_pos_target=unknown, target_stamp=-np.inf, image_stamp=-np.inf, box_stamp=-np.inf)

    @classmethod
    def of(cls, row: Row) -> "JointTargets":
        """Read a row."""
        values = (*row[:3].tolist(), *(row[3:5] != 0.0).tolist(), row[5:])
        by_name: dict[str, Any] = dict(zip(cls.__annotations__, values, strict=True))
        return cls(**by_name)

    @property
    def row(self) -> Row:
        """Write a row."""
        *numbers, joint_pos_target = vars(self).values()
        return np.concatenate((numbers, joint_pos_target))


@dataclass(frozen=True, kw_only=True, eq=False)
class Command:
    """What the servo commands in one tick, and why; a row has the fields in their order.

    Drivers receive the positions, control loop and recordings receive all of it.
    """

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

    @classmethod
    def of(cls, row: Row) -> "Command":
        """Read a row."""
        values = (*row[:4].tolist(), *map(int, row[4:9].tolist()), *row[9:].reshape(2, -1))
        by_name: dict[str, Any] = dict(zip(cls.__annotations__, values, strict=True))
        return cls(**by_name)

    @property
    def row(self) -> Row:
        """Write a row."""
        *numbers, joint_pos_command, joint_pos = vars(self).values()
        return np.concatenate((numbers, joint_pos_command, joint_pos))


Sent = TypeVar("Sent", JointTargets, Command)
Received = TypeVar("Received", JointTargets, Command)


@final
class LinkEnd(Generic[Sent, Received]):
    """One end; it can be given to a process that is being started."""

    def __init__(self, end: socket.socket, received: type[Received]) -> None:
        """Take over a socket."""
        end.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, BUFFER_SIZE)
        self._socket, self._received = end, received
        self.num_dropped = 0  #: Packets that did not fit, or that nobody was left to receive.
        self.is_closed = False  #: Whether one of the ends is gone.

    def send(self, message: Sent) -> None:
        """Send, if there is room and somebody to receive it."""
        try:
            self._socket.send(message.row.tobytes(), _FLAGS)
        except (BlockingIOError, BrokenPipeError, ConnectionResetError):
            self.num_dropped += 1

    def receive(self) -> list[Received]:
        """What has arrived since the last call, oldest first."""
        messages: list[Received] = []
        while not self.is_closed:
            try:
                data = self._socket.recv(_LONGEST, _FLAGS)
            except BlockingIOError:
                break
            except ConnectionResetError:
                data = b""
            if data:
                messages.append(self._received.of(np.frombuffer(data)))
            self.is_closed = not data
        return messages

    def close(self) -> None:
        """Leave; the other end is told."""
        self.is_closed = True
        self._socket.close()


LoopEnd = LinkEnd[JointTargets, Command]
ServoEnd = LinkEnd[Command, JointTargets]


def link() -> tuple[LoopEnd, ServoEnd]:
    """The two ends of a new link."""
    loop, servo = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    return LinkEnd(loop, Command), LinkEnd(servo, JointTargets)
