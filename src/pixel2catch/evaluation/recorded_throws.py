"""Single throws of an evaluation: their states and their outcomes."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from pixel2catch.scene.constants import OBJECT_VEL

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
