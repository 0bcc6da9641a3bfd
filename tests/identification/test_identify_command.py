"""`pixel2catch identify` as a user runs it, on recordings of a simulated arm whose dynamics are known."""

import base64
import json
import re
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass, replace
from html import unescape
from html.parser import HTMLParser
from io import StringIO
from pathlib import Path

import numpy as np
import pytest
from recorded import ARM, clean, position

from paths import files_run
from pixel2catch.cli.identify import Identify
from pixel2catch.cli.main import main
from pixel2catch.identification.encoders import behind_play
from pixel2catch.identification.recording import Recording
from pixel2catch.identification.simulation import RecordedMotion
from pixel2catch.mdp.dynamics_file import DynamicsFile
from pixel2catch.robots.joint_dynamics import JointDynamics

MOST_FILES = 35  #: Budget of files of the package from a recording to its dynamics file.
PHYSICS_HZ = 60
NOISE = 2e-4
NOMINAL = JointDynamics.nominal(ARM)
TRUTH = NOMINAL.with_values(damping=1.3 * NOMINAL.damping, latency=0.02)
SMALL = ("--robot", "ur5e", "--physics-hz", str(PHYSICS_HZ), "--free", "damping", "latency")


def simulated(seed: int, seconds: float = 2.5) -> Recording:
    """Sines as commands at 50 Hz, from another moment with every seed; measured at 125 Hz, with noise."""
    t_cmd, t_meas = np.arange(0.0, seconds, 0.02), np.arange(0.0, seconds, 0.008)
    q_cmd = position(t_cmd + seed)
    blank = Recording(
        joints=ARM, t_cmd=t_cmd, q_cmd=q_cmd, t_meas=t_meas, q=np.repeat(q_cmd[:1], len(t_meas), axis=0)
    )
    (path,) = RecordedMotion([blank], 1 / PHYSICS_HZ).simulate([TRUTH])
    q = np.concatenate((blank.q[: -len(path)], path))
    return replace(blank, q=q + NOISE * np.random.default_rng(seed).standard_normal(q.shape))


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    folder = tmp_path_factory.mktemp("recordings") / "<arm> & co"
    folder.mkdir()
    for seed, name in enumerate(("first", "second")):
        simulated(seed).save(folder / f"{name}.npz")
    return [str(path) for path in sorted(folder.iterdir())]


@dataclass(frozen=True, kw_only=True)
class Run:
    """What the command made and printed."""

    out: Path
    stdout: str
    stderr: str
    files: set[str]  #: files of the package whose functions ran, the parsing of the command line aside


@pytest.fixture(scope="module")
def run(recordings: list[str], tmp_path_factory: pytest.TempPathFactory) -> Run:
    out, files, identify = tmp_path_factory.mktemp("results") / "new" / "folder", set[str](), Identify.run
    with (
        redirect_stdout(StringIO()) as stdout,
        redirect_stderr(StringIO()) as stderr,
        pytest.MonkeyPatch.context() as patch,
    ):
        patch.setattr(Identify, "run", lambda self: files.update(files_run(lambda: identify(self))))
        assert main(["identify", *recordings, *SMALL, "--out", str(out)]) == 0
    return Run(out=out, stdout=stdout.getvalue(), stderr=stderr.getvalue(), files=files)


@pytest.fixture(scope="module")
def out(run: Run) -> Path:
    return run.out


def result(folder: Path) -> dict:
    return json.loads((folder / "result.json").read_text())


def test_a_recording_passes_few_files(run: Run):
    assert len(run.files) <= MOST_FILES, sorted(run.files)


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


class References(HTMLParser):
    """What a page refers to, and its images."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        assert tag not in ("script", "link", "iframe", "object")
        self.found += [value or "" for name, value in attrs if name in ("src", "href", "srcset", "style")]


def test_the_report_needs_nothing_but_itself(out: Path):
    text = (out / "report.html").read_text(encoding="utf-8")
    page = References()
    page.feed(text)
    images = [reference for reference in page.found if reference.startswith("data:image/png;base64,")]
    assert len(images) == len(ARM)
    assert all(base64.b64decode(image.partition(",")[2]).startswith(b"\x89PNG") for image in images)
    others = [reference for reference in page.found if reference not in images]
    assert all(re.fullmatch(r"background: #\w{6}", reference) for reference in others)
    assert not re.search(r"https?:|url\(|@import", text)


def test_the_report_says_what_a_reader_must_know(out: Path):
    text = (out / "report.html").read_text(encoding="utf-8")
    words = unescape(re.sub(r"<style>.*?</style>|<[^>]+>", " ", text, flags=re.DOTALL))
    for part in (
        "On motion that was held out, the median joint's tracking error was",
        "Tracking error, RMS [mrad]",
        "second.npz (held out)",
        "Parameters with 95 % intervals",
        "before 343",
        "not fitted",
        "Randomisation in training",
        "as in the paper",
        "Data checks",
        "clock offset",
        "pixel2catch",
        "free: damping, latency; physics at 60 Hz",
        "mujoco 4",
    ):
        assert part in words, part
    assert "Nothing was held out" not in words
    assert "&lt;arm&gt; &amp; co" in text


def test_clocks_that_drift_and_play_are_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """Clocks that part by 2 ms in a second, and 6 mrad of play: in the terminal and the page."""
    paths = []
    for seed in range(2):
        recording, play = simulated(seed), np.array((0.0, 0.0, 0.0, 0.0, 0.0, 6e-3))
        loose = replace(recording, t_meas=1.002 * recording.t_meas, q=behind_play(recording.q, play))
        paths.append(tmp_path / f"{seed}.npz")
        loose.save(paths[-1])
    assert main(["identify", *map(str, paths), *SMALL, "--out", str(tmp_path / "out")]) == 0
    printed = " ".join(capsys.readouterr().out.split())
    page = unescape((tmp_path / "out" / "report.html").read_text(encoding="utf-8"))
    assert re.search(r"0.npz: the clock of the measurements is (19|20)\d\d ± \d+ ppm fast", printed)
    assert re.search(r"Play between servo and encoder \[mrad\]: wrist 3 [567]", printed)
    for words in ("ppm fast", "Play between servo and encoder"):
        assert words in page
    drift = result(tmp_path / "out")["drift"][str(paths[0])]["elbow_joint"]["value"]
    assert drift == pytest.approx(0.002, rel=0.02)


def test_targets_that_are_no_commands_are_told_and_the_file_is_marked(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    """What a controller calls its target is where the joint is: no servo with a lag predicts it as well."""
    paths = []
    for seed in range(2):
        recording = simulated(seed)
        target = replace(recording, t_cmd=recording.t_meas, q_cmd=recording.q + 1e-4)
        paths.append(tmp_path / f"{seed}.npz")
        target.save(paths[-1])
    small = (*SMALL[:4], "--free", "latency")
    assert main(["identify", *map(str, paths), *small, "--out", str(tmp_path / "out")]) == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert "shoulder pan, shoulder lift, elbow, wrist 1, wrist 2, wrist 3, the command predicts" in printed
    assert result(tmp_path / "out")["worse_than_command"] == list(ARM)
    with pytest.warns(UserWarning, match="the command alone predicts motion better"):
        assert DynamicsFile.load(tmp_path / "out" / "dynamics.json").worse_than_command == ARM


def test_results_are_never_overwritten(recordings: list[str], out: Path, capsys: pytest.CaptureFixture[str]):
    before = {path: path.read_bytes() for path in out.iterdir()}
    assert main(["identify", *recordings, *SMALL, "--out", str(out)]) == 2
    assert "is not an empty folder; choose another --out" in capsys.readouterr().err
    assert {path: path.read_bytes() for path in out.iterdir()} == before


def test_a_folder_that_cannot_be_made_is_refused_before_the_fit(
    recordings: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    (tmp_path / "file").write_text("precious")
    for out in (tmp_path / "file", tmp_path / "file" / "deeper"):
        assert main(["identify", *recordings, *SMALL, "--out", str(out)]) == 2
        message = capsys.readouterr().err
        assert "choose another --out" in message
        assert "reading" not in message
    assert (tmp_path / "file").read_text() == "precious"


def test_tables_and_steps_are_printed(run: Run):
    for part in ("0 of 25 checks failed", "held out:", "Tracking error, RMS [mrad]", "latency [ms]"):
        assert part in " ".join(run.stdout.split())
    for step in ("reading", "checking the data", "fitting damping, latency", "drawing", "report.html"):
        assert step in run.stderr


def test_the_next_fit_starts_from_the_file_and_says_loudly_that_nothing_was_held_out(
    recordings: list[str], out: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    """The JSON object is all of standard output, and the same as the file's."""
    args = ("--start", str(out / "dynamics.json"), "--free", "latency", "--hold-out", "none", "--json")
    assert main(["identify", *recordings, *SMALL, *args, "--out", str(tmp_path)]) == 0
    assert json.loads(capsys.readouterr().out) == result(tmp_path)
    assert result(tmp_path)["tracking_error"]["held_out"] == {}
    report = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "Nothing was held out: the errors are those of motion that was fitted" in report
    found, known = (DynamicsFile.load(folder / "dynamics.json").dynamics for folder in (tmp_path, out))
    np.testing.assert_array_equal(found.damping, known.damping)
    np.testing.assert_allclose(found.latency, known.latency, atol=2e-4)


@pytest.mark.parametrize(
    ("args", "words"),
    [
        (("--hold-out", "third"), ("'third'", "first.npz")),
        (("--free", "armatures"), ("'armatures'", "Did you mean 'armature'")),
        (("--free", "filter_gain"), ("the start has none",)),
        (("--physics-hz", "100"), ("physics_hz is 100",)),
        (("--start", "nowhere.json"), ("start is 'nowhere.json', which is not there",)),
        (("--rename", "elbow=e"), ("'elbow'", "elbow_joint")),
        (("--command-topic", "/arm=ur5e", "/arm"), ("--command-topic names /arm twice",)),
        (("--shift-commands", "3"), ("clock offset", "add -2.8", "--shift-commands")),
        (("--robot", "allegro"), ("no joint index_joint_1", "--robot")),
        (("--robot", "ur5e_allegro", "--filter"), ("--filter is an arm's", "identify --robot ur5e with it")),
    ],
)
def test_bad_input_leaves_nothing(
    args: tuple[str, ...],
    words: tuple[str, ...],
    recordings: list[str],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
):
    assert main(["identify", *recordings, *SMALL, *args, "--out", str(tmp_path / "out")]) == 2
    message = capsys.readouterr().err
    for word in words:
        assert word in message
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("given", "message"), [([], "give at least one"), (["nowhere.npz"], "nowhere.npz: there is no such file")]
)
def test_without_a_recording_nothing_is_made(
    given: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    assert main(["identify", *given, *SMALL, "--out", str(tmp_path / "out")]) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_unsound_data_show_their_table_first(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    recording = clean()
    path = tmp_path / "stuck.npz"
    replace(recording, q=recording.q[:, [0, 1, 2, 4, 3, 5]]).save(path)
    assert main(["identify", str(path), *SMALL, "--out", str(tmp_path / "out")]) == 2
    streams = capsys.readouterr()
    assert re.search(r"follows its command +│ wrist_1_joint +│ BAD", streams.out)
    assert "stuck.npz cannot be used:\n- follows its command of wrist_1_joint" in streams.err


def exit_status(*args: str) -> int | str | None:
    try:
        return main(["identify", "--check", *args])
    except SystemExit as ending:
        return ending.code


def test_data_alone_are_checked(recordings: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """Of one joint, too; the exit status says whether they can be fitted."""
    assert exit_status(*recordings) == 0
    assert "first.npz: 0 of 25 checks failed" in " ".join(capsys.readouterr().out.split())
    elbow, still = tmp_path / "elbow.npz", tmp_path / "still.npz"
    clean((ARM[2],)).save(elbow)
    assert exit_status(str(elbow), "--json") == 0
    checks = json.loads(capsys.readouterr().out)[str(elbow)]
    assert {check["joint"] for check in checks} == {None, ARM[2]}
    recording = clean()
    replace(recording, q=np.repeat(recording.q[:1], len(recording.q), axis=0)).save(still)
    assert exit_status(str(elbow), str(still)) == 1
    assert "at a standstill: no joint moved more than 0 mrad" in " ".join(capsys.readouterr().out.split())
    assert exit_status() == 2
    assert exit_status(str(tmp_path / "gone.npz")) == 2


def test_what_a_fit_needs_is_asked_for(recordings: list[str], capsys: pytest.CaptureFixture[str]):
    assert main(["identify", *recordings, "--robot", "ur5e"]) == 2
    assert "where to write, --out; or --check" in capsys.readouterr().err
    assert exit_status(*recordings, "--profile", "ur5e_allegro_v4", "--rename", "elbow_joint=e") == 2
    assert "--profile says what --command-topic and --rename do" in capsys.readouterr().err


def test_columns_are_told(capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit):
        main(["identify", "--help"])
    said = " ".join(re.sub("[│╭╮╰╯─]", " ", capsys.readouterr().out).split())
    for name in ("timestamp", "actual_q_0", "actual_qd_5", "t_cmd", "q_cmd", "t_meas", "effort"):
        assert name in said
