"""How near the moving robot comes to the table and to itself, by MuJoCo's own collision detection."""

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from jaxtyping import Float64

from pixel2catch.identification.recording import JOINT_SPECS
from pixel2catch.robot.constants import FINGERS
from pixel2catch.robot.scene import SceneCfg, build_spec

HORIZON = 0.1
"""Distance up to which the robot is watched [m]."""

STANDING = ("base_link", "shoulder_link")
"""Bodies that stand on the table."""


@dataclass(frozen=True, kw_only=True)
class Rule:
    """A distance to keep.

    Attributes:
        name: Between what.
        margin: The distance [m].
        is_of_hand: Whether only the hand's joints change it.
    """

    name: str
    margin: float
    is_of_hand: bool


RULES = (
    Rule(name="robot and table", margin=0.05, is_of_hand=False),
    Rule(name="arm and robot", margin=0.02, is_of_hand=False),
    Rule(name="hand and hand", margin=0.005, is_of_hand=True),
)
"""What is kept apart.

Source: ours. A lab's table, and what stands on it, differ by some centimetres; our arm is made of capsules;
the maker's covers of the fingers run 5.5 to 9 mm beyond the boxes of his description, which are ours, too.
"""


@dataclass(frozen=True, kw_only=True)
class Clearance:
    """The least distance under one rule.

    Attributes:
        rule: The rule.
        distance: The distance [m]; infinite beyond the horizon.
        bodies: Between which bodies it was.
        time: When it was [s].
    """

    rule: Rule
    distance: float
    bodies: tuple[str, str]
    time: float

    @property
    def is_kept(self) -> bool:
        """Whether the distance is large enough."""
        return self.distance >= self.rule.margin

    def sentence(self) -> str:
        """What was found, in words."""
        if np.isinf(self.distance):
            return f"{self.rule.name}: never nearer than {1e3 * HORIZON:.0f} mm"
        return (
            f"{self.rule.name}: {1e3 * self.distance:.1f} mm between {' and '.join(self.bodies)} "
            f"at {self.time:.2f} s; {1e3 * self.rule.margin:.0f} mm are to be kept"
        )


def clearances(
    joints: Sequence[str],
    time: Float64[np.ndarray, " num_times"],
    positions: Float64[np.ndarray, "num_times num_joints"],
) -> tuple[Clearance, ...]:
    """The least distances over a motion, one for each of `RULES`; other joints hold the start pose.

    Args:
        joints: Names of the joints that move.
        time: Times [s].
        positions: Their positions [rad].
    """
    model = _watched_scene()
    data = mujoco.MjData(model)
    data.qpos[:] = [spec.home for spec in JOINT_SPECS.values()]
    columns = [int(model.joint(name).qposadr[0]) for name in joints]
    rules = _rule_of_pairs(model)
    least = [Clearance(rule=rule, distance=np.inf, bodies=("", ""), time=0.0) for rule in RULES]
    for now, row in zip(time, positions, strict=True):
        data.qpos[columns] = row
        mujoco.mj_kinematics(model, data)
        mujoco.mj_collision(model, data)
        pairs, distances = data.contact.geom, data.contact.dist
        rule_of_contact = rules[pairs[:, 0], pairs[:, 1]]
        for i, rule in enumerate(RULES):
            contacts = np.flatnonzero(rule_of_contact == i)
            nearest = contacts[np.argmin(distances[contacts])] if len(contacts) else None
            if nearest is not None and distances[nearest] < least[i].distance:
                bodies = tuple(model.body(model.geom_bodyid[geom]).name for geom in pairs[nearest])
                least[i] = Clearance(
                    rule=rule, distance=float(distances[nearest]), bodies=bodies, time=float(now)
                )
    return tuple(least)


def _watched_scene() -> mujoco.MjModel:
    """Robot and table without the object; what is within the horizon counts as a contact without force."""
    spec = build_spec(SceneCfg())
    for sensor in spec.sensors:
        spec.delete(sensor)
    spec.delete(spec.body("object"))
    model = spec.compile()
    model.geom_gap[:] = HORIZON / 2
    return model


def _rule_of_pairs(model: mujoco.MjModel) -> np.ndarray:
    """Which of `RULES` holds for two geoms, shape (geoms, geoms); -1 for those that stand on each other."""
    body = [model.body(owner).name for owner in model.geom_bodyid]
    is_hand = np.array([name.startswith(("palm", *FINGERS)) for name in body])
    is_table = np.array([name == "table" for name in body])
    is_standing = np.array([name in STANDING for name in body])
    rules = np.where(is_hand[:, None] & is_hand, 2, 1)
    rules[is_table[:, None] | is_table] = 0
    rules[(is_table[:, None] & is_standing) | (is_standing[:, None] & is_table)] = -1
    return rules
