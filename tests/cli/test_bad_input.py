"""Whatever is given to a command: one line that says what is right, the right exit status, no traceback."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from pixel2catch.checks import require_valid
from pixel2catch.cli.main import COMMANDS, main, parse
from pixel2catch.own_files import VARIABLE

EVALUATE = "evaluate --num-envs 1 --trials 1"

BAD = [
    # names
    ("fly", "unknown command 'fly'"),
    ("evaluate propsed", "Did you mean 'proposed'?"),
    ("train --preset slow", "unknown preset 'slow'"),
    ("train --task wild", "unknown task 'wild'"),
    ("train mine.py:mine", "give --import FILE.py, and the name alone"),
    # policies that are none
    ("evaluate {file}", "is a file; give a policy's folder"),
    ("evaluate {empty}", "has no policy"),
    ("evaluate {list_policy}", "it must be a JSON object"),
    # numbers
    ("evaluate --num-envs 99999999999", "num_envs is 99,999,999,999; it must be from 1 to"),
    ("evaluate --num-envs 9999999", "num_envs is 9,999,999; at most"),
    ("train --seed 1" + 400 * "0", "seed is huge"),
    ("excite --seconds inf", "seconds is inf; it must be a finite number"),
    ("evaluate --env.scene.physics-hz 100", "physics_hz is 100; it must be a multiple"),
    ("train --rewards=arm.success 1 arm.success 2", "arm.success is given twice"),
    ("evaluate --num-envs 1 --num_envs=2", "--num-envs is given twice"),
    ("evaluate --seed 1 -- --seed", "unknown policy '--seed'"),
    ("evaluate --device gpu", "device is 'gpu'; it must be cpu, cuda, or cuda:1"),
    ("twin --web --address localhost:99999", "address is 'localhost:99999'; give HOST:PORT"),
    # fields of the task
    (f"{EVALUATE} --env.throws.peak-z 1.9 1.5", "env.throws.peak_z is 1.9 1.5; give the smaller number"),
    (f"{EVALUATE} --env.throws.peak-z 0.5 0.6", "peak_z is up to 0.6 m; release_z, aim_z, clearance need"),
    (
        f"{EVALUATE} --env.sensing.latency-steps 0.6 4.3",
        "delays 0.6 to 4.3 do not fit their grid, 1; 0 draws",
    ),
    ("evaluate --env.name mine", "set --env.name; leave it out"),
    (f"{EVALUATE} --env.scene.workcell ur5e_leap", "of work cell 'ur5e_leap' are not the policy's"),
    # options that contradict each other, or would be ignored
    ("train --physics-stages 60 --env.scene.physics-hz 60", "not both"),
    ("play --web --out film.mp4", "out is 'film.mp4', which does nothing with --web"),
    ("play --web --env.throws.peak-z 1.5 1.9", "leave out --env, or --web"),
    ("operate", "--web"),
    ("doctor --lens people", "does nothing without --robot"),
    ("deploy --network eth99", "network 'eth99'"),
    ("rehearse --perception-ms 20 --out {new}", "does nothing without --lockstep"),
    ("rehearse --lockstep --perception-ms 1001 --out {new}", "perception_ms is 1001; it must be from 0 to"),
    ("rehearse --plain --out {new}", "plain is True, which does nothing without --lockstep"),
    ("rehearse --lockstep --clock 0.5 --out {new}", "clock is 0.5, which does nothing with --lockstep"),
    ("rehearse --lockstep --plain --out {new} --camera people", "leave out --camera if yours stands at"),
    ("track {text} --topic /images --out {new}", "topic is '/images', which does nothing with a source"),
    ("operate /dev/zero", "/dev/zero is no input device; name one"),
    ("operate /dev/null --keys 35 35 1", "give three different ones"),
    ("operate /dev/null --keys 57 30 31", "space (57) and escape (1) stop"),
    ("stress --restitution 0", "--engines"),
    ("stress proposed --engines bullet", "unknown engine 'bullet'. Valid: mujoco, physx, drake"),
    # studies
    ("reproduce --out {new} --methods propose", "proposed"),
    ("reproduce --out {new} --training seed=4", "'seed'"),
    ("reproduce --out {new} --training epochs=4 --sweep epochs 1 2", "'epochs' is given twice"),
    ("reproduce --out {new} --sweep epochs 1", "two values"),
    ("reproduce --out {new} --methods", "methods is empty"),
    ("reproduce --out {new} --sweep staggered True Maybe", "staggered is 'Maybe'; it must be True or False"),
    ("reproduce --out {new} --preset cpu --training rewards=arm.nothing,3", "arm.nothing"),
    ("reproduce --out {new} --sweep learning-rate 1e-3 0.001", "learning_rate=0.001 twice"),
    ("reproduce --out {new} --sweep env.sensing.latency-steps 0,0 -1,3", "latency_steps is -1"),
    ("reproduce --out {new} --slurm timeout", "it must be NAME=VALUE"),
    ("deploy --checkpoint sam2", "does nothing without --segmenter sam2"),
    ("deploy --write-profile {new}.yaml --speed 0.5", "speed is 0.5, which does nothing with --write-"),
    ("calibrate --print-marker {new}.png --timing", "timing is True, which does nothing with --print-marker"),
    ("calibrate --timing --topic /info", "topic is '/info', which does nothing with --timing"),
    ("track self-test --at 1", "at is 1, which does nothing with self-test"),
    ("stress --slurm a=1 --jobs 2", "jobs is 2, which does nothing with --slurm"),
    ("play --web --throws 3", "throws is 3, which does nothing with --web"),
    ("play --address localhost:1", "does nothing without --web"),
    ("operate --web --keys 35 30 31", "keys is 35 30 31, which does nothing without a device"),
    ("record {text} --out {new} --lockstep {text} --network any", "does nothing with --lockstep"),
    ("identify {text} --check --out {new}", "which does nothing with --check"),
    ("calibrate --live {text}", "does nothing with --live"),
    ("calibrate {text} --capture {new}", "does nothing without --live"),
    ("calibrate {text} --network any", "does nothing without --live or --timing"),
    ("train catch --start proposed --device cpu --out {new}", "policy 'proposed', here 'catch'"),
    ("deploy ur5e_leap", "give one with the values here, or train it:"),
    ('trials --policies proposed --out {new} --deploy="', "No closing quotation; correct its quotes"),
    ("trials --policies proposed --out {new} --objects cubee", "unknown object 'cubee'"),
    ("trials --policies proposed proposed --out {new}", "has one twice"),
    ("trials --policies fr3_allegro --out {new}", "here"),
    ("trials --policies proposed --out {new} --deploy=--profile=ur5e_leap", "a place of the profile"),
    ("trials --policies proposed --out {new} --rehearse=--camera=people", "the same --camera"),
    ("release nowhere", "unknown place 'nowhere'"),
    # places
    ("deploy --profile nobody --write-profile my_lab.yaml", "unknown profile 'nobody'"),
    ("evaluate --out .", "out is '.', a folder; name a file in it"),
    ("evaluate --out {file}/x.json", "nothing can be written in"),
    ("evaluate --out {pipe}", "a pipe or a device; name a file"),
    ("stress --out {file}", "a file; name a folder"),
    ("play --out x.avi", "out is 'x.avi'; end the file's name in .mp4"),
    ("export --out {file}.onnx", "file.onnx"),
    ("track 0 --out {full}", "is not an empty folder"),
    ("evaluate --camera {text}", "cannot read the camera file"),
    ("evaluate --dynamics nowhere.json", "dynamics is 'nowhere.json', which is not there"),
    # files of one's own
    ("--import", "--import needs a Python file"),
    ("--import absent.py evaluate", "absent.py' must be a Python file"),
    ("--import {exits} train", "SystemExit"),
    ("train mine --import {no_agents}", "name one or more, each once"),
    ("train mine --import {twins}", "name one or more, each once"),
    ("train mine --import {blind}", "unknown pixel feature 'cz'"),
]

IMPORTS = "from dataclasses import replace\nfrom pixel2catch.methods import PROPOSED\n"
OWN = IMPORTS + "mine = replace(PROPOSED, {})\n"
SOURCES = {
    "exits": "import sys\nsys.exit(0)\n",
    "no_agents": OWN.format("name='none', agents=()"),
    "twins": OWN.format("name='twins', agents=PROPOSED.agents[:1] * 2"),
    "blind": OWN.format("name='blind', pixel_features=('cz',)"),
}


@pytest.fixture(scope="module")
def places(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Files and folders of the wrong kind, by what the command lines call them."""
    folder = tmp_path_factory.mktemp("places")
    names = ("file", "empty", "full", "text", "list_policy", "new", "pipe")
    found = {name: folder / name for name in names}
    for name in ("empty", "full", "list_policy"):
        found[name].mkdir()
    for file in (found["file"], folder / "file.onnx", found["full"] / "something"):
        file.touch()
    (found["list_policy"] / "policy.json").write_text("[1]")
    found["text"].write_text("not JSON")
    os.mkfifo(found["pipe"])
    for name, source in SOURCES.items():
        found[name] = folder / f"{name}.py"
        found[name].write_text(source)
    return found


def files_beside(places: dict[str, Path]) -> set[Path]:
    return {
        path for each in places.values() for path in each.parent.rglob("*") if "__pycache__" not in str(path)
    }


@pytest.mark.parametrize(("line", "words"), BAD, ids=[line[:60] for line, _ in BAD])
def test_one_line_says_what_is_right(line: str, words: str, places: dict[str, Path], capsys, monkeypatch):
    monkeypatch.setenv(VARIABLE, "")
    before = files_beside(places)
    assert main([word.format_map(places) for word in line.split()]) == 2
    output = capsys.readouterr()
    assert output.out == ""
    assert output.err.startswith("pixel2catch: error: ")
    assert words in output.err
    assert files_beside(places) == before


@pytest.mark.parametrize("name", COMMANDS)
def test_the_defaults_of_commands_are_valid(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    needed = {
        "scene": "x.xml",
        "record": "x --out new",
        "identify": "x --robot ur5e --out new",
        "replay": "x --out new",
        "trials": "--policies proposed",
        "track": "0",
        "operate": "/dev/input/event3",
    }
    parsed = parse([name, *needed.get(name, "").split()])
    assert type(parsed).__name__.lower() == name
    if name not in ("record", "identify"):  # their inputs are not there
        require_valid(parsed)


@pytest.mark.parametrize(
    ("line", "status", "words"),
    [
        ("scene scene.xml >/dev/full", 2, "pixel2catch: error: No space left on device"),  # without OpenGL
        ("evaluate >&-", 2, "standard output or error is closed"),  # before work
        ("stress --help", 0, "--axes"),  # in a narrow terminal without Unicode
    ],
)
def test_outputs_of_every_kind(line: str, status: int, words: str, tmp_path: Path):
    environment = os.environ | {"MUJOCO_GL": "none", "COLUMNS": "5", "PYTHONIOENCODING": "ascii"}
    command = f"{sys.executable} -m pixel2catch {line}"
    done = subprocess.run(command, shell=True, capture_output=True, text=True, cwd=tmp_path, env=environment)
    assert done.returncode == status, done.stderr
    assert words in done.stdout + done.stderr
