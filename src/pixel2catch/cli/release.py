"""`pixel2catch release`: open the hand slowly, where it is or over a place."""

from dataclasses import dataclass, field
from typing import Annotated

from tyro.conf import Positional

from pixel2catch.checks import NOT_EMPTY
from pixel2catch.cli.home import move_once
from pixel2catch.cli.link import Link


@dataclass(frozen=True, kw_only=True)
class Release:
    """Open the hand slowly, where it is or over a place.

    On the way to a place the fingers keep their hold. Path, speed and operator are as with `home`.
    """

    #: Name of a place under `places` in the profile. Default: here.
    place: Positional[Annotated[str, NOT_EMPTY] | None] = None
    link: Link = field(default_factory=Link)  #: The network of the robot, and the limits of its motion.

    def run(self) -> None:
        move_once(self.link, f"release over {self.place}" if self.place else "release", self.place)
