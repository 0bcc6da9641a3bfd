"""From recordings to a dynamics file: where a fit starts, what is held out, how well the result is known."""

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from pixel2catch.checks import Range
from pixel2catch.errors import InvalidValueError, RecordingError, UnknownNameError
from pixel2catch.identification.checks import Check, check_recording
from pixel2catch.identification.encoders import Encoders
from pixel2catch.identification.fit import LATENCY_UNIT, Fit, FitCfg, fit_dynamics
from pixel2catch.identification.intervals import CONFIDENCE
from pixel2catch.identification.joints import groups_of, joints_of, parts
from pixel2catch.identification.recording import Recording
from pixel2catch.identification.simulation import RecordedMotion
from pixel2catch.mdp.dynamics_file import DynamicsFile, GainRanges
from pixel2catch.robots.joint_dynamics import SERVOJ_GAIN, SERVOJ_LOOKAHEAD, JointDynamics
from pixel2catch.robots.workcell import WorkcellSpec
from pixel2catch.workcells.ur5e_allegro import UR5E_ALLEGRO

STIFF_FACTOR = 10.0
"""Stiffness of the servo behind a command filter over the nominal one. Source: ours; the controller's
feed-forward makes that servo look stiffer than positions can tell."""

STIFF_LAG = 0.003  # damping over stiffness of that servo [s]. Source: real UR5, target to position.
NO_HOLD_OUT = "none"  # what is held out if everything is to be fitted
LAG = "damping / stiffness"  # name of the ratio that says how far a joint lags behind its command

RATIOS = {LAG: "s", "armature / stiffness": "s²", "frictionloss / stiffness": "rad"}
"""The ratios that decide how a joint follows its command, with their units."""

LEAST_HALF_WIDTH = 0.02  # is always left, as a share (ours; gains drift with temperature and load)
PerJoint = Float[np.ndarray, " num_joints"]
Positions = Float[np.ndarray, "num_settled num_joints"]


@dataclass(frozen=True, kw_only=True)
class Start:
    """What is known before a fit."""

    workcell: WorkcellSpec  #: whose joints are fitted
    robot: str  #: what is fitted: one of its parts
    file: DynamicsFile | None  #: the dynamics file that was given, if any
    before: JointDynamics  #: the robot's joints in it; those that are not in it are nominal
    first: JointDynamics  #: the same, with a command filter in front where one is to be fitted


@dataclass(frozen=True, kw_only=True)
class CheckedRecording:
    """A recording and what its checks found."""

    recording: Recording
    checks: tuple[Check, ...]
    is_held_out: bool  #: whether it is not fitted, so that it tells how good the fit is


@dataclass(frozen=True, kw_only=True)
class Motion(CheckedRecording):
    """A recording beside its simulation."""

    before: Positions  #: simulated before the fit, at the measurements compared [rad]
    after: Positions  #: and under the fitted ones

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
        return self.recording.held(self.time)


@dataclass(frozen=True, kw_only=True)
class Identification:
    """A fit with what a reader needs to judge it."""

    start: Start  #: what was known before
    fit: Fit  #: what was fitted, and how well it is known
    file: DynamicsFile  #: the result as training takes it, with the ranges in which it randomises the gains
    motions: tuple[Motion, ...]
    physics_dt: float  #: time step of the simulation [s]

    def of(self, is_held_out: bool) -> tuple[Motion, ...]:
        """The motions that were held out, or those that were fitted."""
        return tuple(motion for motion in self.motions if motion.is_held_out == is_held_out)


def start_of_fit(
    part: str, path: Path | None, fits_filter: bool, workcell: WorkcellSpec = UR5E_ALLEGRO
) -> Start:
    """Read what is known, from a dynamics file if there is one.

    Without a file, the servo behind a filter that is to be fitted is taken to be stiff.

    Raises:
        UnknownNameError: If there is no such part.
        InvalidValueError: If the file cannot be read, or the part has joints without such a filter.
    """
    joints = joints_of(workcell, part)
    if fits_filter:
        _require_arm(part, joints, workcell)
    file = DynamicsFile.load(path, workcell) if path else None
    nominal = JointDynamics.nominal(specs=workcell.joints)
    before = (file.dynamics.over(nominal) if file else nominal).select(joints)
    first = before
    if fits_filter:
        servo = before if file else stiff(before)
        gain = np.where(servo.has_filter, servo.filter_gain, SERVOJ_GAIN)
        lookahead = np.where(servo.has_filter, servo.filter_lookahead, SERVOJ_LOOKAHEAD)
        first = servo.with_values(filter_gain=gain, filter_lookahead=lookahead)
    return Start(workcell=workcell, robot=part, file=file, before=before, first=first)


def _require_arm(part: str, joints: Sequence[str], workcell: WorkcellSpec) -> None:
    """Refuse a part that has joints of hands, whose commands no filter precedes."""
    groups = groups_of(workcell)
    if any(groups[joint].role != "arm" for joint in joints):
        arm, hand = (
            next(name for name, those in parts(workcell).items() if {groups[j].role for j in those} == {role})
            for role in ("arm", "hand")
        )
        raise InvalidValueError(
            f"--filter is an arm's and --robot is {part}; identify --robot {arm} with it, then --robot "
            f"{hand} with the dynamics file of the first as --start: the result has both."
        )


def stiff(nominal: JointDynamics) -> JointDynamics:
    """The servos of a controller whose feed-forward makes them look stiffer than positions can tell."""
    stiffness = STIFF_FACTOR * nominal.stiffness
    return nominal.with_values(stiffness=stiffness, damping=STIFF_LAG * stiffness)


def checked(recordings: Sequence[Recording], hold_out: str | None) -> list[CheckedRecording]:
    """Check recordings, and choose which one judges the fit.

    It is that of a file name, with or without its folder and ending; or of a number, from 1; or `none`; if
    nothing is said, the last of several.

    Raises:
        UnknownNameError: If there is no such recording.
        InvalidValueError: If one is given twice, the name is that of several, or nothing is left to fit.
    """
    paths = [Path(recording.name) for recording in recordings]
    twice = sorted({str(path) for path in paths if paths.count(path) > 1})
    if twice:
        raise InvalidValueError(f"{', '.join(twice)} is given twice; give every recording once.")
    found = []
    for recording, is_out in zip(recordings, _held_out(paths, hold_out), strict=True):
        checks = tuple(check_recording(recording))
        found.append(CheckedRecording(recording=recording, checks=checks, is_held_out=bool(is_out)))
    return found


def _held_out(paths: Sequence[Path], hold_out: str | None) -> Bool[np.ndarray, " num_recordings"]:
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

    Raises:
        RecordingError: A recording is not sound, or too short.
        InvalidValueError: The start has no filter where one is to be fitted.
    """
    for source in sources:
        faults = [check for check in source.checks if check.forbids_fit]
        texts = [f"- {' of '.join(filter(None, (bad.name, bad.joint)))}: {bad.detail}" for bad in faults]
        if texts:
            raise RecordingError("\n".join([f"{source.recording.name} cannot be used:", *texts]))
    motion = RecordedMotion([source.recording for source in sources], cfg.physics_dt)
    report(f"fitting {', '.join(cfg.free)} of {len(start.first.joints)} joints")
    fitted = [source.recording for source in sources if not source.is_held_out]
    fit = fit_dynamics(fitted, start.first, cfg, report)
    report("simulating all recordings before and after")
    is_out = np.array([source.is_held_out for source in sources])
    encoders = Encoders.perfect(len(sources), len(fit.dynamics.joints)), found_encoders(fit, is_out)
    before, after = (motion.split(path) for path in motion.simulate([start.before, fit.dynamics], encoders))
    motions = tuple(
        Motion(**vars(source), before=path_before, after=path_after)
        for source, path_before, path_after in zip(sources, before, after, strict=True)
    )
    file, fitted_joints = identified(fit, start), fit.dynamics.joints
    worse = [name for name in file.worse_than_command if name not in fitted_joints]
    worse += worse_than_command([motion for motion in motions if motion.is_held_out])
    file = dataclasses.replace(file, worse_than_command=tuple(worse))
    return Identification(start=start, fit=fit, file=file, motions=motions, physics_dt=cfg.physics_dt)


def found_encoders(fit: Fit, is_held_out: Bool[np.ndarray, " num_recordings"]) -> Encoders:
    """Encoders of all recordings; where nothing was fitted, the clocks drift as they do in the mean."""
    mean = fit.encoders.drift.mean(axis=0)
    drift = np.tile(mean, (len(is_held_out), 1))
    drift[~is_held_out] = fit.encoders.drift
    return dataclasses.replace(fit.encoders, drift=drift)


def worse_than_command(motions: Sequence[Motion]) -> list[str]:
    """Joints of which the command alone predicts these motions better than the fitted simulation."""
    if not motions:
        return []
    errors = tracking_errors(motions)
    return [motions[0].recording.joints[j] for j in np.flatnonzero(errors["after"] > errors["command"])]


def tracking_errors(motions: Sequence[Motion]) -> dict[str, Float[np.ndarray, " num_joints"]]:
    """Root mean square of predicted minus measured positions of all motions together, per joint [rad].

    Predicted by the `command`, as if the joint were there at once, and by simulation `before` and `after`,
    this one measured by encoders with the play and the drift that were found.
    """
    errors = {
        name: np.concatenate([getattr(motion, name) - motion.measured for motion in motions])
        for name in ("command", "before", "after")
    }
    return {name: np.sqrt(np.mean(error**2, axis=0)) for name, error in errors.items()}


@dataclass(frozen=True, kw_only=True)
class Estimate:
    """A parameter of every joint, or a ratio of two, which is often known where they are not."""

    name: str  #: one of `PARAMETERS` or of `RATIOS`
    value: PerJoint
    #: Half of the 95 % interval, in the coordinates of the fit: of the logarithm, so that 0.1 is ±10 %, and
    #: for the latency of 10 ms. Where it is `CONFIDENCE * fit.prior`, the recordings tell nothing. What is in
    #: it: `identification/intervals.py`.
    half_width: PerJoint

    @property
    def interval(self) -> Float[np.ndarray, "num_joints 2"]:
        """The 95 % intervals."""
        ends = self.half_width[:, None] * (-1.0, 1.0)
        if self.name == "latency":
            return np.maximum(self.value[:, None] + LATENCY_UNIT * ends, 0.0)
        return self.value[:, None] * np.exp(ends)


def estimates(fit: Fit) -> dict[str, Estimate]:
    """What was fitted, and the ratios of which both parameters were."""
    along = dict(zip(fit.free, np.eye(len(fit.free)), strict=True))
    values = {name: getattr(fit.dynamics, name) for name in fit.free}
    for name in RATIOS:
        above, below = name.split(" / ")
        if {above, below} <= set(fit.free):
            along[name], values[name] = along[above] - along[below], values[above] / values[below]
    found = {}
    for name, direction in along.items():
        variance = np.einsum("a,jab,b->j", direction, fit.covariance, direction)
        found[name] = Estimate(name=name, value=values[name], half_width=CONFIDENCE * np.sqrt(variance))
    return found


def identified(fit: Fit, start: Start) -> DynamicsFile:
    """The result as training takes it; joints of the file before that were not fitted are carried over."""
    old = start.file or DynamicsFile(dynamics=fit.dynamics, workcell=start.workcell)
    gains = gain_ranges(fit, old.gains, start.workcell)
    return dataclasses.replace(old, dynamics=fit.dynamics.over(old.dynamics), gains=gains)


def gain_ranges(fit: Fit, before: GainRanges, workcell: WorkcellSpec = UR5E_ALLEGRO) -> GainRanges:
    """How much a training has to randomise the gains: their 95 % intervals.

    They are never wider than the paper's ranges and never a single point. Gains that were not fitted keep
    their ranges: the paper's, or those of the dynamics file that the fit started from. Where the ratio of
    damping and stiffness is better known than the damping, they are drawn with a common factor: a fit leaves
    their scale open unless a torque limit or a known inertia fixes it, and a damping fitted at an assumed
    stiffness is right for that one only.
    """
    unknown = np.full(len(fit.dynamics.joints), np.inf)
    widths = {name: found.half_width for name, found in estimates(fit).items()}
    stiffness, damping, lag = (widths.get(name, unknown) for name in ("stiffness", "damping", LAG))
    if "stiffness" not in widths:
        lag, damping = damping, unknown
    columns = {name: list(values) for name, values in dataclasses.asdict(before.of(workcell)).items()}
    widest, order = GainRanges().of(workcell), [joint.name for joint in workcell.joints]
    for j, name in enumerate(fit.dynamics.joints):
        row = order.index(name)
        if np.isfinite(stiffness[j]):
            columns["stiffness_scale"][row] = _within(widest.stiffness_scale[row], stiffness[j])
        if np.isfinite(damping[j]) or np.isfinite(lag[j]):
            columns["damping_scale"][row] = _within(widest.damping_scale[row], min(damping[j], lag[j]))
            columns["is_damping_relative"][row] = bool(lag[j] < damping[j])
    return GainRanges(**{name: tuple(values) for name, values in columns.items()})


def _within(widest: Range, half_width: float) -> Range:
    """The factors of an interval, within the widest range."""
    width = min(max(half_width, LEAST_HALF_WIDTH), 1.0)  # e is more than any range has
    low, high = np.clip(np.exp((-width, width)), *widest)
    return float(low), float(high)
