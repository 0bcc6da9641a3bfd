"""Errors for bad input. Each message names the value, what is valid, and the fix."""

from collections.abc import Iterable
from difflib import get_close_matches

LONGEST_NAME = 200  #: Most characters of a name that a message repeats.


class Pixel2CatchError(Exception):
    """Base class of all errors that a user can cause and fix."""


class UnknownNameError(Pixel2CatchError):
    """A name of a kind, such as "method", that is not among the valid names."""

    def __init__(self, kind: str, name: str, valid: Iterable[str]) -> None:
        names = list(valid)
        name = name if len(name) <= LONGEST_NAME else f"{name[:LONGEST_NAME]} ..."
        close = get_close_matches(name, names, n=1)
        hint = f" Did you mean '{close[0]}'?" if close else ""
        super().__init__(f"unknown {kind} '{name}'.{hint} Valid: {', '.join(names)}.")


class InvalidValueError(Pixel2CatchError, ValueError):
    """A value outside its valid range."""


class DeviceUnavailableError(Pixel2CatchError):
    """This machine lacks a requested device or package."""


class PolicyMismatchError(Pixel2CatchError):
    """A policy does not fit this code, method or robot."""


class NonFiniteError(Pixel2CatchError):
    """A NaN or infinity appeared; the message names the quantity."""


class CheckpointError(Pixel2CatchError):
    """A run folder or checkpoint cannot be written, read or resumed."""


class WorkerError(Pixel2CatchError):
    """Another process of a training failed; the message is that of its error."""


class StudyError(Pixel2CatchError):
    """A study cannot continue, or a part of it failed."""


class RecordingError(Pixel2CatchError):
    """Recorded motion cannot be read or is physically impossible; the message says where."""


class PerceptionError(Pixel2CatchError):
    """Perception cannot use an image, a prompt or a model."""


class DeploymentError(Pixel2CatchError):
    """Deployment cannot use a robot, profile, message or network."""
