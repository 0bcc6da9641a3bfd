"""From recordings to a dynamics file: start of the fit, held-out data, confidence intervals, gain ranges."""

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Float

from pixel2catch.checks import Range
from pixel2catch.errors import InvalidValueError, RecordingError
from pixel2catch.identification.checks import DataCheck, check_recording
from pixel2catch.identification.fit import LATENCY_UNIT, Fit, FitCfg, fit_dynamics
from pixel2catch.identification.intervals import CONFIDENCE
from pixel2catch.identification.recording import Recording, groups_of, joints_of
from pixel2catch.identification.simulation import Encoders, RecordedMotion
from pixel2catch.mdp.dynamics_file import DynamicsFile, GainRanges
from pixel2catch.robots.joint_dynamics import SERVOJ_GAIN, SERVOJ_LOOKAHEAD, JointDynamics
from pixel2catch.robots.workcell import WorkcellSpec

STIFF_FACTOR = 10.0  # stiffness of the servo behind a command filter over the nominal one (ours)
STIFF_LAG = 0.003  # damping over stiffness of that servo [s]. Source: real UR5, target to position.
LAG = "damping / stiffness"  # name of the ratio that decides how far a joint lags behind its command

RATIOS = {LAG: "s", "armature / stiffness": "s²", "frictionloss / stiffness": "rad"}
"""Ratios that decide how a joint follows its command, with their units."""

LEAST_HALF_WIDTH = 0.02  # least half-width of a range of gains (ours; gains drift with temperature and load)
WELL_KNOWN = 0.1  # largest half-width of an interval of an identified parameter: 10 %, or 1 ms (ours)

REMEDIES = {
    "stiffness": ("N·m/rad", "add motion that reaches the torque limit, or a known payload"),
    "damping": ("N·m·s/rad", "add faster motion"),
    "frictionloss": ("N·m", "add slow reversals"),
    "armature": ("kg·m²", "add steps and faster changes of speed"),
    "latency": ("ms", "add steps"),
    "filter_gain": ("1/s²", "add steps"),
    "filter_lookahead": ("s", "add 20 Hz targets of changing speed"),
}
"""Unit of each parameter, and motion that shows the parameter in positions."""

PerJoint = Float[np.ndarray, " num_joints"]
Positions = Float[np.ndarray, "num_settled num_joints"]


@dataclass(frozen=True, kw_only=True)
class FitStart:
    """The dynamics that a fit starts from."""

    workcell: WorkcellSpec  #: work cell of the joints
    robot: str  #: part of the work cell that is fitted
    file: DynamicsFile | None  #: the dynamics file that was given, if any
    before: JointDynamics  #: its joint dynamics; nominal for joints that are not in it
    first: JointDynamics  #: the same, with a command filter in front where one is to be fitted


@dataclass(frozen=True, kw_only=True)
class CheckedRecording:
    """A recording with its data checks and, after a fit, its simulation."""

    recording: Recording
    checks: tuple[DataCheck, ...]
    is_held_out: bool  #: whether it judges the fit instead of being fitted
    #: simulated before the fit and with the fitted dynamics, at the times of the compared measurements [rad]
    before: Positions = field(default_factory=lambda: np.zeros((0, 0)))
    after: Positions = field(default_factory=lambda: np.zeros((0, 0)))

    @property
    def time(self) -> Float[np.ndarray, " num_settled"]:
        """Return the times of the compared measurements, those after `SETTLING` [s]."""
        return self.recording.t_meas[-len(self.after) :]

    @property
    def measured(self) -> Positions:
        """Return the compared measurements [rad]."""
        return self.recording.q[-len(self.after) :]


@dataclass(frozen=True, kw_only=True)
class Identification:
    """A fit with the recordings that judge it."""

    start: FitStart
    fit: Fit
    file: DynamicsFile  #: the result for training, with the ranges of its gains
    motions: tuple[CheckedRecording, ...]
    physics_dt: float  #: time step of the simulation [s]

    def of(self, is_held_out: bool) -> tuple[CheckedRecording, ...]:
        """Return the motions that were held out, or those that were fitted."""
        return tuple(motion for motion in self.motions if motion.is_held_out == is_held_out)


def start_of_fit(part: str, path: Path | None, fits_filter: bool, workcell: WorkcellSpec) -> FitStart:
    """Return the start of a fit of a part, from a dynamics file if there is one.

    Without a file, the servo behind a filter that is to be fitted is stiff.
    """
    joints, groups = joints_of(workcell, part), groups_of(workcell)
    if fits_filter and any(groups[joint].role != "arm" for joint in joints):
        raise InvalidValueError(
            f"filter_gain is of an arm's command filter, but --robot {part} has a hand; identify the arm "
            "with it, then the hand with --start and the dynamics file of the arm."
        )
    file = DynamicsFile.load(path, workcell) if path else None
    first = before = JointDynamics.of(workcell.joints, file.dynamics if file else None).select(joints)
    if fits_filter:
        servo = before if file else stiff(before)
        gain = np.where(servo.has_filter, servo.filter_gain, SERVOJ_GAIN)
        lookahead = np.where(servo.has_filter, servo.filter_lookahead, SERVOJ_LOOKAHEAD)
        first = servo.with_values(filter_gain=gain, filter_lookahead=lookahead)
    return FitStart(workcell=workcell, robot=part, file=file, before=before, first=first)


def stiff(nominal: JointDynamics) -> JointDynamics:
    """Return the stiff servos of a controller with feed-forward."""
    stiffness = STIFF_FACTOR * nominal.stiffness
    return nominal.with_values(stiffness=stiffness, damping=STIFF_LAG * stiffness)


def checked(recordings: Sequence[Recording]) -> list[CheckedRecording]:
    """Check recordings; the last of several judges the fit."""
    names, last = [str(Path(recording.name)) for recording in recordings], len(recordings) - 1
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise InvalidValueError(f"{', '.join(twice)} is given twice; give every recording once.")
    return [
        CheckedRecording(recording=each, checks=tuple(check_recording(each)), is_held_out=0 < i == last)
        for i, each in enumerate(recordings)
    ]


def identify(
    sources: Sequence[CheckedRecording], start: FitStart, cfg: FitCfg, report: Callable[[str], None]
) -> Identification:
    """Fit all recordings but a last one that is held out, and simulate all of them before and after.

    Raises RecordingError for a recording that fails a check, otherwise as `fit_dynamics` does.
    """
    for source in sources:
        failed = [check for check in source.checks if check.forbids_fit]
        if texts := [f"- {' of '.join(filter(None, (bad.name, bad.joint)))}: {bad.detail}" for bad in failed]:
            raise RecordingError("\n".join([f"{source.recording.name} cannot be used:", *texts]))
    motion = RecordedMotion([source.recording for source in sources], cfg.physics_dt)
    report(f"fitting {', '.join(cfg.free)} of {len(start.first.joints)} joints")
    fitted = [source.recording for source in sources if not source.is_held_out]
    fit = fit_dynamics(fitted, start.first, cfg, report)
    report("simulating all recordings before and after")
    columns = {"drift": fit.encoders.drift, "zero": fit.encoders.zero}
    if len(fitted) < len(sources):  # means stand for the recording that was held out
        columns = {name: np.vstack((rows, rows.mean(axis=0))) for name, rows in columns.items()}
    perfect = Encoders.perfect(len(sources), len(fit.dynamics.joints))
    encoders = perfect, dataclasses.replace(fit.encoders, **columns)
    before, after = (motion.split(path) for path in motion.simulate([start.before, fit.dynamics], encoders))
    motions = tuple(
        dataclasses.replace(source, before=path_before, after=path_after)
        for source, path_before, path_after in zip(sources, before, after, strict=True)
    )
    file = merged_file(fit, start, worse_than_command([each for each in motions if each.is_held_out]))
    return Identification(start=start, fit=fit, file=file, motions=motions, physics_dt=cfg.physics_dt)


def merged_file(fit: Fit, start: FitStart, worse: Sequence[str]) -> DynamicsFile:
    """Return the result for training, with the joints whose command predicts motion better than the fit.

    Joints of the start's file that were not fitted keep their entries.
    """
    old = start.file or DynamicsFile(dynamics=fit.dynamics, workcell=start.workcell)
    kept = [name for name in old.worse_than_command if name not in fit.dynamics.joints]
    return dataclasses.replace(
        old,
        dynamics=fit.dynamics.over(old.dynamics),
        gains=gain_ranges(fit, old.gains, start.workcell),
        worse_than_command=(*kept, *worse),
    )


def worse_than_command(motions: Sequence[CheckedRecording]) -> list[str]:
    """Return the joints whose command alone predicts these motions better than the fitted simulation."""
    if not motions:
        return []
    errors = tracking_errors(motions)
    return [motions[0].recording.joints[j] for j in np.flatnonzero(errors["after"] > errors["command"])]


def tracking_errors(motions: Sequence[CheckedRecording]) -> dict[str, PerJoint]:
    """Return the root mean square of predicted minus measured positions of all motions, per joint [rad].

    The prediction is the `command`, or the simulation `before` or `after` the fit with its encoders.
    """
    paths = {"command": [motion.recording.held(motion.time) for motion in motions]}
    paths |= {name: [getattr(motion, name) for motion in motions] for name in ("before", "after")}
    measured = np.concatenate([motion.measured for motion in motions])
    return {
        name: np.sqrt(np.mean((np.concatenate(each) - measured) ** 2, axis=0)) for name, each in paths.items()
    }


@dataclass(frozen=True, kw_only=True)
class Estimate:
    """A parameter of every joint, or a ratio of two parameters, which is often better known."""

    name: str  #: one of `PARAMETERS` or of `RATIOS`
    value: PerJoint
    #: half of the 95 % interval in the coordinates of the fit: of the logarithm, for the latency of 10 ms
    half_width: PerJoint

    @property
    def interval(self) -> Float[np.ndarray, "num_joints 2"]:
        """Return the 95 % intervals."""
        ends = self.half_width[:, None] * (-1.0, 1.0)
        if self.name == "latency":
            return np.maximum(self.value[:, None] + LATENCY_UNIT * ends, 0.0)
        return self.value[:, None] * np.exp(ends)


def estimates(fit: Fit) -> dict[str, Estimate]:
    """Return the fitted parameters, and the ratios of two fitted parameters, by name."""
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


def gain_ranges(fit: Fit, before: GainRanges, workcell: WorkcellSpec) -> GainRanges:
    """Return the ranges in which a training must randomise the gains: their 95 % intervals.

    They are within the paper's ranges and never a single point. Gains that were not fitted keep their ranges
    `before`. Where the ratio of damping and stiffness is better known than the damping, both are drawn with a
    common factor, because a fit leaves their scale open unless a torque limit or a known inertia fixes it.
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
    width = min(max(half_width, LEAST_HALF_WIDTH), 1.0)  # a factor e is beyond any range
    low, high = np.clip(np.exp((-width, width)), *widest)
    return float(low), float(high)


def short(joint: str) -> str:
    """Return the name of a joint for people."""
    return joint.removesuffix("_joint").replace("_joint_", " ").replace("_", " ")


def open_questions(fit: Fit) -> list[str]:
    """Return what is not identified and the remedy, one sentence for all joints of a parameter."""
    known, questions = estimates(fit), []
    for name in fit.free:
        widths = known[name].half_width
        worst = float(widths.max())
        width = f"a factor of {np.exp(min(worst, 9.0)):.3g}"
        width = f"{1e3 * LATENCY_UNIT * worst:.1f} ms" if name == "latency" else width
        if joints := [short(fit.dynamics.joints[j]) for j in np.flatnonzero(widths > WELL_KNOWN)]:
            questions.append(
                f"{name} of {', '.join(joints)} is known only to {width}: leave it out of --free, or "
                f"{REMEDIES[name][1]}."
            )
    if LAG in known and any(known["stiffness"].half_width > WELL_KNOWN):
        questions.append("The torques may share one scale: the table of their ratios shows what is known.")
    return questions
