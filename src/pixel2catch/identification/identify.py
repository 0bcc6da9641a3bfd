"""From recordings to dynamics: what is fitted, what is held out, and how well the result moves."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from pixel2catch.errors import InvalidValueError, RecordingError, UnknownNameError
from pixel2catch.identification.checks import Check, check_recording
from pixel2catch.identification.fit import Fit, fit_dynamics
from pixel2catch.identification.fit_problem import FitCfg
from pixel2catch.identification.fit_simulation import SETTLING, RecordedMotion
from pixel2catch.identification.fit_start import Start, identified
from pixel2catch.identification.recording import Recording
from pixel2catch.identification.signals import held
from pixel2catch.mdp.dynamics_file import DynamicsFile

NO_HOLD_OUT = "none"
"""What is held out if everything is to be fitted."""

Positions = Float[np.ndarray, "num_settled num_joints"]


@dataclass(frozen=True, kw_only=True)
class CheckedRecording:
    """A recording and what its checks found.

    Attributes:
        recording: The motion.
        checks: The answers.
        is_held_out: Whether it is not fitted, so that it tells how good the fit is.
    """

    recording: Recording
    checks: tuple[Check, ...]
    is_held_out: bool

    def require_integrity(self) -> None:
        """Refuse a recording of what did not happen.

        Raises:
            RecordingError: If a check forbids to fit it.
        """
        faults = [check for check in self.checks if check.forbids_fit]
        if faults:
            texts = [
                f"- {' of '.join(filter(None, (fault.name, fault.joint)))}: {fault.detail}"
                for fault in faults
            ]
            raise RecordingError("\n".join([f"{self.recording.name} cannot be used:", *texts]))


@dataclass(frozen=True, kw_only=True)
class Motion:
    """A recording beside its simulation.

    Attributes:
        source: The recording.
        before: Simulated positions under the dynamics before the fit, at the measurements compared [rad].
        after: And under the fitted ones.
    """

    source: CheckedRecording
    before: Positions
    after: Positions

    @property
    def recording(self) -> Recording:
        """What was recorded."""
        return self.source.recording

    @property
    def time(self) -> Float[np.ndarray, " num_settled"]:
        """Times of the measurements compared [s]."""
        return self.recording.t_meas[-len(self.after) :]

    @property
    def measured(self) -> Positions:
        """Their positions [rad]."""
        return self.recording.q[-len(self.after) :]

    @property
    def command(self) -> Positions:
        """The commands that held then [rad]."""
        return held(self.recording, self.time)


@dataclass(frozen=True, kw_only=True)
class Identification:
    """A fit with what a reader needs to judge it.

    Attributes:
        start: What was known before.
        fit: What was fitted, and how well it is known.
        file: The result as training takes it, with the ranges in which it randomises the gains.
        motions: The recordings.
        physics_dt: Time step of the simulation [s].
    """

    start: Start
    fit: Fit
    file: DynamicsFile
    motions: tuple[Motion, ...]
    physics_dt: float

    def of(self, is_held_out: bool) -> tuple[Motion, ...]:
        """The motions that were held out, or those that were fitted."""
        return tuple(motion for motion in self.motions if motion.source.is_held_out == is_held_out)


def checked(recordings: Sequence[Recording], hold_out: str | None) -> list[CheckedRecording]:
    """Check recordings, and choose which one judges the fit.

    Args:
        recordings: All of them.
        hold_out: File name of the one, with or without its folder and ending; or its number, from 1; or
            `none`. If absent, it is the last of several.

    Raises:
        UnknownNameError: If there is no such recording.
        InvalidValueError: If one is given twice, the name is that of several, or nothing is left to fit.
    """
    paths = [Path(recording.name) for recording in recordings]
    twice = sorted({str(path) for path in paths if paths.count(path) > 1})
    if twice:
        raise InvalidValueError(f"{', '.join(twice)} is given twice; give every recording once.")
    is_held_out = _held_out(paths, hold_out)
    return [
        CheckedRecording(
            recording=recording, checks=tuple(check_recording(recording)), is_held_out=bool(is_out)
        )
        for recording, is_out in zip(recordings, is_held_out, strict=True)
    ]


def _held_out(paths: Sequence[Path], hold_out: str | None) -> Bool[np.ndarray, " num_recordings"]:
    """Which of the recordings are held out."""
    numbers = np.arange(1, len(paths) + 1)
    if hold_out is None or hold_out == NO_HOLD_OUT:
        return (numbers == len(paths)) & (len(paths) > 1) & (hold_out is None)
    chosen = np.array([hold_out in (str(path), path.name, path.stem) for path in paths])
    if not chosen.any() and hold_out.isdecimal():
        chosen = numbers == int(hold_out)
    if not chosen.any():
        valid = [*(path.name for path in paths), f"1 to {len(paths)}", NO_HOLD_OUT]
        raise UnknownNameError("recording to hold out", hold_out, valid)
    if chosen.sum() > 1:
        raise InvalidValueError(f"{hold_out} is the name of several recordings; hold one out by its number.")
    if chosen.all():
        raise InvalidValueError(
            f"{hold_out} is the only recording, nothing is left to fit; give another one."
        )
    return chosen


def identify(
    sources: Sequence[CheckedRecording], start: Start, cfg: FitCfg, report: Callable[[str], None]
) -> Identification:
    """Fit the recordings that are not held out, and simulate all of them before and after.

    Args:
        sources: The recordings.
        start: What is known before.
        cfg: How to fit.
        report: Told what is done, before it is.

    Raises:
        RecordingError: A recording is not sound, or too short.
        InvalidValueError: The start has no filter where one is to be fitted.
    """
    for source in sources:
        source.require_integrity()
    recordings = [source.recording for source in sources]
    motion = RecordedMotion(recordings, cfg.physics_dt)
    report(f"fitting {', '.join(cfg.free)} of {len(start.first.joints)} joints")
    fitted = [source.recording for source in sources if not source.is_held_out]
    fit = fit_dynamics(fitted, start.first, cfg, report)
    report("simulating all recordings before and after")
    lengths = [np.count_nonzero(each.t_meas - each.t_meas[0] > SETTLING) for each in recordings]
    paths = [
        np.split(path, np.cumsum(lengths)[:-1]) for path in motion.simulate([start.before, fit.dynamics])
    ]
    return Identification(
        start=start,
        fit=fit,
        file=identified(fit, start),
        motions=tuple(
            Motion(source=source, before=before, after=after)
            for source, before, after in zip(sources, *paths, strict=True)
        ),
        physics_dt=cfg.physics_dt,
    )


def tracking_errors(motions: Sequence[Motion]) -> dict[str, Float[np.ndarray, " num_joints"]]:
    """Root mean square of predicted minus measured positions of all motions together, per joint [rad].

    Args:
        motions: At least one.

    Returns:
        By prediction: the `command`, as if the joint were there at once, and the simulation `before` and
        `after` the fit.
    """
    errors = {
        name: np.concatenate([getattr(motion, name) - motion.measured for motion in motions])
        for name in ("command", "before", "after")
    }
    return {name: np.sqrt(np.mean(error**2, axis=0)) for name, error in errors.items()}
