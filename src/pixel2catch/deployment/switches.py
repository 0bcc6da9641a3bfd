"""The operator's switches: a pedal, a gamepad or a keyboard, as Linux tells of its keys."""

import errno
import os
import struct
from collections.abc import Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import final

from pixel2catch.errors import DeploymentError

EVENT = struct.Struct("@llHHi")
"""Seconds, microseconds, type, code and value of an event. Source: Linux, `struct input_event`."""

SYNC, KEY = 0, 1  #: Types of events. Source: Linux, `EV_SYN` and `EV_KEY`.
DROPPED = 3  #: Code of a `SYNC` after which events are missing. Source: Linux, `SYN_DROPPED`.
MOST_EVENTS = 64  #: Events that are read at once.
DEVICES = Path("/dev/input/by-id")  #: Where input devices have names that stay.


@dataclass(frozen=True, kw_only=True)
class Keys:
    """Codes of the keys, of which any one does it."""

    #: Of the dead-man's switch. Default: space bar, first button of a gamepad or joystick.
    hold: tuple[int, ...] = (57, 288, 304)
    arm: tuple[int, ...] = (28, 296, 315)  #: To ask to arm. Default: enter, start button.
    stop: tuple[int, ...] = (1, 289, 305)  #: To ask to stop. Default: escape, second button.


@dataclass(frozen=True, kw_only=True)
class Press:
    """A key that has just been pressed or released."""

    code: int
    is_down: bool


@final
class Switches(AbstractContextManager["Switches"]):
    """The keys of an input device; a device that is gone has none pressed."""

    def __init__(self, device: Path) -> None:
        """Open a device such as /dev/input/by-id/usb-…-event-kbd.

        Raises:
            DeploymentError: It cannot be opened.
        """
        try:
            self._file = os.open(device, os.O_RDONLY | os.O_NONBLOCK)
        except OSError as error:
            raise DeploymentError(
                f"{device} cannot be opened ({error.strerror}); {_advice(error)}"
            ) from error
        self.pressed: set[int] = set()  #: Codes of the keys that are pressed.

    def poll(self) -> list[Press]:
        """What has happened since the last call.

        Raises:
            DeploymentError: The device is gone.
        """
        presses: list[Press] = []
        for kind, code, value in self._events():
            if (kind, code) == (SYNC, DROPPED):
                self.pressed.clear()  # a release may be missing: whoever holds a key must press it again
            elif kind == KEY and value in (0, 1):
                presses.append(Press(code=code, is_down=value == 1))
                (self.pressed.add if value else self.pressed.discard)(code)
        return presses

    def _events(self) -> Iterator[tuple[int, int, int]]:
        """Types, codes and values of the events that wait."""
        try:
            data = os.read(self._file, MOST_EVENTS * EVENT.size)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if not data:
            self.pressed.clear()
            raise DeploymentError(
                "the input device is gone, and with it the dead-man's switch; plug it in again"
            )
        for *_, kind, code, value in EVENT.iter_unpack(data[: len(data) // EVENT.size * EVENT.size]):
            yield kind, code, value

    def __exit__(self, *exception: object) -> None:
        """Close the device."""
        os.close(self._file)


def _advice(error: OSError) -> str:
    if error.errno == errno.EACCES:
        return "become a member of the group 'input', and log in again"
    devices = sorted(map(str, DEVICES.glob("*-event-*")))
    return f"there is {', '.join(devices)}" if devices else "no input device is known by a name"
