"""Single throws of an evaluation: their states, their outcomes, and where they come down."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from pixel2catch.mdp.throws import ThrowCfg
from pixel2catch.scene.constants import GRAVITY, OBJECT_POS, OBJECT_VEL

FLIGHT_SPEED = 1.0  #: The object flies from this speed on [m/s]. Source: ours.
CAUGHT, LOST = "caught", "lost"
OUTCOMES = {
    CAUGHT: "caught, and held when shaken",
    LOST: "caught, but lost in the test of the hold",
    "never_reached": "missed: the palm never came near",
    "bounced_off": "missed: bounced off the hand",
    "dropped": "missed: touched, then dropped",
    "not_held": "missed: not held near the palm in time",
}
"""Outcomes of a throw with a description; all but the first two are the failure modes."""


@dataclass(frozen=True, kw_only=True)
class RecordedThrow:
    """One throw, from its start to the decision of the trial."""

    object_name: str  #: Name of the object.
    outcome: str  #: Outcome, a key of `OUTCOMES`.
    qpos: Float[ndarray, "num_steps nq"]  #: Positions of the simulation at every control step.
    qvel: Float[ndarray, "num_steps nv"]  #: Velocities of the simulation at every control step.
    box: Float[ndarray, "num_steps 4"]  #: Box that the policy received [px].
    num_untested: int  #: Control steps before the test of the hold; all steps if there was no success.

    @property
    def release(self) -> int:
        """The first control step in which the object flies."""
        flying = np.linalg.norm(self.qvel[:, OBJECT_VEL], axis=-1) > FLIGHT_SPEED
        return int(np.flatnonzero(flying)[0]) if flying.any() else len(flying) - 1


@dataclass(kw_only=True)
class ThrowCollection:
    """Landing points of all throws, and the first throw of each outcome, for the page of an evaluation."""

    landings: dict[str, list[Float[ndarray, "2"]]] = field(default_factory=dict)  #: By outcome [m].
    examples: dict[str, RecordedThrow] = field(default_factory=dict)  #: The first throw of each outcome.

    @property
    def misses_first(self) -> dict[str, RecordedThrow]:
        """The examples in the order of the page."""
        names = (*list(OUTCOMES)[1:], CAUGHT)
        return {name: self.examples[name] for name in names if name in self.examples}

    def add(self, throws: Sequence[RecordedThrow]) -> None:
        """Add the throws of a round; pass this to `assess` as `on_throws`."""
        for throw in throws:
            self.landings.setdefault(throw.outcome, []).append(landing(throw, sum(ThrowCfg().aim_z) / 2.0))
            self.examples.setdefault(throw.outcome, throw)


def landing(throw: RecordedThrow, height: float) -> Float[ndarray, "2"]:
    """Return where a throw would pass downwards through a height, without air: x and y [m].

    For a throw that stays below the height, return the position of its highest point.
    """
    pos, vel = throw.qpos[throw.release, OBJECT_POS], throw.qvel[throw.release, OBJECT_VEL]
    root = max(vel[2] ** 2 + 2.0 * GRAVITY * (pos[2] - height), 0.0) ** 0.5
    return pos[:2] + vel[:2] * (vel[2] + root) / GRAVITY
