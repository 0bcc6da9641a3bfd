"""The benchmark of latency as it is run: a recording, a deployment with its servo, DDS and real time."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from domains import PATIENCE, own_domain
from pixel2catch.cli.main import main
from pixel2catch.deployment.statistics import STAGES

BENCHMARK = Path(__file__).parents[2] / "benchmarks" / "latency.py"


@pytest.mark.slow
def test_where_the_time_goes_is_measured_and_drawn(tmp_path: Path):
    """On a busy machine an image may come too late for its step; then it is as old as it is."""
    recording, figures = tmp_path / "tape", tmp_path / "figures.json"
    rehearsal = ["rehearse", "--lockstep", "--plain", "--throws", "1", "--record", str(recording)]
    assert main([*rehearsal, "--out", str(tmp_path / "rehearsal")]) == 0
    tick = [sys.executable, str(BENCHMARK.with_name("servo_tick.py")), str(recording)]
    assert "p50" in subprocess.run(tick, check=True, capture_output=True, text=True, timeout=PATIENCE).stdout
    asked = [sys.executable, str(BENCHMARK), str(recording), "--passes", "1", "--clock", "0.5"]
    said = subprocess.run(
        [*asked, "--json", str(figures)],
        env={**os.environ, "ROS_DOMAIN_ID": own_domain()},
        check=True,
        capture_output=True,
        text=True,
        timeout=PATIENCE,
    ).stdout
    deploy = json.loads(figures.read_text())["deploy"]
    assert deploy["num_ticks"] > 100
    if deploy["image_to_command_ms"]:  # the robot was armed, and the object seen
        ages = [deploy["stages_ms"][name]["p50"] for name in STAGES]
        assert ages == sorted(ages)
        assert sum(deploy["image_to_command_ms"]["by_ms"]) == deploy["image_to_command_ms"]["count"]
        assert "commanded" in said
        assert "#" in said
