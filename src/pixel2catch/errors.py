"""What the package raises for bad input: each message names the value, what is valid, and the fix."""

from collections.abc import Iterable
from difflib import get_close_matches

LONGEST_NAME = 200  #: Characters of a name that a message repeats: enough for a path.


class Pixel2CatchError(Exception):
    """Base class of all errors that a user can cause and mend."""


class UnknownNameError(Pixel2CatchError):
    """A name that is in no catalogue.

    Args:
        kind: What was looked up, such as "object" or "method".
        name: The name that was given.
        valid: The names that exist.
        other: What is valid besides.
    """

    def __init__(self, kind: str, name: str, valid: Iterable[str], other: str = "") -> None:
        """Compose the message from the closest and from all valid names."""
        names = list(valid)
        name = name if len(name) <= LONGEST_NAME else f"{name[:LONGEST_NAME]} ..."
        close = get_close_matches(name, names, n=1)
        hint = f" Did you mean '{close[0]}'?" if close else ""
        all_valid = ", ".join([*names, other] if other else names)
        super().__init__(f"unknown {kind} '{name}'.{hint} Valid: {all_valid}.")


class InvalidValueError(Pixel2CatchError, ValueError):
    """A value outside its valid range."""


class DeviceUnavailableError(Pixel2CatchError):
    """A device was asked for that this machine does not have."""


class PolicyMismatchError(Pixel2CatchError):
    """A policy file that does not fit this code, method or robot."""


class NonFiniteError(Pixel2CatchError):
    """A NaN or infinity appeared; the message names the quantity."""


class CheckpointError(Pixel2CatchError):
    """A run folder or checkpoint that cannot be written, read or resumed."""


class WorkerError(Pixel2CatchError):
    """Another process of a training that runs in several failed; the message is that of its error."""


class StudyError(Pixel2CatchError):
    """A study that cannot go on, or a part of it that failed."""


class RecordingError(Pixel2CatchError):
    """Recorded motion that cannot be read, or that no robot can have done; the message says where."""


class PerceptionError(Pixel2CatchError):
    """Images, prompts or models of the perception that cannot be used."""


class DeploymentError(Pixel2CatchError):
    """A robot, profile, message or network that the deployment cannot work with."""
