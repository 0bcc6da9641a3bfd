"""Trainings in two processes: they learn as one, tell one story, and end together."""

import json
import os
import signal
import socket
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from reaching import CONTRACT, SMALL, ReachingEnv, rows, summary

from domains import PATIENCE
from pixel2catch.cli.main import main
from pixel2catch.errors import DeviceUnavailableError, InvalidValueError
from pixel2catch.learning.distributed import Workers, start_workers
from pixel2catch.learning.train import train
from pixel2catch.policy import Policy

PATHS = [str(Path(__file__).parent), str(Path(__file__).parents[2] / "src"), *sys.path]
needs_two_gpus = pytest.mark.skipif(torch.cuda.device_count() < 2, reason="needs two CUDA devices")
SCRIPT = str(Path(__file__).parent / "two_processes.py")


def start(*arguments: str | Path, **environment: str) -> subprocess.Popen[str]:
    known = {"PYTHONPATH": os.pathsep.join(PATHS), "OMP_NUM_THREADS": "1", "PYTHONUNBUFFERED": "1"}
    return subprocess.Popen(
        [sys.executable, *map(str, arguments)],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env=os.environ | known | environment,
    )


def pair(*arguments: str | Path) -> list[tuple[int, str]]:
    """Exit status and output of two processes in the environment of torchrun, which starts slowly itself."""
    with socket.create_server(("127.0.0.1", 0)) as one, socket.create_server(("127.0.0.1", 0)) as other:
        ports = {"MASTER_PORT": str(one.getsockname()[1]), "NEXT_PORT": str(other.getsockname()[1])}
    common = {"TORCHELASTIC_RUN_ID": "test", "WORLD_SIZE": "2", "MASTER_ADDR": "127.0.0.1", **ports}
    processes = [start(*arguments, RANK=rank, LOCAL_RANK=rank, **common) for rank in "01"]
    outputs = [process.communicate(timeout=PATIENCE)[0] for process in processes]
    return [(process.returncode, output) for process, output in zip(processes, outputs, strict=True)]


@pytest.mark.gpu
@needs_two_gpus
def test_two_devices_learn_as_one(tmp_path: Path) -> None:
    outcomes = pair(SCRIPT, "update", tmp_path, "cuda")
    assert [status for status, _ in outcomes] == [0, 0], outcomes
    assert sorted(path.name for path in tmp_path.iterdir()) == ["checked0", "checked1"]


def test_two_processes_learn_as_one_and_an_error_in_one_ends_both(tmp_path: Path) -> None:
    """The checks of learning are in the processes: `two_processes.py`.

    The first tells what befell the second; before that, the episodes of both were counted.
    """
    (status, output), second = pair(SCRIPT, "update fail", tmp_path, "cpu")
    assert {path.name for path in tmp_path.glob("checked*")} == {"checked0", "checked1"}, output
    assert status == 1
    assert "WorkerError: process 1: NaN or infinity in reward of agent 'hand'" in output
    assert second == (0, "")
    assert summary(tmp_path / "run")["status"] == "failed"
    counts = [json.loads(path.read_text()) for path in tmp_path.glob("seed*.json")]
    assert [count["num_envs"] for count in counts] == [32, 32]
    assert counts[0]["noise"] != counts[1]["noise"]
    assert [float(row["episodes"]) for row in rows(tmp_path / "run")] == [sum(c["episodes"] for c in counts)]


def test_the_command_writes_one_run_which_one_process_resumes(tmp_path: Path) -> None:
    run = tmp_path / "run"
    size = ("--num-envs", "8", "--rollout-steps", "4", "--hidden", "16", "--checkpoint-seconds", "0")
    command = ("train", "proposed", "--device", "cpu", *size, "--out", str(run))
    outcomes = pair("-m", "pixel2catch", *command, "--transitions", "64")
    assert [status for status, _ in outcomes] == [0, 0], outcomes
    assert str(outcomes).count("finished: 64 transitions") == 1
    assert len(list(run.glob("events.out.tfevents.*"))) == 1
    assert json.loads((run / "config.json").read_text())["train"]["num_envs"] == 8
    assert main([*command, "--transitions", "96", "--resume"]) == 0
    assert [row["transitions"] for row in rows(run)] == ["32", "64", "96"]
    sessions = json.loads((run / "sessions.json").read_text())
    assert [session["processes"] for session in sessions] == [2, 1]
    assert Policy.load(run / "policy").hidden == (16,)


@pytest.mark.slow
def test_interruption(tmp_path: Path) -> None:
    """Ctrl-C reaches torchrun, which passes it on: both leave after the same update, and it can go on."""
    torchrun = ("-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2")
    process = start(*torchrun, SCRIPT, "endless", tmp_path, "cpu")
    assert process.stdout is not None
    while "transitions" not in process.stdout.readline():
        pass
    process.send_signal(signal.SIGINT)
    output, _ = process.communicate(timeout=PATIENCE)
    assert output.count("go on with --resume") == 1, output
    ended = [json.loads((tmp_path / f"{rank}.json").read_text()) for rank in range(2)]
    transitions = summary(tmp_path / "run")["transitions"]
    assert ended == [["interrupted", transitions]] * 2
    cfg = replace(SMALL, transitions=transitions + 1024)
    resumed = train(cfg, ReachingEnv, CONTRACT, tmp_path / "run", resume=True)
    assert resumed.transitions == transitions + 1024


def test_shares() -> None:
    """Environments are split; seeds differ between processes and trainings; the first keeps its own."""
    shares = [Workers(rank, 4, "cpu").share(SMALL) for rank in range(4)]
    assert [share.num_envs for share in shares] == [16] * 4
    other = replace(SMALL, seed=1)
    seeds = [share.seed for share in shares] + [Workers(r, 4, "cpu").share(other).seed for r in range(4)]
    assert len(set(seeds)) == 8
    assert (seeds[0], seeds[4]) == (0, 1)
    assert Workers().share(SMALL) == SMALL
    with pytest.raises(InvalidValueError, match=r"num_envs is 64; .* multiple of 3, such as 66"):
        Workers(0, 3, "cpu").share(SMALL)


def test_exploration_differs_between_processes_and_after_a_resume() -> None:
    draws = []
    for rank, transitions in ((0, 0), (1, 0), (1, 1024), (0, 1024)):
        torch.manual_seed(5)
        Workers(rank, 2, "cpu").diverge(5, transitions)
        draws.append(float(torch.rand(())))
    assert len(set(draws)) == 3
    assert draws[0] == draws[3]


def test_devices_of_several_processes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    for name, value in {"TORCHELASTIC_RUN_ID": "x", "WORLD_SIZE": "4", "LOCAL_RANK": "3"}.items():
        monkeypatch.setenv(name, value)
    with pytest.raises(InvalidValueError, match="one device for several processes; use 'cuda'"):
        start_workers("cuda:1").__enter__()
    with pytest.raises(DeviceUnavailableError, match="use cuda:0 to cuda:1"):
        start_workers("cuda").__enter__()
