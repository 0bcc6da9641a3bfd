"""`pixel2catch identify` as a user runs it, on recordings of a simulated arm whose dynamics are known."""

import json
import re
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from recorded import ARM, NOISE, clean, position, simulated

from paths import BUDGETS, files_run
from pixel2catch.cli.identify import Identify
from pixel2catch.cli.main import main
from pixel2catch.files import held_folder
from pixel2catch.identification import fit
from pixel2catch.identification.recording import Recording
from pixel2catch.identification.simulation import behind_play
from pixel2catch.mdp.dynamics_file import DynamicsFile
from pixel2catch.robots.joint_dynamics import JointDynamics

PHYSICS_HZ = 60
NOMINAL = JointDynamics.of().select(ARM)
TRUTH = NOMINAL.with_values(damping=1.3 * NOMINAL.damping, latency=0.02)
SMALL = ("--robot", "ur5e", "--free", "damping", "latency")


@pytest.fixture(scope="module", autouse=True)
def _coarse() -> Iterator[None]:
    """Fit at a low rate, which is fast."""
    import pixel2catch.identification.identify  # noqa: F401 (its annotations need the class itself)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(fit, "FitCfg", partial(fit.FitCfg, physics_dt=1 / PHYSICS_HZ))
        yield


def motion(seed: int) -> Recording:
    """Sines as commands at 50 Hz, from another moment with every seed; measured at 125 Hz, with noise."""
    rng, t_cmd, t_meas = np.random.default_rng(seed), np.arange(0.0, 2.5, 0.02), np.arange(0.0, 2.5, 0.008)
    return simulated(rng, TRUTH, 1 / PHYSICS_HZ, t_cmd, position(t_cmd + seed), t_meas)


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    folder = tmp_path_factory.mktemp("recordings") / "arm & co"
    folder.mkdir()
    for seed, name in enumerate(("first", "second")):
        motion(seed).save(folder / f"{name}.npz")
    return [str(path) for path in sorted(folder.iterdir())]


@pytest.fixture(scope="module")
def run(recordings: list[str], tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, set[str]]:
    """The folder of the results, and the files of the package whose functions ran after the parsing."""
    out, files, identify = tmp_path_factory.mktemp("results") / "new" / "folder", set[str](), Identify.run
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Identify, "run", lambda self: files.update(files_run(lambda: identify(self))))
        assert main(["identify", *recordings, *SMALL, "--out", str(out)]) == 0
    return out, files


@pytest.fixture(scope="module")
def out(run: tuple[Path, set[str]]) -> Path:
    return run[0]


def result(folder: Path) -> dict:
    return json.loads((folder / "result.json").read_text())


def test_a_recording_passes_few_files(run: tuple[Path, set[str]]):
    assert len(run[1]) <= BUDGETS["whole"]["files_from_recording_to_dynamics"], sorted(run[1])


def test_the_dynamics_file_has_what_was_simulated(out: Path):
    file = DynamicsFile.load(out / "dynamics.json")
    assert file.dynamics.joints == ARM
    np.testing.assert_allclose(file.dynamics.damping, TRUTH.damping, rtol=0.02)
    np.testing.assert_allclose(file.dynamics.latency, 0.02, atol=1e-3)
    np.testing.assert_array_equal(file.dynamics.stiffness, NOMINAL.stiffness)
    assert file.gains.damping_scale[6:] == ((0.7, 1.3),) * 13


def test_the_recording_that_was_held_out_judges_the_fit(out: Path):
    numbers = result(out)
    roles = {Path(each["name"]).name: each["is_held_out"] for each in numbers["recordings"]}
    assert roles == {"first.npz": False, "second.npz": True}
    for joint in ARM:
        errors = {name: values[joint] for name, values in numbers["tracking_error"]["held_out"].items()}
        assert errors["after"] == pytest.approx(NOISE, rel=0.2)
        assert errors["command"] > errors["before"] > 10 * errors["after"]
        low, high = numbers["parameters"][joint]["latency"]["interval"]
        assert low < 0.02 < high
    assert numbers["parameters"]["elbow_joint"]["filter_gain"] == {"value": None, "before": None}


def test_the_report_has_pictures_and_names_what_was_run(out: Path):
    text = (out / "report.md").read_text(encoding="utf-8")
    pictures = re.findall(r"\]\((\w+\.png)\)", text)
    assert len(pictures) == len(ARM)
    assert all((out / name).read_bytes().startswith(b"\x89PNG") for name in pictures)
    for part in ("second.npz (held out)", "|   before | 2536 | 343 |", "clock offset"):
        assert part in text, part
    assert "Nothing was held out" not in text


def identified(folder: Path, change: Callable[[Recording], Recording], *free: str) -> Path:
    """The results of two recordings that were changed."""
    paths = [folder / f"{seed}.npz" for seed in range(2)]
    for seed, path in enumerate(paths):
        change(motion(seed)).save(path)
    options = ("--robot", "ur5e", "--free", *(free or ("damping", "latency")))
    assert main(["identify", *map(str, paths), *options, "--out", str(folder / "out")]) == 0
    return folder / "out"


def test_clocks_that_drift_and_play_are_reported(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """Clocks that differ by 2 ms in a second, and 6 mrad of play."""
    play = np.array((0.0, 0.0, 0.0, 0.0, 0.0, 6e-3))
    found = identified(tmp_path, lambda r: replace(r, t_meas=1.002 * r.t_meas, q=behind_play(r.q, play)))
    printed = " ".join(capsys.readouterr().out.split())
    for text in (printed, " ".join(result(found)["warnings"])):
        assert re.search(r"0.npz: the clock of the measurements is (19|20)\d\d ± \d+ ppm fast", text)
        assert re.search(r"Play between servo and encoder \[mrad\]: wrist 3 [567]", text)


def test_a_controller_s_target_as_command_marks_the_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """A controller's own target is where the joint is: no servo with a lag predicts it as well."""
    found = identified(tmp_path, lambda r: replace(r, t_cmd=r.t_meas, q_cmd=r.q + 1e-4), "latency")
    assert "the command predicts" in " ".join(capsys.readouterr().out.split())
    assert result(found)["worse_than_command"] == list(ARM)
    with pytest.warns(UserWarning, match="the command alone predicts motion better"):
        assert DynamicsFile.load(found / "dynamics.json").worse_than_command == ARM


def test_the_next_fit_starts_from_the_file_and_warns_that_nothing_was_held_out(
    recordings: list[str], out: Path, tmp_path: Path
):
    args = ("--robot", "ur5e", "--start", str(out / "dynamics.json"), "--free", "latency")
    assert main(["identify", recordings[0], *args, "--out", str(tmp_path)]) == 0
    assert result(tmp_path)["tracking_error"]["held_out"] == {}
    assert "Nothing was held out" in (tmp_path / "report.md").read_text(encoding="utf-8")
    found, known = (DynamicsFile.load(folder / "dynamics.json").dynamics for folder in (tmp_path, out))
    np.testing.assert_array_equal(found.damping, known.damping)
    np.testing.assert_allclose(found.latency, known.latency, atol=2e-4)


def test_bad_input_leaves_nothing(recordings: list[str], out: Path, tmp_path: Path, refusal: Any):
    new = ("--out", str(tmp_path / "out"))
    for args, words in (
        ([*recordings, *SMALL, *new, "--profile", "ur5e_allegro_v4", "--command-topic", "/arm"], "leave out"),
        ([*recordings, *new, "--robot", "allegro"], "no joint index_joint_1"),
        ([*recordings, "--robot", "ur5e"], "--robot and --out are needed"),
        ([*SMALL, *new], "give at least one"),
        (["nowhere.npz", *SMALL, *new], "nowhere.npz"),
        ([*recordings, *SMALL, "--out", str(out)], "is not an empty folder; name another"),
    ):
        assert words in refusal("identify", *args)
    with held_folder(tmp_path / "out"):
        assert "is in use by another command" in refusal("identify", *recordings, *SMALL, *new)
    assert not (tmp_path / "out").exists()
    assert DynamicsFile.load(out / "dynamics.json").dynamics.joints == ARM


def test_data_alone_are_checked(recordings: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """Of one joint, too; the exit status says whether they can be fitted."""
    elbow, still = tmp_path / "elbow.npz", tmp_path / "still.npz"
    clean((ARM[2],)).save(elbow)
    recording = clean()
    replace(recording, q=np.repeat(recording.q[:1], len(recording.q), axis=0)).save(still)
    assert main(["identify", "--check", *recordings, str(elbow)]) == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert "first.npz: 0 of 18 checks failed" in printed
    assert "elbow.npz: 0 of 8 checks failed" in printed
    with pytest.raises(SystemExit, match="1"):
        main(["identify", "--check", str(still)])
    assert "at a standstill: no joint moved more than 0 mrad" in " ".join(capsys.readouterr().out.split())
