"""What each fault is in plain words, and what a person does about it: for pages, commands and reports."""

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class FaultWords:
    """A fault as an operator reads it."""

    what: str  #: What is wrong, as the end of "stopped: ...".
    fix: str  #: What to do, in sentences; empty if there is nothing to say.


FAULT_WORDS = {
    "clock": FaultWords(
        what="the servo process was held up for 20 ms",
        fix="End other programs on this machine, or give the servo a core of its own.",
    ),
    "joints stale": FaultWords(
        what="a joint has not told its position in time",
        fix="Check the robot's and the hand's driver, their cables, and the joint names in the profile.",
    ),
    "joints not finite": FaultWords(
        what="a joint's position is missing, or is no number",
        fix="Check that both drivers run, and the joint names in the profile.",
    ),
    "image stale": FaultWords(
        what="no image for 0.1 s",
        fix="Check the camera and its cable, and that its clock is synchronised.",
    ),
    "policy late": FaultWords(
        what="the policy has decided nothing for 67 ms",
        fix="Point at the object. If that does not help, end other programs: perception is too slow.",
    ),
    "target not finite": FaultWords(
        what="the policy asks for something that is no number",
        fix="Take another policy, and tell who trained this one.",
    ),
    "target far": FaultWords(
        what="the policy begins far from where the robot is", fix="Move the robot to its start pose."
    ),
    "tracking error": FaultWords(
        what="a joint is not where its servo should have it",
        fix="See whether something holds the robot; else identify its dynamics.",
    ),
    "safety mode": FaultWords(
        what="the robot is not in its normal safety mode, or its program does not run",
        fix="Mend that at the robot's pendant.",
    ),
    "speed scaling": FaultWords(
        what="the robot runs below its full speed", fix="Set the speed slider of the pendant to 100 %."
    ),
    "other publisher": FaultWords(
        what="another program sends commands to the robot, and this one has fallen silent",
        fix="End the other program.",
    ),
    "dead man": FaultWords(what="the dead-man's switch is not held", fix="Hold the switch."),
    "stop request": FaultWords(what="somebody asked to stop", fix=""),
    "start pose": FaultWords(
        what="the robot is not where its commands would begin", fix="Move the robot to its start pose."
    ),
    "workspace": FaultWords(
        what="hand or elbow are where they must not be", fix="Move the robot to its start pose."
    ),
    "still stopping": FaultWords(what="the robot is still stopping", fix="Wait until it stands."),
    "joints implausible": FaultWords(
        what="a joint is measured beyond its travel, or jumped further than it can",
        fix="Check encoders, cables and the joint names in the profile.",
    ),
    "joint speed": FaultWords(
        what="a joint was faster than it may be",
        fix="See what else moves the robot, and whether its payload is set; else lower the speed.",
    ),
    "other operator": FaultWords(
        what="two programs hold the switch or ask to arm",
        fix="End one of them; a program that was killed counts for 10 s.",
    ),
    "switch not pressed": FaultWords(
        what="since the last stop the switch has not been let go and pressed anew",
        fix="Let go of the switch, and press it again.",
    ),
    "object lost": FaultWords(
        what="the object has not been seen for 3 s", fix="Show it to the camera, and point at it once armed."
    ),
    "perception unsound": FaultWords(
        what="the images cannot be those of one camera that sees",
        fix="Restart the camera's driver, or end the other camera or recording.",
    ),
    "status unknown": FaultWords(
        what="no driver says how the robot is, or several do",
        fix="Check that the robot's driver runs, and that nothing plays a recording.",
    ),
    "no subscriber": FaultWords(
        what="nobody takes the commands of the robot or the hand",
        fix="Start the driver, and check the command topics in the profile.",
    ),
    "other subscriber": FaultWords(
        what="several programs take the commands of the robot or the hand", fix="End all but the driver."
    ),
    "controller": FaultWords(
        what="the controller that takes the commands is not active", fix="Activate it with 'ros2 control'."
    ),
    "joints frozen": FaultWords(
        what="joints are measured at one place while they are commanded to move",
        fix="Check the encoders and the driver: positions must not be repeated.",
    ),
}
"""Of every fault by its name, as a status has it."""


def fault_words(name: str) -> FaultWords:
    """The words of a fault; its name, if it is not known here."""
    return FAULT_WORDS.get(name, FaultWords(what=name, fix=""))
