"""What `deploy` and `operate` say of a status."""

from typing import Any

from pixel2catch.cli.deploy import sentence

STATUS: dict[str, Any] = {"stopped_by": [], "refused": [], "found": [], "message": ""}
LATENCY = {"p50": 22.4, "p90": 23.1, "p99": 30.6, "max": 36.5, "count": 303}


def test_the_latency_is_said_when_the_robot_has_stopped():
    stopped = {**STATUS, "mode": "stopped", "stopped_by": ["stop request"], "latency_ms": LATENCY}
    assert (
        sentence(stopped) == "stopped; stopped by stop request; image to command [ms]: p50 22, p90 23, p99 31"
    )


def test_it_is_not_while_it_changes():
    assert sentence({**STATUS, "mode": "run", "latency_ms": LATENCY}) == "run"
    assert sentence({**STATUS, "mode": "stopped", "latency_ms": None}) == "stopped"
