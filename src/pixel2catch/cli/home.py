"""`pixel2catch home`: move the robot slowly to its start pose."""

from contextlib import ExitStack
from dataclasses import dataclass, field, replace

from pixel2catch.cli.console import saying_changes
from pixel2catch.cli.link import Link
from pixel2catch.errors import DeploymentError
from pixel2catch.installation import needs_extra
from pixel2catch.interruption import StopRequest

QUARTER, EVEN = 0.25, 0.9
"""Limits of the servo over those of a catch, and speed of the motion over that which they permit."""


@dataclass(frozen=True, kw_only=True)
class Home:
    """Move the robot slowly to its start pose, and open the hand.

    The speed is at most a quarter of a catch's. Before anything moves, a path is found that keeps its
    distance from the table, the robot itself and other arms; without one the command ends with the reason.
    As with `deploy`, an operator arms and holds the dead-man's switch, and the same servo guards the robot.
    """

    link: Link = field(default_factory=Link)  #: The network of the robot, and the limits of its motion.

    def run(self) -> None:
        move_once(self.link, "to the start pose", "")


def move_once(link: Link, what: str, place: str | None) -> None:
    """Let the robot move over a place, "" for its start pose, or None to stay there, and open the hand."""
    with needs_extra("deployment"):
        from pixel2catch.deployment.follower import follow
        from pixel2catch.deployment.paths import PathFinder
        from pixel2catch.servo.status_words import sentence
    profile, slow = link.robot.load(), replace(link, speed=QUARTER * link.speed)
    limits = slow.limits(profile)
    finder, hear = PathFinder(profile, limits, EVEN), saying_changes()
    if place:
        finder.pose_over(place)  # refuses an unknown place before anything starts
    with ExitStack() as stack:
        connection = slow.connect(profile, limits, stack)
        stop = stack.enter_context(StopRequest())
        is_done = follow(
            lambda start: finder.motion(start, start if place is None else finder.pose_over(place)),
            what,
            connection,
            profile.operator.status,
            lambda: stop.is_set,
            lambda status: hear(sentence(status)),
        )
    if not is_done:
        raise DeploymentError(f"the robot did not move to the end, by {stop.by}.")
    print(f"{what}: done")
