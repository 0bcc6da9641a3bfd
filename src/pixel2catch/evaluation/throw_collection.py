"""What a report shows of the single throws of an evaluation: where they come down, and examples."""

from collections.abc import Sequence
from dataclasses import dataclass, field

from jaxtyping import Float
from numpy import ndarray

from pixel2catch.mdp.throws import ThrowCfg
from pixel2catch.rendering.camera import OBJECT_POS, OBJECT_VEL
from pixel2catch.rendering.storyboard import RecordedThrow
from pixel2catch.scene.constants import GRAVITY


@dataclass(kw_only=True)
class ThrowCollection:
    """Filled by giving its `add` to `assess`."""

    landings: dict[str, list[Float[ndarray, "2"]]] = field(default_factory=dict)  #: By outcome [m].
    examples: dict[str, RecordedThrow] = field(default_factory=dict)  #: The first throw of each outcome.

    def add(self, throws: Sequence[RecordedThrow]) -> None:
        """Take a round's throws."""
        for throw in throws:
            self.landings.setdefault(throw.outcome, []).append(landing(throw, sum(ThrowCfg().aim_z) / 2.0))
            self.examples.setdefault(throw.outcome, throw)


def landing(throw: RecordedThrow, height: float) -> Float[ndarray, "2"]:
    """Where a throw would come down through a height, without air: x and y [m].

    A throw that never gets there counts as coming down where it is highest.
    """
    pos, vel = throw.qpos[throw.release, OBJECT_POS], throw.qvel[throw.release, OBJECT_VEL]
    root = max(vel[2] ** 2 + 2.0 * GRAVITY * (pos[2] - height), 0.0) ** 0.5
    return pos[:2] + vel[:2] * (vel[2] + root) / GRAVITY
