"""Each check finds its fault in a hand-made recording, and a clean recording passes all."""

import re
from collections.abc import Callable, Iterable
from dataclasses import replace

import numpy as np
import pytest
from recorded import AMPLITUDE, ARM, FREQUENCIES, JOINT_SPECS, LAG, ROBOTS, clean, position

from pixel2catch.identification.checks import DataCheck, check_recording, excess_time, measured_lag, smoothed
from pixel2catch.identification.recording import Recording

CLOCKS = ["measurement times", "command times"]
WHOLE = [*CLOCKS, "motion", "stalls", "repeated samples", "clock offset"]
EACH = ["follows its command", "excitation"]


def find(checks: list[DataCheck], name: str, joint: str | None = None) -> DataCheck:
    (check,) = (each for each in checks if (each.name, each.joint) == (name, joint))
    return check


def failures(recording: Recording) -> set[tuple[str, str | None]]:
    return {(check.name, check.joint) for check in check_recording(recording) if check.is_good is False}


@pytest.mark.parametrize("joints", [ROBOTS["ur5e_allegro"], ARM[2:3]], ids=["all", "elbow"])
def test_clean_recording_passes(joints: tuple[str, ...]):
    checks = check_recording(clean(joints))
    assert [check.name for check in checks] == WHOLE + EACH * len(joints)
    assert all(check.is_good for check in checks)
    fast = replace(clean(joints), t_cmd=clean().t_cmd / 10.0, t_meas=clean().t_meas / 10.0)
    assert ("speed", joints[0]) in failures(fast)  # clocks in another unit: 17 rad/s


def stalled(num_stalls: int) -> Recording:
    """A clock that counts loops of 2 ms, of which some took 42."""
    recording = clean()
    is_stall = np.isin(np.arange(4000), 100 + 3000 // num_stalls * np.arange(num_stalls))
    true_time = recording.t_meas + 0.04 * is_stall.cumsum()
    noise = recording.q - position(recording.t_meas - LAG)
    t_cmd = np.arange(0.0, true_time[-1], 0.008)
    q = position(true_time - LAG) + noise
    return replace(recording, q=q, t_cmd=t_cmd, q_cmd=position(t_cmd))


def test_stalled_clock_is_found():
    check = find(check_recording(stalled(150)), "stalls")
    assert check.is_good is False
    assert 0.9 * 150 <= int(check.detail.split()[0]) <= 150
    median = re.search(r"(\d+) ms in the median: record the controller's time", check.detail)
    assert median
    assert float(median[1]) == pytest.approx(40, abs=4)
    assert find(check_recording(clean()), "stalls").detail.startswith("0 steps (0.00 %)")


def test_excess_time_of_one_stall_is_its_length():
    """At a constant speed of 0.5 rad/s (0.3 and 0.4), a step of 42 ms that is stamped as 2 ms: 40 ms more."""
    time = np.arange(0.0, 1.0, 0.002)
    q = (time + 0.04 * (np.arange(500) >= 200))[:, None] * (0.3, -0.4)
    excess, angle = excess_time(Recording(joints=ARM[:2], t_cmd=time, q_cmd=q, t_meas=time, q=q))
    np.testing.assert_allclose(excess, 0.04 * (np.arange(499) == 199), atol=1e-9)
    np.testing.assert_allclose(angle, 0.02 * (np.arange(499) == 199), atol=1e-9)


def without(recording: Recording, begin: float, end: float) -> Recording:
    """A recording without the measurements between two times [s]."""
    is_kept = (recording.t_meas < begin) | (recording.t_meas > end)
    return replace(recording, t_meas=recording.t_meas[is_kept], q=recording.q[is_kept])


@pytest.mark.parametrize(
    ("spoil", "place", "detail"),
    [
        (lambda r: without(r, 3.0, 3.2), 0, "a gap of more than 0.1 s: split"),
        (lambda r: replace(r, t_meas=np.repeat(r.t_meas[::2], 2)), 0, "2000 times twice: record"),
        (lambda r: without(r, 0.08, 9.0), 0, "fewer than 50 samples"),
        (lambda r: replace(r, t_cmd=np.repeat(r.t_cmd[::2], 2)), 1, "500 times twice: record"),
        (lambda r: replace(r, t_cmd=1000 * r.t_cmd), 1, "are both in seconds?"),
    ],
)
def test_bad_clock_is_found_and_ends_the_checks(spoil: Callable, place: int, detail: str):
    checks = check_recording(spoil(clean()))
    assert [check.name for check in checks] == CLOCKS
    assert checks[place].is_good is False
    assert detail in checks[place].detail


def test_repeated_samples_are_found():
    """A log at 500 Hz of a controller at 250 Hz has every second sample twice; a pause does not count."""
    recording = clean(noise=0.0)
    twice = replace(recording, q=np.repeat(recording.q[::2], 2, axis=0))
    check = find(check_recording(twice), "repeated samples")
    assert check.is_good is False
    assert check.detail.startswith("50.0 % of the samples")
    pause = replace(recording, q=np.where(np.arange(4000)[:, None] < 2000, recording.q, recording.q[2000]))
    assert find(check_recording(pause), "repeated samples").is_good


@pytest.mark.parametrize("offset", [0.1037, 1_790_000_000.0])
def test_lag_is_found_whatever_the_clocks(offset: float):
    """The held command is late by half its step, so that the motion is 56 ms behind what is held."""
    recording = replace(clean(), t_cmd=clean().t_cmd - offset)
    lag = measured_lag(recording) or 0.0
    assert lag == pytest.approx(LAG - 0.004 + offset, abs=1.1e-3)
    check = find(check_recording(recording), "clock offset")
    assert check.is_good == (-0.02 <= lag <= 0.3)
    assert check.is_good or f"add {lag:.3f} s to the command times" in check.detail


def test_a_joint_at_rest_is_not_judged():
    recording = clean()
    q = np.where(np.arange(6) == 2, recording.q[0], recording.q)
    q_cmd = np.where(np.arange(6) == 2, recording.q_cmd[0], recording.q_cmd)
    resting = replace(recording, q=q, q_cmd=q_cmd)  # a joint without commands is not judged
    assert failures(resting) == {("excitation", ARM[2])}
    assert find(check_recording(resting), "follows its command", ARM[2]).is_good is None


SWAPPED = np.array([0, 0, 0, 4.7, -4.7, 0])


def moved(recording: Recording, place: int, q: np.ndarray) -> Recording:
    return replace(recording, q=np.where(np.arange(6) == place, q, recording.q))


@pytest.mark.parametrize(
    ("spoil", "joints", "words"),
    [
        (lambda r: moved(r, 5, r.q - np.pi), (5,), "-3.14 rad from its command"),
        (lambda r: moved(r, 1, 2 * r.q[0] - r.q), (1,), "against its command: change its sign"),
        (lambda r: moved(r, 1, 2.0 * r.q - r.q[0]), (1,), "moves 2.00 to"),
        (lambda r: moved(r, 1, 0.5 * (r.q + r.q[0])), (1,), "moves 0.50 to"),
        (lambda r: moved(r, 2, 0.0 * r.q), (2,), "correlation 0.000: is it stopped?"),
        (lambda r: replace(r, t_cmd=r.t_meas, q_cmd=r.q), range(6), "equal its measurements"),
        (lambda r: replace(r, t_cmd=r.t_meas[::5], q_cmd=r.q[::5]), range(6), "equal its measurements"),
        (lambda r: replace(r, q=r.q[:, [0, 1, 2, 4, 3, 5]] + SWAPPED), (3, 4), "are these joints exchanged?"),
    ],
)
def test_a_joint_that_does_not_follow_is_told_why(spoil: Callable, joints: Iterable[int], words: str):
    checks = check_recording(spoil(clean()))
    name = "follows its command"
    assert {c.joint for c in checks if c.name == name and not c.is_good} == {ARM[i] for i in joints}
    assert all(words in find(checks, name, ARM[joint]).detail for joint in joints)


def test_a_standstill_is_named_as_that():
    recording = clean()
    q = recording.q[:1] + 2e-4 * np.random.default_rng(0).standard_normal(recording.q.shape)
    checks = check_recording(replace(recording, q=q))
    assert [check.name for check in checks if check.is_good is False] == ["motion"]
    assert re.search(r"no joint moved more than \S+ mrad: let the robot follow an exc", checks[-1].detail)
    assert find(check_recording(recording), "motion").detail.endswith("moved most, by 0.49 rad")


ENCODERS = {"UR5": 9.5e-6, "a tenth of a degree": np.radians(0.1)}


@pytest.mark.parametrize("step", ENCODERS.values(), ids=ENCODERS)
def test_rounded_positions_are_neither_stalled_nor_repeated(step: float):
    """At a tenth of the speed, too, where a coarse encoder says the same for several samples."""
    for slowness in (1.0, 10.0):
        recording = clean(noise=0.3 * step)
        path, ordered = position((recording.t_meas - LAG) / slowness), position(recording.t_cmd / slowness)
        rounded = step * np.rint((path + recording.q - position(recording.t_meas - LAG)) / step)
        checks = check_recording(replace(recording, q=rounded, q_cmd=ordered))
        for name in ("stalls", "repeated samples"):
            assert find(checks, name).is_good is not False, (slowness, find(checks, name).detail)


def test_motion_is_smoothed_to_its_derivatives():
    """Speed and acceleration of a sine are known: Aω and Aω²; 0.2 mrad of noise does not hide them."""
    speeds, accelerations = smoothed(clean().t_meas, clean().q)
    omega = 2 * np.pi * FREQUENCIES
    np.testing.assert_allclose(np.abs(speeds).max(0), AMPLITUDE * omega, rtol=0.02)
    np.testing.assert_allclose(np.abs(accelerations).max(0), AMPLITUDE * omega**2, rtol=0.1)


def excited(path: np.ndarray) -> DataCheck:
    """The check of the elbow's excitation when it alone moves along a path."""
    recording = clean()
    q = recording.q.copy()
    q[:, 2] = path
    return find(check_recording(replace(recording, q=q)), "excitation", ARM[2])


def test_excitation_names_what_is_lacking():
    """The elbow needs 0.1 · 2.79 rad/s, 0.40 / 0.14 = 2.9 rad/s² and a reversal."""
    time = clean().t_meas
    spec = JOINT_SPECS[ARM[2]]
    assert spec.frictionloss / spec.armature == pytest.approx(2.86, abs=0.01)
    creeping = excited(0.1 * np.sin(2 * np.pi * 0.25 * time))
    assert creeping.detail.endswith("4 reversals; needs 0.28 rad/s, 2.9 rad/s²")
    one_way = excited(0.3 * time + 0.015 * np.sin(4 * np.pi * time))
    assert one_way.detail.endswith("0 reversals; needs 2.9 rad/s², 1 reversal")
    assert excited(0.25 * np.sin(2 * np.pi * time)).is_good


def test_weak_motion_is_a_warning_and_unsound_data_forbid_a_fit():
    recording = clean()
    middle = recording.q.mean(axis=0)
    small = {name: middle + 0.1 * (getattr(recording, name) - middle) for name in ("q", "q_cmd")}
    warned = check_recording(replace(recording, **small))
    assert {check.name for check in warned if check.is_good is False} == {"excitation"}
    assert {check.verdict for check in warned} == {"good", "weak"}
    assert not any(check.forbids_fit for check in warned)
    late = check_recording(replace(recording, t_cmd=recording.t_cmd - 3.0))
    assert [check.name for check in late if check.forbids_fit] == ["clock offset"]
