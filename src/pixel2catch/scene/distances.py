"""Distances of robots to the table, to themselves and to each other, by MuJoCo's collision detection."""

import dataclasses
from dataclasses import dataclass

import mujoco
import numpy as np
from jaxtyping import Float64

from pixel2catch.robots.workcell import WorkcellSpec
from pixel2catch.scene.scene import SceneCfg, build_spec

HORIZON = 0.1  #: Largest distance that is measured [m].


@dataclass(frozen=True, kw_only=True)
class Clearance:
    """A distance to keep, and the smallest one in a motion."""

    name: str  #: the two sides
    margin: float  #: the distance to keep [m]
    is_of_hand: bool  #: whether only joints of a hand change it
    distance: float = np.inf  #: the smallest one [m]; infinite beyond the horizon
    bodies: tuple[str, str] = ("", "")  #: the bodies of the smallest distance
    time: float = 0.0  #: its time in a motion [s]

    @property
    def is_kept(self) -> bool:
        """Return whether the distance is large enough."""
        return self.distance >= self.margin

    def sentence(self) -> str:
        """Return the smallest distance as a sentence."""
        if np.isinf(self.distance):
            return f"{self.name}: never closer than {1e3 * HORIZON:.0f} mm"
        return (
            f"{self.name}: {1e3 * self.distance:.1f} mm between {' and '.join(self.bodies)} "
            f"at {self.time:.2f} s; keep {1e3 * self.margin:.0f} mm"
        )


RULES = (
    Clearance(name="robot and table", margin=0.05, is_of_hand=False),
    Clearance(name="arm and robot", margin=0.02, is_of_hand=False),
    Clearance(name="hand and hand", margin=0.005, is_of_hand=True),
)
"""Distances to keep. Source: ours. A laboratory's table, and what stands on it, differ by some centimetres;
the model of the arm consists of capsules; the real covers of the fingers are 5.5 to 9 mm larger than the
model."""


class Distances:
    """Measures the distances of a work cell's robots; the room has no object."""

    def __init__(self, workcell: WorkcellSpec) -> None:
        spec = build_spec(SceneCfg(workcell=workcell.name))
        for sensor in spec.sensors:
            spec.delete(sensor)
        spec.delete(spec.body("object"))
        self._model = model = spec.compile()
        model.geom_gap[:] = HORIZON / 2  # pairs within the horizon count as contacts without force
        self._data, self._rules = mujoco.MjData(model), _rule_of_pairs(model, workcell)

    def at(self, joint_pos: Float64[np.ndarray, " num_joints"]) -> tuple[Clearance, ...]:
        """Return the smallest distance for each of `RULES`, for all joints in joint order [rad]."""
        model, data, found = self._model, self._data, list(RULES)
        data.qpos[:] = joint_pos
        mujoco.mj_kinematics(model, data)
        mujoco.mj_collision(model, data)
        pairs, distances = data.contact.geom, data.contact.dist
        rule_of_contact = self._rules[pairs[:, 0], pairs[:, 1]]
        for i, rule in enumerate(RULES):
            contacts = np.flatnonzero(rule_of_contact == i)
            if len(contacts):
                nearest = contacts[np.argmin(distances[contacts])]
                bodies = tuple(model.body(model.geom_bodyid[geom]).name for geom in pairs[nearest])
                found[i] = dataclasses.replace(rule, distance=float(distances[nearest]), bodies=bodies)
        return tuple(found)


def _rule_of_pairs(model: mujoco.MjModel, workcell: WorkcellSpec) -> np.ndarray:
    """Return the index in `RULES` for two geoms, shape (geoms, geoms); -1 for those that touch on purpose.

    The root of a robot and the link that turns on it stand on the table; a hand is all that hangs on a palm.
    """
    body, parents = model.geom_bodyid, model.body_parentid
    roots = [model.body(each.prefix + each.robot.root).id for each in workcell.robots]
    is_standing = np.isin(body, roots) | np.isin(parents[body], roots)
    is_table = body == model.body("table").id
    rules = np.ones((len(body), len(body)), dtype=int)
    for palm in workcell.palms:
        hangs = np.arange(model.nbody) == model.body(palm.spec.body).id
        for child, parent in enumerate(parents):
            hangs[child] |= hangs[parent]
        is_hand = hangs[body]
        rules[is_hand[:, None] & is_hand] = 2
    rules[is_table[:, None] | is_table] = 0
    rules[(is_table[:, None] & is_standing) | (is_standing[:, None] & is_table)] = -1
    return rules
