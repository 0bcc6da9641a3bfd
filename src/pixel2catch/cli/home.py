"""`pixel2catch home`: move the robot slowly to its start pose."""

from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

from pixel2catch.cli.console import saying_changes
from pixel2catch.cli.link import Link
from pixel2catch.errors import DeploymentError
from pixel2catch.installation import needs_extra
from pixel2catch.interruption import StopRequest

if TYPE_CHECKING:
    from collections.abc import Callable

    from pixel2catch.deployment.paths import PathFinder
    from pixel2catch.servo.limits import Joints

QUARTER, EVEN = 0.25, 0.9
"""Limits of the servo over those of a catch, and speed of the motion over that which they permit."""


@dataclass(frozen=True, kw_only=True)
class Home:
    """Move the robot to its start pose, at a quarter of a catch's speed at most, and open the hand there.

    Before anything moves, a path is found that keeps its distance from the table, the robot itself and other
    arms; without one the command ends with the reason. As with `deploy`, an operator arms and holds the
    dead-man's switch, and the same servo guards the robot.
    """

    link: Link = field(default_factory=Link)  #: The network of the robot, and the limits of its motion.

    def run(self) -> None:
        """Find the path, wait for the operator, and move."""
        move_once(self.link, "to the start pose", lambda finder, _: finder.home)


def move_once(link: Link, what: str, goal_of: "Callable[[PathFinder, Joints], Joints]") -> None:
    """Let the robot move to the goal for a `PathFinder` and the measured pose [rad], and open the hand.

    Raises:
        DeploymentError: It did not move to the end.
    """
    with needs_extra("deployment"):
        from pixel2catch.deployment.follower import follow
        from pixel2catch.deployment.paths import PathFinder
        from pixel2catch.servo.status_words import sentence
    profile, slow = link.robot.load(), replace(link, speed=QUARTER * link.speed)
    limits = slow.limits(profile)
    finder, hear = PathFinder(profile, limits, EVEN), saying_changes()
    with ExitStack() as stack:
        connection = slow.connect(profile, limits, stack)
        stop = stack.enter_context(StopRequest())
        is_done = follow(
            lambda start: finder.motion(start, goal_of(finder, start)),
            what,
            connection,
            profile.operator.status,
            lambda: stop.is_set,
            lambda status: hear(sentence(status)),
        )
    if not is_done:
        raise DeploymentError(f"the robot did not move to the end, by {stop.by}.")
    print(f"{what}: done")
