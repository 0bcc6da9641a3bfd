"""The steps of an identification: what is held out, where the fit starts, what is carried over, errors."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from recorded import ARM, ROBOTS, clean, short

from pixel2catch.errors import InvalidValueError, RecordingError, UnknownNameError
from pixel2catch.identification.encoders import Encoders
from pixel2catch.identification.fit import SERVO_PARAMETERS, Fit, FitCfg
from pixel2catch.identification.identify import (
    CheckedRecording,
    Motion,
    checked,
    identified,
    identify,
    start_of_fit,
    tracking_errors,
)
from pixel2catch.identification.recording import Recording
from pixel2catch.mdp.dynamics_file import DynamicsFile, GainRanges
from pixel2catch.robots.joint_dynamics import PARAMETERS, JointDynamics

HAND = ROBOTS["allegro"]
PERFECT = Encoders.perfect(1, len(HAND))


def named(*names: str) -> list[Recording]:
    return [replace(short(), name=name) for name in names]


@pytest.mark.parametrize(
    ("hold_out", "expected"),
    [
        (None, [False, False, True]),
        ("none", [False, False, False]),
        ("1", [True, False, False]),
        ("b", [False, True, False]),
        ("b.npz", [False, True, False]),
        ("runs/2.npz", [False, False, True]),
        ("2", [False, False, True]),
    ],
)
def test_one_recording_is_held_out(hold_out: str | None, expected: list[bool]):
    """A name comes before a number: the third recording is called 2."""
    sources = checked(named("runs/a.npz", "runs/b.npz", "runs/2.npz"), hold_out)
    assert [source.is_held_out for source in sources] == expected


def test_a_lone_recording_is_fitted():
    assert [source.is_held_out for source in checked(named("a.npz"), None)] == [False]


@pytest.mark.parametrize(
    ("names", "hold_out", "error", "message"),
    [
        (("a.npz", "b.npz"), "c", UnknownNameError, "'c'.*Valid: a.npz, b.npz, 1 to 2, none"),
        (("a.npz", "b.npz"), "3", UnknownNameError, "1 to 2"),
        (("x/a.npz", "y/a.npz"), "a", InvalidValueError, "several recordings; hold one out by its number"),
        (("a.npz",), "1", InvalidValueError, "only recording, nothing is left to fit"),
        (("a.npz", "./a.npz"), None, InvalidValueError, "a.npz is given twice"),
    ],
)
def test_what_cannot_be_held_out_is_named(
    names: tuple[str, ...], hold_out: str | None, error: type[Exception], message: str
):
    with pytest.raises(error, match=message):
        checked(named(*names), hold_out)


def test_errors_are_those_of_all_motions_together():
    """Errors of 1 and 3 mrad in as many samples are √5 mrad; the command is 5 mrad off."""
    recording = replace(short(), q=short().q * 0.0, q_cmd=short().q_cmd * 0.0 + 0.005)
    source = CheckedRecording(recording=recording, checks=(), is_held_out=False)
    motions = [
        Motion(**vars(source), before=np.full((8, 6), 2 * error), after=np.full((8, 6), error))
        for error in (1e-3, -3e-3)
    ]
    errors = tracking_errors(motions)
    np.testing.assert_allclose(errors["after"], np.sqrt(5.0) * 1e-3)
    np.testing.assert_allclose(errors["before"], 2.0 * np.sqrt(5.0) * 1e-3)
    np.testing.assert_allclose(errors["command"], 0.005)


def test_a_recording_that_is_not_sound_is_not_fitted():
    recording = clean()
    late = replace(
        recording, name="late", t_cmd=recording.t_cmd - 3.0, q=recording.q[:, [0, 1, 2, 4, 3, 5]] * 1.0
    )
    with pytest.raises(
        RecordingError, match=r"late cannot be used:\n- clock offset: .*--shift-commands"
    ) as error:
        identify(checked([recording, late], None), start_of_fit("ur5e", None, False), FitCfg(), print)
    assert "- follows its command of wrist_1_joint: correlation" in str(error.value)
    assert "excitation" not in str(error.value)


def hand_fit() -> Fit:
    """A fit of the hand that doubled every damping and knows it to 1 %, its lag to 0.1 %."""
    nominal = JointDynamics.nominal(HAND)
    return Fit(
        dynamics=nominal.with_values(damping=2.0 * nominal.damping),
        free=SERVO_PARAMETERS,
        covariance=np.tile(1e-4 * np.eye(5), (len(HAND), 1, 1)),
        prior=2.0,
        encoders=PERFECT,
        encoder_deviations=PERFECT,
    )


@pytest.fixture
def arm_file(tmp_path: Path) -> Path:
    """A file of the arm alone, with slow wrists and ranges of its own."""
    gains = replace(GainRanges(), stiffness_scale=((0.95, 1.05),) * 19)
    dynamics = JointDynamics.nominal(ARM).with_values(latency=[0.0, 0.0, 0.0, 0.01, 0.01, 0.01])
    DynamicsFile(dynamics=dynamics, gains=gains).save(tmp_path / "arm.json")
    return tmp_path / "arm.json"


def test_what_was_known_of_other_joints_is_carried_over(arm_file: Path):
    start = start_of_fit("allegro", arm_file, fits_filter=False)
    assert start.before == start.first == JointDynamics.nominal(HAND)
    result = identified(hand_fit(), start)
    known = DynamicsFile.load(arm_file)
    assert result.dynamics.joints == ROBOTS["ur5e_allegro"]
    for name in PARAMETERS:
        expected = [*getattr(known.dynamics, name), *getattr(hand_fit().dynamics, name)]
        np.testing.assert_array_equal(getattr(result.dynamics, name), expected)
    assert result.gains.stiffness_scale[:6] == ((0.95, 1.05),) * 6
    np.testing.assert_allclose(result.gains.stiffness_scale[6:], [np.exp((-0.02, 0.02))] * 13)


def test_without_a_file_the_result_is_of_the_fitted_joints():
    start = start_of_fit("allegro", None, fits_filter=False)
    assert identified(hand_fit(), start).dynamics == hand_fit().dynamics


def test_a_filter_is_in_front_of_a_stiff_servo_or_of_that_of_the_file(arm_file: Path):
    nominal = JointDynamics.nominal(ARM)
    new = start_of_fit("ur5e", None, fits_filter=True)
    assert new.before == nominal
    np.testing.assert_allclose(new.first.damping / new.first.stiffness, 0.003)
    assert (new.first.stiffness > nominal.stiffness).all()
    known = start_of_fit("ur5e", arm_file, fits_filter=True)
    np.testing.assert_array_equal(known.first.stiffness, nominal.stiffness)
    for start in (new, known):
        np.testing.assert_array_equal(start.first.filter_gain, 300.0)
        np.testing.assert_array_equal(start.first.filter_lookahead, 0.1)


@pytest.mark.parametrize("robot", ["allegro", "ur5e_allegro"])
def test_a_hand_has_no_such_filter(robot: str):
    with pytest.raises(InvalidValueError, match="identify --robot ur5e with it, then"):
        start_of_fit(robot, None, fits_filter=True)
