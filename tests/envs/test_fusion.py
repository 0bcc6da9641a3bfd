"""torch.compile changes the number of kernels of a control step, and nothing else."""

import subprocess
import sys
from pathlib import Path

import pytest


@pytest.mark.parametrize(
    "device", [pytest.param("cpu", marks=pytest.mark.slow), pytest.param("cuda", marks=pytest.mark.gpu)]
)
def test_a_fused_control_step_is_the_same_and_is_traced_once(device):
    program = Path(__file__).parent / "fused_steps.py"
    subprocess.run([sys.executable, "-W", "error", program, device], check=True, timeout=600)


def test_without_a_compiler_nothing_is_written(tmp_path: Path, monkeypatch, refusal):
    args = ["train", "--preset", "cpu", "--num-envs", "4", "--mini-batches", "1", "--fuse", "--out", "run"]
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PATH", "/nonexistent")
    assert "g++" in refusal(*args)
    assert not (tmp_path / "run").exists()
