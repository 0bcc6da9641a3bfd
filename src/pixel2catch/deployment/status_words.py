"""A status of the deployment in plain words: what the robot does, what is wrong, what to do next."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from math import inf
from typing import Any, Literal

from pixel2catch.perception.plausibility import Verdict
from pixel2catch.servo.fault_words import fault_words

Tone = Literal[
    "absent", "waiting", "armed", "moving", "stopped"
]  #: What a state means to whoever stands beside it.

USUAL = (
    *("dead man", "image stale", "policy late", "target not finite", "target far"),
    *("object lost", "perception unsound"),
)
"""What a servo may find that waits to be armed: nobody holds the switch, and no policy speaks to it yet."""

REARM = "Let go of the switch, hold it again, and press arm."  #: How a stop ends.

SIGHT: dict[str, str] = {
    Verdict.SEEN: "sees the object",
    Verdict.NO_IMAGE: "gets no image",
    Verdict.REPEATED: "waits for the next image",
    Verdict.BAD_IMAGE: "cannot read the image",
    Verdict.NO_PROMPT: "does not know the object yet: point at it",
    Verdict.NOT_FOUND: "has lost the object: point at it",
    Verdict.FAILED: "failed at this image",
    Verdict.TOO_SMALL: "sees something too small",
    Verdict.TOO_LARGE: "sees something too large",
    Verdict.JUMP: "sees something that jumps",
    Verdict.BORDER: "sees something at the image's border",
}
"""What perception does, by the verdict on its newest image."""


@dataclass(frozen=True, kw_only=True)
class StatusWords:
    """A status as an operator reads it."""

    tone: Tone
    headline: str  #: What the robot does, and why.
    advice: tuple[str, ...] = ()  #: What to do, in sentences.

    @property
    def text(self) -> str:
        """All of it in a line."""
        return " ".join((f"{self.headline}.", *self.advice))


ABSENT = StatusWords(
    tone="absent", headline="nothing is heard of a deployment", advice=("Start 'pixel2catch deploy'.",)
)
RESTING = StatusWords(tone="moving", headline="resting: goes on when the object is seen again")
MODES = {
    "": ABSENT,
    "several": StatusWords(
        tone="stopped",
        headline="several programs say what the deployment does, and nobody knows which is right",
        advice=("End all but one; a program that was killed counts for 10 s.",),
    ),
    "starting": StatusWords(tone="waiting", headline="starting: the servo process comes up"),
    "armed": StatusWords(
        tone="armed", headline="armed: holds its pose until the object is seen", advice=("Point at it.",)
    ),
    "ramp": StatusWords(tone="moving", headline="beginning: goes over to what the policy wants"),
    "run": StatusWords(tone="moving", headline="running: follows the policy"),
}
"""Modes that need no reason."""


def status_words(status: dict[str, Any]) -> StatusWords:
    """Say what a status means; an empty one is that nobody was heard of."""
    mode = str(status.get("mode", ""))
    if mode == "idle":
        return _idle(_names(status, "found"), status.get("verdict"))
    if mode == "stopped":
        reasons = _names(status, "stopped_by")
        fixes = _fixes(name for name in reasons if name != "dead man")
        return StatusWords(tone="stopped", headline=f"stopped: {_what(reasons)}", advice=(*fixes, REARM))
    if mode == "run" and status.get("object") == "searching":
        return RESTING
    return MODES.get(mode, StatusWords(tone="waiting", headline=mode))


def _idle(found: Sequence[str], verdict: object) -> StatusWords:
    """A robot that waits to be armed, or cannot be, by what is found and the verdict on the newest image."""
    unseen = ["image stale"] if verdict == Verdict.NO_IMAGE else []
    if missing := [*unseen, *(name for name in found if name not in USUAL)]:
        return StatusWords(tone="waiting", headline=f"not ready: {_what(missing)}", advice=_fixes(missing))
    told = "hold the switch and press arm" if "dead man" in found else "the switch is held; press arm"
    return StatusWords(tone="waiting", headline=f"waiting: {told}")


def sight_words(status: dict[str, Any]) -> str:
    """What perception does, by its newest look; empty if it has not looked yet."""
    verdict = status.get("verdict")
    return f"perception {SIGHT.get(str(verdict), str(verdict))}" if verdict else ""


def refusal_words(status: dict[str, Any]) -> str:
    """Why a request to arm was refused; empty if none was."""
    refused = _names(status, "refused")
    if "dead man" in refused:
        refused = [name for name in refused if name != "switch not pressed"]  # who holds it presses it
    return " ".join((f"Arming was refused: {_what(refused)}.", *_fixes(refused))) if refused else ""


def latencies(status: dict[str, Any]) -> dict[str, float]:
    """Times from image to command by their names, such as "p50", or of the newest [ms], as far as told."""
    said = status.get("latency_ms")
    named = said if isinstance(said, dict) else {"newest": said}
    return {
        str(name): round(float(value), 1)
        for name, value in named.items()
        if name != "count" and isinstance(value, int | float) and 0.0 <= value < inf
    }


def sentence(status: dict[str, Any]) -> str:
    """A status in a line, without what changes in every control step; at a stop the latencies so far."""
    parts = [status_words(status).text, refusal_words(status)]
    if status.get("mode") == "stopped" and (times := latencies(status)):
        listed = ", ".join(f"{name} {time:.0f}" for name, time in times.items())
        parts.append(f"From image to command: {listed} ms.")
    return " ".join(part for part in (*parts, status.get("message", "")) if part)


def _names(status: dict[str, Any], key: str) -> list[str]:
    """Names of faults in a status, of which nobody knows who wrote it."""
    said = status.get(key)
    return [str(name) for name in said] if isinstance(said, list) else []


def _what(names: Sequence[str]) -> str:
    return "; ".join(fault_words(name).what for name in names) or "nobody says why"


def _fixes(names: Iterable[str]) -> tuple[str, ...]:
    """What to do about faults, each thing once."""
    return tuple(dict.fromkeys(fix for name in names if (fix := fault_words(name).fix)))
