"""A status in plain words: every fault has some, and so has every mode and verdict."""

import re
from typing import Any

import pytest

from pixel2catch.deployment.status_words import SIGHT, latencies, refusal_words, sentence, status_words
from pixel2catch.perception.plausibility import Verdict
from pixel2catch.servo.fault_words import FAULT_WORDS, FaultWords, fault_words
from pixel2catch.servo.flags import Fault, Mode, flag_names

FAULTS = flag_names(Fault, ~0)
CAMERA = "Check the camera and its cable, and that its clock is synchronised."


def status(mode: str, **said: Any) -> dict[str, Any]:
    return {"mode": mode, "stopped_by": [], "refused": [], "found": [], "message": ""} | said


@pytest.mark.parametrize("name", FAULTS)
def test_every_fault_has_words(name: str):
    words = FAULT_WORDS[name]
    assert re.fullmatch(r"[a-z].*[^.]", words.what), words.what
    assert re.fullmatch(r"([A-Z].*\.)?", words.fix), words.fix


def test_a_fault_that_is_not_known_is_called_by_its_name():
    assert fault_words("arm frozen") == FaultWords(what="arm frozen", fix="")
    told = status_words(status("stopped", stopped_by=["arm frozen"]))
    assert told.headline == "stopped: arm frozen"


def test_every_mode_and_verdict_has_words():
    modes = ["", "starting", *(mode.name.lower() for mode in Mode)]
    headlines = [status_words(status(mode)).headline for mode in modes]
    assert len({*headlines}) == len(modes)
    assert not {*headlines} & {*modes}
    assert SIGHT.keys() == {*Verdict}


@pytest.mark.parametrize(
    ("said", "expected"),
    [
        (
            status("idle", found=["dead man", "image stale", "policy late", "target not finite"]),
            "waiting: hold the switch and press arm.",
        ),
        (status("idle", found=["policy late"]), "waiting: the switch is held; press arm."),
        (
            status("idle", found=["dead man", "image stale"], verdict="no image"),
            f"not ready: no image for 0.1 s. {CAMERA}",
        ),
        (status("run"), "running: follows the policy."),
        (status("run", object="seen"), "running: follows the policy."),
        (status("run", object="searching"), "resting: goes on when the object is seen again."),
        (
            status("stopped", stopped_by=["image stale"]),
            f"stopped: no image for 0.1 s. {CAMERA} Let go of the switch, hold it again, and press arm.",
        ),
        (
            status("stopped", stopped_by=["dead man"]),
            "stopped: the dead-man's switch is not held. Let go of the switch, hold it again, and press arm.",
        ),
        (
            status("idle", refused=["dead man"]),
            "waiting: the switch is held; press arm. "
            "Arming was refused: the dead-man's switch is not held. Hold the switch.",
        ),
        (status("run", message="the camera is off"), "running: follows the policy. the camera is off"),
    ],
)
def test_a_status_in_a_line(said: dict[str, Any], expected: str):
    assert sentence(said) == expected


def test_a_status_of_anybody_has_words():
    for mode in ("idle", "stopped", ["run"], {}):
        assert sentence({"mode": mode, "found": 5, "stopped_by": "all", "refused": [[1]], "latency_ms": "x"})


def test_nothing_is_said_of_a_request_that_was_granted():
    assert refusal_words(status("armed")) == ""


def test_latencies_are_those_that_are_numbers():
    told = {"p50": 21.04, "p99": 40, "max": None, "count": 9, "p90": "x"}
    assert latencies({"latency_ms": told}) == {"p50": 21.0, "p99": 40.0}
    assert latencies({"latency_ms": 30.55}) == {"newest": 30.6}
    for value in (None, float("nan"), [1], -1.0):
        assert latencies({"latency_ms": value}) == {}
    stopped = status("stopped", stopped_by=["stop request"], latency_ms=told)
    assert sentence(stopped).endswith("From image to command: p50 21, p99 40 ms.")
