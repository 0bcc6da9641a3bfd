"""States, faults and verdicts in words, for operators: commands, pages and reports use this one file."""

import re
from collections.abc import Iterable, Sequence
from typing import Any, Literal, NamedTuple

Tone = Literal["absent", "waiting", "armed", "moving", "stopped"]  #: Colour class of a state on a page.

_FAULTS = """
clock: the servo process was delayed by 20 ms | End other programs, or give the servo its own core.
joints stale: no new position of a joint has arrived in time | Check drivers, cables and joint names.
joints not finite: a joint position is missing or not a number | Check drivers and joint names.
image stale: no image for 0.1 s | Check the camera, its cable and its clock.
policy late: no decision of the policy for 67 ms
    | Point at the object. If that does not help, end other programs: perception is too slow.
target not finite: the policy gives a target that is not a number | Use another policy.
target far: the first target of the policy is far from the robot | Move the robot to its start pose.
tracking error: a joint does not follow its command
    | Check whether something blocks the robot. If not, identify its dynamics.
safety mode: the robot is not in its normal safety mode, or its program does not run
    | Correct this on the robot's pendant.
speed scaling: the robot runs below its full speed | Set the speed slider of the pendant to 100 %.
other publisher: another program sends commands to the robot; this one is silent | End the other one.
dead man: the dead-man's switch is not held | Hold the switch.
stop request: a stop was requested
start pose: the robot is not at the start of its commands | Move the robot to its start pose.
workspace: hand or elbow are outside the workspace | Move the robot to its start pose.
still stopping: the robot is still stopping | Wait until it stands.
joints implausible: a measured joint position is beyond the joint's range, or jumped too far
    | Check encoders, cables and the joint names in the profile.
joint speed: a joint was faster than its limit
    | Check whether something else moves the robot, and its payload setting; or lower the speed.
other operator: two programs hold the switch or request arming
    | End one of them; a program that was killed counts for 10 s.
switch not pressed: the switch was not pressed again since the last stop | Let go of it, press it again.
object lost: the object was not seen for 3 s | Show it to the camera, and point at it after arming.
perception unsound: the images cannot come from one working camera
    | Restart the camera's driver, or end the other camera or recording.
status unknown: the state of the robot is published by no driver, or by several
    | Check that the robot's driver runs, and that no recording is played.
no subscriber: no driver receives the commands | Start it; check the command topics in the profile.
other subscriber: several programs receive the commands | End all except the driver.
controller: the controller that receives the commands is not active | Activate it with 'ros2 control'.
joints frozen: measured joint positions do not change while the joints are commanded to move
    | Check the encoders and the driver: positions must not be repeated.
commands ignored: the driver of the arm ignores the commands
    | Its cycles slip: give driver and servo cores of their own, or raise missed_cycles in the profile.
hand astray: a finger does not follow its command, and nothing can hold it yet
    | Check power and driver of the hand, and order, sign and scale of its joints in the profile.
"""
"""Names of `Fault`: what is wrong, which ends a sentence "stopped: ..." | what to do, in sentences."""

FAULT_WORDS = {
    name: (wrong, fix)
    for name, wrong, fix in re.findall(r"^(\w[\w ]*): (.+?)(?:\s+\| (.+))?$", _FAULTS, re.MULTILINE)
}

EXPECTED_WHEN_IDLE = {
    *("dead man", "image stale", "policy late", "target not finite", "target far"),
    *("object lost", "perception unsound"),
}
"""Faults before arming that need no repair: the switch is not held, the policy sends no targets."""

REARM = "Let go of the switch, hold it again, and press arm."  #: How a stop ends.

VERDICTS = {
    "seen": "sees the object",
    "no image": "gets no image",
    "repeated image": "waits for the next image",
    "bad image": "cannot read the image",
    "no prompt": "has no object yet: point at it",
    "not found": "has lost the object: point at it",
    "segmenter failed": "failed on this image",
    "too small": "sees something too small",
    "too large": "sees something too large",
    "jump": "sees something that jumps",
    "border": "sees something at the image's border",
}
"""What perception does, by its `Verdict` on the newest image."""


class StatusWords(NamedTuple):
    """The status of a deployment in words."""

    tone: Tone
    headline: str  #: What the robot does, and why.
    advice: tuple[str, ...] = ()  #: What to do, in sentences.


_KILLED = "End all but one; a program that was killed counts for 10 s."

MODES = {
    "": StatusWords("absent", "no status of a deployment is received", ("Start 'pixel2catch deploy'.",)),
    "several": StatusWords("stopped", "several programs publish the status of the deployment", (_KILLED,)),
    "starting": StatusWords("waiting", "starting: the servo process starts"),
    "armed": StatusWords("armed", "armed: holds its pose until there is a target", ("Point at the object.",)),
    "ramp": StatusWords("moving", "beginning: moves to the first target"),
    "run": StatusWords("moving", "running: follows its targets"),
}
"""Words of the modes that need no reason; "" without a status, "several" with more than one publisher."""


def status_words(status: dict[str, Any]) -> StatusWords:
    """Return the words of a status message; an empty one means that there is no deployment."""
    mode = str(status.get("mode", ""))
    if mode == "idle":
        return _idle_words(status.get("found", []), status.get("verdict"))
    if mode == "stopped":
        reasons = status.get("stopped_by", [])
        fixes = _fixes(name for name in reasons if name != "dead man")
        return StatusWords("stopped", f"stopped: {_what(reasons)}", (*fixes, REARM))
    if mode == "run" and status.get("object") == "searching":
        return StatusWords("moving", "resting: goes on when the object is seen again")
    return MODES.get(mode, StatusWords("waiting", mode))


def _idle_words(found: Sequence[str], verdict: object) -> StatusWords:
    unseen = ["image stale"] if verdict == "no image" else []
    if missing := [*unseen, *(name for name in found if name not in EXPECTED_WHEN_IDLE)]:
        return StatusWords("waiting", f"not ready: {_what(missing)}", _fixes(missing))
    request = "hold the switch and press arm" if "dead man" in found else "the switch is held; press arm"
    return StatusWords("waiting", f"waiting: {request}")


def verdict_words(status: dict[str, Any]) -> str:
    """Return what perception does; empty before its first image."""
    verdict = status.get("verdict")
    return f"perception {VERDICTS.get(str(verdict), str(verdict))}" if verdict else ""


def refusal_words(status: dict[str, Any]) -> str:
    """Return why a request to arm was refused; empty if none was."""
    refused = status.get("refused", [])
    if "dead man" in refused:
        refused = [name for name in refused if name != "switch not pressed"]  # "hold the switch" is enough
    return " ".join((f"Arming was refused: {_what(refused)}.", *_fixes(refused))) if refused else ""


def latencies(status: dict[str, Any]) -> dict[str, float]:
    """Return the percentiles of the time from image to command [ms] that a status has, such as "p50"."""
    found = status.get("latency_ms") or {}
    return {name: round(value, 1) for name, value in found.items() if name != "count"}


def sentence(status: dict[str, Any]) -> str:
    """Return a status as one line that changes only with the state; a stop adds the latencies so far."""
    words = status_words(status)
    parts = [f"{words.headline}.", *words.advice, refusal_words(status)]
    if status.get("mode") == "stopped" and (times := latencies(status)):
        listed = ", ".join(f"{name} {time:.0f}" for name, time in times.items())
        parts.append(f"From image to command: {listed} ms.")
    return " ".join(part for part in (*parts, status.get("message", "")) if part)


def fault_words(name: str) -> tuple[str, str]:
    """Return what is wrong and what to do; an unknown fault keeps its name."""
    return FAULT_WORDS.get(name, (name, ""))


def _what(names: Sequence[str]) -> str:
    return "; ".join(fault_words(name)[0] for name in names) or "no reason was given"


def _fixes(names: Iterable[str]) -> tuple[str, ...]:
    return tuple(dict.fromkeys(filter(None, (fault_words(name)[1] for name in names))))
