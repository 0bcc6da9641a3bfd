"""From the twin's joints to a policy for them: the guide's commands, one after the other, in step."""

import json
import re
import shlex
import signal
from pathlib import Path

import numpy as np
import pytest

from paper_robot import JOINTS
from pixel2catch.cli import record
from pixel2catch.cli.main import main
from pixel2catch.identification.importers import RecordedNames, read_rosbag
from pixel2catch.identification.recording import Trajectory
from pixel2catch.identification.rehearsal import exact_file, unlike_nominal
from pixel2catch.identification.simulation import RecordedMotion
from pixel2catch.mdp.dynamics_file import DynamicsFile
from pixel2catch.robots.joint_dynamics import JointDynamics
from pixel2catch.ros2.profile import Profile
from pixel2catch.servo import status_words
from pixel2catch.workcells.ur5e_allegro import UR5E_ALLEGRO

ARM = tuple(joint.name for joint in JOINTS[:6])
NAMES = RecordedNames.of(Profile.load("ur5e_allegro_v4"), ARM)

WIRE = (0.0, 2.5e-3)  #: Least and largest time from a command's stamp to the servos: a cycle, a step [s].


def run(*args: str | Path) -> None:
    assert main([*map(str, args)]) == 0


@pytest.fixture(scope="module")
def truth(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A robot up to 40 % off the nominal one, and 12 ms late."""
    path = tmp_path_factory.mktemp("truth") / "truth.json"
    drawn = unlike_nominal(np.random.default_rng(3), JointDynamics.of(UR5E_ALLEGRO.joints))
    exact_file(drawn, UR5E_ALLEGRO).save(path)
    return path


@pytest.fixture
def swing(tmp_path: Path) -> Path:
    """One swing of the arm in the middle of 2.6 s."""
    path = tmp_path / "swing.npz"
    times = np.arange(0.0, 2.6, 0.008)
    home = np.array([joint.home for joint in JOINTS[:6]])
    way = np.array([0.15, 0.15, -0.15, 0.15, -0.12, 0.15])
    phase = np.clip((times - 1.0) / (times[-1] - 2.0), 0.0, 1.0)
    positions = home + way * np.sin(np.pi * phase)[:, None] ** 2
    Trajectory(joints=ARM, times=times, positions=positions).save(path)
    return path


def test_a_recording_of_the_twin_is_its_dynamics_behind_the_wire(
    truth: Path, swing: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    recording = tmp_path / "recording"
    run("record", swing, "--out", recording, "--lockstep", truth)
    printed = capsys.readouterr()
    assert "running: follows its targets." in printed.err
    (line,) = (line for line in printed.out.splitlines() if line.startswith("pixel2catch identify"))
    options = shlex.split(line)[2:]
    options[options.index("...")] = "--check"
    run("identify", *options[: options.index("--out")])
    checks = capsys.readouterr().out
    assert "BAD" not in checks
    assert re.search(r"stalls +│ +│ good", checks)

    read = read_rosbag(recording, ARM, NAMES, UR5E_ALLEGRO)
    dynamics = DynamicsFile.load(truth).dynamics.select(ARM)
    motion = RecordedMotion([read])
    late = np.linspace(*WIRE, 5)
    simulated = motion.simulate([dynamics.with_values(latency=0.012 + each) for each in late])
    errors = np.sqrt(((simulated - motion.measured) ** 2).mean(axis=(1, 2)))
    assert errors.min() < 1e-4
    assert np.ptp(read.q_cmd, axis=0).min() > 0.1


def test_who_ended_a_recording_too_early_is_said_and_it_fails(truth: Path, swing: Path, capsys, monkeypatch):
    def is_ended(by: str) -> None:
        out = swing.with_name(by)
        assert main(["record", str(swing), "--out", str(out), "--lockstep", str(truth)]) == 2
        last = capsys.readouterr().err.splitlines()[-1]
        assert f"{out} ends before {swing} does, by {by}" in last

    monkeypatch.setattr(record, "PATIENCE", -2.5)
    is_ended("a limit of time")
    monkeypatch.setattr(status_words, "sentence", lambda _: signal.raise_signal(signal.SIGTERM) or "")
    is_ended("SIGTERM")


@pytest.mark.slow
def test_the_guide_s_commands_find_the_twin_and_train_for_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    truth, motion = "rehearsal/truth.json", "--seconds 25 --speed 1 --recordings 2 --out excitation.npz"
    run(*f"excite --robot ur5e {motion} --rehearse rehearsal".split())
    for n in (1, 2):
        run(*f"record excitation-{n}.npz --out recording-{n} --lockstep {truth}".split())
    of_robot = "recording-1 recording-2 --robot ur5e --profile ur5e_allegro_v4"
    run(*f"identify --check {of_robot}".split())
    run(*f"identify {of_robot} --out identified".split())
    files = map(Path, ("identified/dynamics.json", truth))
    found, true = (DynamicsFile.load(file).dynamics.select(ARM) for file in files)
    intervals = json.loads(Path("identified/result.json").read_text())["parameters"]
    for name in ("stiffness", "damping", "frictionloss", "armature"):
        for joint, value in zip(ARM, getattr(true, name), strict=True):
            low, high = intervals[joint][name]["interval"]
            assert low <= value <= high, (name, joint)
    lag = (found.damping / found.stiffness) / (true.damping / true.stiffness)
    assert lag == pytest.approx(np.ones(6), abs=0.01)
    scale = found.stiffness / true.stiffness  # by the links' inertia; of wrists 2 and 3, by torque limits
    assert scale[:4] == pytest.approx(np.ones(4), abs=0.03)
    assert scale[4:] == pytest.approx(np.ones(2), abs=0.2)
    assert WIRE[0] < (found.latency - true.latency).min()
    assert (found.latency - true.latency).max() < WIRE[1]
    tiny = "--device cpu --num-envs 8 --rollout-steps 8 --transitions 256 --mini-batches 2 --hidden 32"
    run(*f"train {tiny} --dynamics identified/dynamics.json --out runs/lab".split())
    run(*f"evaluate runs/lab --dynamics {truth} --num-envs 2 --trials 1 --device cpu".split())
    rehearsal = "--lockstep --plain --throws 1 --out rehearsed"
    run(*f"rehearse runs/lab --dynamics identified/dynamics.json {rehearsal}".split())
