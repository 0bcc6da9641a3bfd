"""The steps of an identification: what is held out, where the fit starts, errors, intervals and ranges."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from recorded import ARM, ROBOTS, clean, short

from pixel2catch.errors import InvalidValueError, RecordingError
from pixel2catch.identification.fit import SERVO_PARAMETERS, Fit, FitCfg
from pixel2catch.identification.identify import (
    LAG,
    CheckedRecording,
    checked,
    estimates,
    gain_ranges,
    identify,
    merged_file,
    open_questions,
    start_of_fit,
    tracking_errors,
)
from pixel2catch.identification.intervals import model_covariance
from pixel2catch.identification.simulation import Encoders
from pixel2catch.mdp.dynamics_file import DynamicsFile, GainRanges
from pixel2catch.robots.joint_dynamics import PARAMETERS, JointDynamics
from pixel2catch.workcells.ur5e_allegro import UR5E_ALLEGRO

HAND = ROBOTS["allegro"]
PERFECT = Encoders.perfect(1, 1)


def test_the_last_of_several_recordings_is_held_out():
    several = [replace(short(), name=name) for name in ("a.npz", "b.npz", "2.npz", "./a.npz")]
    for num, expected in ((1, [False]), (3, [False, False, True])):
        assert [source.is_held_out for source in checked(several[:num])] == expected
    with pytest.raises(InvalidValueError, match=r"a\.npz is given twice"):
        checked(several)


def test_errors_are_those_of_all_motions_together():
    """Errors of 1 and 3 mrad in as many samples are √5 mrad; the command is 5 mrad off."""
    recording = replace(short(), q=short().q * 0.0, q_cmd=short().q_cmd * 0.0 + 0.005)
    source = CheckedRecording(recording=recording, checks=(), is_held_out=False)
    paths = [np.full((8, 6), error) for error in (1e-3, -3e-3)]
    motions = [replace(source, before=2 * path, after=path) for path in paths]
    errors = tracking_errors(motions)
    np.testing.assert_allclose(errors["after"], np.sqrt(5.0) * 1e-3)
    np.testing.assert_allclose(errors["before"], 2.0 * np.sqrt(5.0) * 1e-3)
    np.testing.assert_allclose(errors["command"], 0.005)


def test_a_recording_that_fails_its_checks_is_not_fitted():
    recording = clean()
    swapped = recording.q[:, [0, 1, 2, 4, 3, 5]]
    late = replace(recording, name="late", t_cmd=recording.t_cmd - 3.0, q=swapped)
    with pytest.raises(RecordingError, match=r"late cannot be used:\n- clock offset: .*add 3.055 s") as error:
        identify(checked([recording, late]), start_of_fit("ur5e", None, False, UR5E_ALLEGRO), FitCfg(), print)
    assert "wrist_1_joint: it follows the command of wrist_2_joint" in str(error.value)
    assert "excitation" not in str(error.value)


def hand_fit() -> Fit:
    """A fit of the hand that doubled every damping, with deviations of 1 %."""
    fit = fit_of(np.tile(1e-4 * np.eye(5), (len(HAND), 1, 1)), SERVO_PARAMETERS, HAND)
    return replace(fit, dynamics=fit.dynamics.with_values(damping=2.0 * fit.dynamics.damping))


@pytest.fixture
def arm_file(tmp_path: Path) -> Path:
    """A file of the arm alone, with slow wrists and ranges of its own."""
    gains = replace(GainRanges(), stiffness_scale=((0.95, 1.05),) * 19)
    dynamics = JointDynamics.of().select(ARM).with_values(latency=[0.0, 0.0, 0.0, 0.01, 0.01, 0.01])
    DynamicsFile(dynamics=dynamics, gains=gains).save(tmp_path / "arm.json")
    return tmp_path / "arm.json"


def test_other_joints_keep_their_entries_in_the_file(arm_file: Path):
    start = start_of_fit("allegro", arm_file, fits_filter=False, workcell=UR5E_ALLEGRO)
    assert start.before == start.first == JointDynamics.of().select(HAND)
    result = merged_file(hand_fit(), start, [])
    known = DynamicsFile.load(arm_file)
    assert result.dynamics.joints == ROBOTS["ur5e_allegro"]
    for name in PARAMETERS:
        expected = [*getattr(known.dynamics, name), *getattr(hand_fit().dynamics, name)]
        np.testing.assert_array_equal(getattr(result.dynamics, name), expected)
    assert result.gains.stiffness_scale[:6] == ((0.95, 1.05),) * 6
    np.testing.assert_allclose(result.gains.stiffness_scale[6:], [np.exp((-0.02, 0.02))] * 13)


def test_a_filter_is_in_front_of_a_stiff_servo_or_of_that_of_the_file(arm_file: Path):
    nominal = JointDynamics.of().select(ARM)
    new = start_of_fit("ur5e", None, fits_filter=True, workcell=UR5E_ALLEGRO)
    assert new.before == nominal
    np.testing.assert_allclose(new.first.damping / new.first.stiffness, 0.003)
    assert (new.first.stiffness > nominal.stiffness).all()
    known = start_of_fit("ur5e", arm_file, fits_filter=True, workcell=UR5E_ALLEGRO)
    np.testing.assert_array_equal(known.first.stiffness, nominal.stiffness)
    for start in (new, known):
        np.testing.assert_array_equal(start.first.filter_gain, 300.0)
        np.testing.assert_array_equal(start.first.filter_lookahead, 0.1)
    with pytest.raises(InvalidValueError, match="filter_gain is of an arm's command filter"):
        start_of_fit("ur5e_allegro", None, fits_filter=True, workcell=UR5E_ALLEGRO)


JOINTS = ("elbow_joint", "wrist_3_joint", "index_joint_1")
SCALE = np.array((1.0, 1.0, 1.0, 1.0, 0.0))
ONLY_LATENCY = np.array((0.0, 0.0, 0.0, 0.0, 1.0))


def fit_of(
    covariance: np.ndarray,
    free: tuple[str, ...] = ("stiffness", "damping", "armature"),
    joints: tuple[str, ...] = JOINTS,
) -> Fit:
    """A fit of these covariances, one of each joint."""
    dynamics, known = JointDynamics.of().select(joints[: len(covariance)]), {"encoders": PERFECT}
    return Fit(dynamics=dynamics, free=free, covariance=covariance, encoder_deviations=PERFECT, **known)


def fit_with(*directions: np.ndarray) -> Fit:
    """A fit with standard deviations of 0.01, but for one direction of each joint."""
    covariance = [1e-4 * np.eye(5) + np.outer(direction, direction) for direction in directions]
    return fit_of(np.stack(covariance), SERVO_PARAMETERS)


def test_what_is_not_known_is_named_with_its_remedy():
    """A common scale of the wrist's torques, whose ratios are known, and the index finger's latency."""
    fit = fit_with(0.0 * SCALE, 0.4 * SCALE, 0.1 * ONLY_LATENCY)
    lag = estimates(fit)[LAG]
    assert lag.value[1] == pytest.approx(202.0 / 2066.0)
    np.testing.assert_allclose(lag.half_width, 1.96 * 0.01 * np.sqrt(2))
    questions = open_questions(fit)
    torques = [f"{name} of wrist 3 is known only to a factor of 2.19" for name in SERVO_PARAMETERS[:4]]
    latency = "latency of index 1 is known only to 2.0 ms"
    assert [text.split(":")[0] for text in questions[:-1]] == [*torques, latency]
    assert "or add slow reversals" in questions[2]
    assert "one scale" in questions[-1]
    assert open_questions(fit_with(0.0 * SCALE)) == []


PAPER = GainRanges().of(UR5E_ALLEGRO)
ELBOW, WRIST = 2, 5
GAINS = ("stiffness", "damping", "armature")


def about_one(half_width: float) -> tuple[float, float]:
    return float(np.exp(-half_width)), float(np.exp(half_width))


@pytest.mark.parametrize(
    ("covariance", "free", "stiffness", "damping", "is_relative"),
    [
        # well known, ±0.098 %: less than what is always left, 2 %
        (2.5e-7 * np.eye(3), GAINS, about_one(0.02), about_one(0.02), False),
        # a common scale known to a factor 7: the paper's stiffness, the damping ±1.96 · 0.01 √2 of it
        (1e-4 * np.eye(3) + np.ones((3, 3)), GAINS, (0.8, 1.2), about_one(1.96 * 0.01 * 2**0.5), True),
        # a lone damping is relative to the assumed stiffness
        (0.03**2 * np.eye(1), ("damping",), (0.8, 1.2), about_one(1.96 * 0.03), True),
        (0.03**2 * np.eye(1), ("stiffness",), about_one(1.96 * 0.03), (0.8, 1.2), False),
    ],
    ids=["well known", "one scale", "damping alone", "stiffness alone"],
)
def test_ranges_are_as_wide_as_what_is_known(covariance, free, stiffness, damping, is_relative):
    ranges = gain_ranges(fit_of(np.stack([covariance]), free), PAPER, UR5E_ALLEGRO)
    np.testing.assert_allclose(ranges.stiffness_scale[ELBOW], stiffness)
    np.testing.assert_allclose(ranges.damping_scale[ELBOW], damping)
    assert ranges.is_damping_relative[ELBOW] == is_relative


def test_ranges_of_other_joints_and_of_what_is_not_known_stay():
    """What an earlier fit of the elbow narrowed is not widened by one of the wrist and the index finger."""
    assert gain_ranges(fit_of(np.stack([4.0 * np.eye(3)] * 3)), PAPER, UR5E_ALLEGRO) == PAPER
    earlier = gain_ranges(fit_of(np.stack([2.5e-7 * np.eye(3)])), PAPER, UR5E_ALLEGRO)
    wrist = fit_of(np.stack([2.5e-7 * np.eye(3)] * 2), joints=JOINTS[1:])
    both = gain_ranges(wrist, earlier, UR5E_ALLEGRO)
    assert both.stiffness_scale[ELBOW] == earlier.stiffness_scale[ELBOW]
    assert both.stiffness_scale[WRIST] == both.stiffness_scale[ELBOW]
    latency = fit_of(np.stack([1e-4 * np.eye(1)]), ("latency",))
    assert gain_ranges(latency, earlier, UR5E_ALLEGRO) == earlier


def test_errors_of_the_model_bound_what_is_known() -> None:
    """0.4 ms of 200 N·m·s/rad are 0.08 kg·m², 40 % of an armature of 0.2, and of its servo's torques.

    Links as heavy as that double the scale's 15 %, and add 15 % of their own. Friction of 160 N·m is 40 %
    of the damping's torque at 2 rad/s: a tenth of that, and 0.8 %, are open in damping over stiffness.
    """
    joint = JointDynamics.of().select(["elbow_joint"])
    joint = joint.with_values(damping=200.0, armature=0.2, frictionloss=160.0)
    alone, heavy = (
        model_covariance(joint, joint.armature, np.array([inertia]), np.ones(1), GAINS[::2], 0.01)[0]
        for inertia in (0.0, 0.2)
    )
    assert alone[1, 1] == pytest.approx(0.4**2 + 0.15**2)
    assert heavy[1, 1] == pytest.approx(0.4**2 + 0.3**2 + 0.15**2)
    assert alone[0, 0] == pytest.approx(0.4**2 + 0.15**2)
    assert heavy[0, 0] == pytest.approx(0.2**2 + 0.15**2)
    names = ("stiffness", "damping", "latency")
    (lag,) = model_covariance(joint, joint.armature, np.array([0.2]), np.full(1, 2.0), names, 0.01)
    assert np.array((-1.0, 1.0, 0.0)) @ lag @ (-1.0, 1.0, 0.0) == pytest.approx(0.008**2 + 0.04**2)
