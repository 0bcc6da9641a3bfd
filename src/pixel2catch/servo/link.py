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
class PolicyCommand:
    """What the control loop tells the servo; a row has the fields in their order."""

    target_stamp: float  #: When the targets were decided, `Clock.now` [s].
    image_stamp: float  #: When the newest image was taken, `Clock.now` [s].
    box_stamp: float  #: When the newest image was taken in which the object was seen, `Clock.now` [s].
    is_perception_sound: bool = True  #: Whether what perception says can be true.
    is_stop_requested: bool = False  #: Whether the control loop asks to stop.
    joint_pos_target: Joints  #: Targets of the policy in joint order [rad].

    @classmethod
    def none(cls, num_joints: int) -> "PolicyCommand":
        """What holds before anything was commanded."""
        unknown = np.full(num_joints, np.nan)
        return cls(joint_pos_target=unknown, target_stamp=-np.inf, image_stamp=-np.inf, box_stamp=-np.inf)

    @classmethod
    def of(cls, row: Row) -> "PolicyCommand":
        """Read it."""
        values = (*row[:3].tolist(), *(row[3:5] != 0.0).tolist(), row[5:])
        by_name: dict[str, Any] = dict(zip(cls.__annotations__, values, strict=True))
        return cls(**by_name)

    @property
    def row(self) -> Row:
        """Write it."""
        *numbers, joint_pos_target = vars(self).values()
        return np.concatenate((numbers, joint_pos_target))


@dataclass(frozen=True, kw_only=True, eq=False)
class ServoStatus:
    """What the servo tells the control loop in every tick; a row has the fields in their order."""

    time: float  #: When it was decided, `Clock.now` [s].
    duration: float  #: How long the tick took [s], in real time.
    target_stamp: float  #: When the newest targets were decided, `Clock.now` [s].
    image_stamp: float  #: When their image was taken, `Clock.now` [s].
    mode: int  #: A `Mode`.
    stopped_by: int  #: `Fault` bits that a stop is for.
    found: int  #: `Fault` bits found in this tick.
    refused: int  #: `Fault` bits for which a request to arm was refused in this tick.
    clamped: int  #: `Clamp` bits.
    command: Joints  #: Commands in joint order [rad]; NaN while nothing is sent.
    joint_pos: Joints  #: Newest measured joint positions [rad].

    @classmethod
    def of(cls, row: Row) -> "ServoStatus":
        """Read it."""
        values = (*row[:4].tolist(), *map(int, row[4:9].tolist()), *row[9:].reshape(2, -1))
        by_name: dict[str, Any] = dict(zip(cls.__annotations__, values, strict=True))
        return cls(**by_name)

    @property
    def row(self) -> Row:
        """Write it."""
        *numbers, command, joint_pos = vars(self).values()
        return np.concatenate((numbers, command, joint_pos))


Sent = TypeVar("Sent", PolicyCommand, ServoStatus)
Received = TypeVar("Received", PolicyCommand, ServoStatus)


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


LoopEnd = LinkEnd[PolicyCommand, ServoStatus]
ServoEnd = LinkEnd[ServoStatus, PolicyCommand]


def link() -> tuple[LoopEnd, ServoEnd]:
    """The two ends of a new link."""
    loop, servo = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    return LinkEnd(loop, ServoStatus), LinkEnd(servo, PolicyCommand)
