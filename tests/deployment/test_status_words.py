"""Words of a status: every fault, mode and verdict has some."""

from typing import Any

import pytest

from pixel2catch.camera.image import Verdict
from pixel2catch.servo.link import Fault, Mode, flag_names
from pixel2catch.servo.status_words import FAULT_WORDS, VERDICTS, latencies, sentence, status_words

CAMERA = "Check the camera, its cable and its clock."


def status(mode: str, **others: Any) -> dict[str, Any]:
    return {"mode": mode, "stopped_by": [], "refused": [], "found": [], "message": ""} | others


def test_every_fault_mode_and_verdict_has_words():
    assert FAULT_WORDS.keys() == {*flag_names(Fault, ~0)}
    assert VERDICTS.keys() == {*Verdict}
    modes = ["", "starting", *(mode.name.lower() for mode in Mode)]
    headlines = {status_words(status(mode)).headline for mode in modes}
    assert len(headlines) == len(modes)
    assert not headlines & {*modes}


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        (
            status("idle", found=["dead man", "image stale", "policy late", "target not finite"]),
            "waiting: hold the switch and press arm.",
        ),
        (
            status("idle", found=["dead man", "image stale"], verdict="no image"),
            f"not ready: no image for 0.1 s. {CAMERA}",
        ),
        (status("run", object="searching"), "resting: goes on when the object is seen again."),
        (
            status("stopped", stopped_by=["image stale"]),
            f"stopped: no image for 0.1 s. {CAMERA} Let go of the switch, hold it again, and press arm.",
        ),
        (
            status("idle", refused=["dead man", "switch not pressed"]),
            "waiting: the switch is held; press arm. "
            "Arming was refused: the dead-man's switch is not held. Hold the switch.",
        ),
        (status("run", message="the camera is off"), "running: follows its targets. the camera is off"),
    ],
)
def test_a_status_as_one_line(given: dict[str, Any], expected: str):
    assert sentence(given) == expected


def test_an_unknown_fault_keeps_its_name_and_a_stop_adds_the_latencies():
    times = {"p50": 21.04, "p99": 40, "count": 9}
    assert latencies({"latency_ms": times}) == {"p50": 21.0, "p99": 40.0}
    line = sentence(status("stopped", stopped_by=["arm frozen"], latency_ms=times))
    assert line.startswith("stopped: arm frozen")
    assert line.endswith("From image to command: p50 21, p99 40 ms.")
