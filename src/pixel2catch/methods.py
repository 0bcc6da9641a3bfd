"""The compared methods, as values of one type."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Annotated, Literal

import torch

from pixel2catch.agents import RESTING_REWARDS, AgentSpec, agents_by_robot, agents_of, sharing, together
from pixel2catch.batches import ByAgent, Joints
from pixel2catch.checks import NAME, Within, require_valid
from pixel2catch.errors import InvalidValueError, UnknownNameError
from pixel2catch.mdp import observations
from pixel2catch.mdp.control_step import History, Measurement, Transition, put
from pixel2catch.mdp.observations import PIXEL_FEATURES, ObservationInputs
from pixel2catch.mdp.rewards import BodyPart
from pixel2catch.own_files import catalogue, computed
from pixel2catch.robots.workcell import WorkcellSpec
from pixel2catch.workcells.ur5e_allegro import UR5E_ALLEGRO


@dataclass(frozen=True, kw_only=True)
class Method:
    """Which agents learn, and which pixel features they observe."""

    name: Annotated[str, NAME]  #: Name on the command line and in policy files.
    agents: tuple[AgentSpec, ...]  #: The learners, in joint order.
    pixel_features: tuple[str, ...]  #: Names out of `mdp.observations.PIXEL_FEATURES`.
    num_boxes: Annotated[int, Within(1, 99)] = 1  #: Number of measured boxes that it keeps.
    #: Input of every value network: the state, with the truth of the simulator, or the agent's observation.
    value_input: Literal["state", "observation"] = "state"

    def __post_init__(self) -> None:
        require_valid(self)
        names = [agent.name for agent in self.agents]
        if not names or len(set(names)) < len(names):
            raise InvalidValueError(f"method '{self.name}' has agents {names}; name one or more, each once.")
        for agent in self.agents:
            if "." in agent.name or hasattr(torch.nn.ModuleDict(), agent.name):  # has its networks
                raise InvalidValueError(f"agent '{agent.name}' cannot have this name; give it another one.")
            if not (agent.observation + agent.memory and agent.reward_names):
                raise InvalidValueError(f"agent '{agent.name}' lacks observations or rewards; give it terms.")
        for feature in set(self.pixel_features) - set(PIXEL_FEATURES):
            raise UnknownNameError("pixel feature", feature, PIXEL_FEATURES)

    @property
    def is_levelled(self) -> bool:
        """Return whether its agents observe boxes of the level camera, whatever camera took the images."""
        return any(observations.camera_position in agent.memory for agent in self.agents)

    @property
    def knows_age(self) -> bool:
        """Return whether its agents observe the age of boxes."""
        return any(agent.memory for agent in self.agents)

    def joint_actions(self, actions: ByAgent) -> Joints:
        """Return the actions of all agents in joint order."""
        return put([(agent.joints, actions[agent.name]) for agent in self.agents])

    def with_weights(self, weights: Mapping[str, float]) -> "Method":
        """Return the method with other weights of reward terms, by names such as `arm.success`."""
        agents = self.agents
        names = {f"{part.name}.{term.name}" for each in agents for part in each.parts for term in part.reward}
        for name in set(weights) - names:
            raise UnknownNameError("reward term", name, sorted(names))

        def weighted(parts: tuple[BodyPart, ...]) -> tuple[BodyPart, ...]:
            return tuple(part.with_weights(weights) for part in parts)

        changed = (replace(a, parts=weighted(a.parts), teammates=weighted(a.teammates)) for a in agents)
        return replace(self, agents=tuple(changed))

    def require_same_view(self, teacher: "Method | None") -> None:
        """Raise InvalidValueError if a teacher observes boxes of other cameras."""
        if teacher and teacher.pixel_features and teacher.is_levelled != self.is_levelled:
            raise InvalidValueError(
                f"teacher '{teacher.name}' and method '{self.name}' observe boxes of different cameras; use "
                "a teacher that observes the object's position, such as catch_teacher+age."
            )

    def inputs(self, agent: AgentSpec, before: Measurement, now: Measurement) -> ObservationInputs:
        """Return what the terms of an agent read of two consecutive measurements."""
        return ObservationInputs(
            before=before,
            now=now,
            joints=agent.joints,
            palms=agent.palms,
            pixel_columns=observations.pixel_columns(self.pixel_features),
        )

    def observe(self, history: History) -> ByAgent:
        """Return each agent's observation: its terms on two frames, oldest first, then its memory.

        Source: paper, Sec. IV-C; the memory is ours.
        """
        observed: ByAgent = {}
        for agent in self.agents:
            old = self.inputs(agent, history.oldest, history.before)
            new = self.inputs(agent, history.before, history.now)
            values = [term(frame) for frame in (old, new) for term in agent.observation]
            observed[agent.name] = torch.cat([*values, *(term(new) for term in agent.memory)], dim=-1).float()
        return observed


def require_terms(
    method: Method, transition: Transition, before: Measurement, now: Measurement, widths: dict[str, int]
) -> None:
    """Compute each term once, before a device records it; raise as `computed`, or if `widths` are others."""
    num_envs = len(transition.episode_steps)
    for agent in method.agents:
        inputs = method.inputs(agent, before, now)
        for i, term in enumerate((*agent.observation, *agent.memory)):
            key = f"{agent.name} {i}"
            shape = num_envs, widths.get(key, "any")
            widths[key] = computed("observation term", term, (inputs,), *shape).shape[1]
        for part in (*agent.parts, *agent.teammates):
            for reward in part.reward:
                computed("reward term", reward.function, (transition, part), num_envs)


MEMORIES: dict[str, tuple[int, tuple[observations.ObservationTerm, ...]]] = {
    "age": (1, (observations.box_age,)),
    "boxes": (8, (observations.box_track,)),
    "fit": (observations.NUM_BOXES, (observations.box_fit,)),
    "anycamera": (
        observations.NUM_BOXES,
        (observations.box_fit, observations.camera_position, observations.palm_sight),
    ),
    "flight": (45, (observations.measured_boxes, observations.camera_position)),
}
"""Number of measured boxes, and terms that agents observe besides the paper's two frames, by memory.

Source: ours, for latencies that differ, for more of a flight than two frames, and for any calibrated camera:
all boxes are then those of a level camera, see `camera.level`. `flight` has all boxes of a flight of 1.5 s.
"""


def remembering(method: Method, memory: str) -> Method:
    """Return the method with a memory, such as `fit`, or `boxes5` with a number of boxes.

    Without pixel features the memory is the age of the images.
    """
    found = re.fullmatch(r"([a-z_]*)([1-9]\d?)?", memory)
    if not found or found[1] not in MEMORIES:
        valid = [*MEMORIES, "the same with a number of boxes up to 99, such as boxes5"]
        raise UnknownNameError("memory", memory, valid)
    num_boxes, terms = MEMORIES[found[1] if method.pixel_features else "age"]
    num_boxes = int(found[2]) if found[2] and method.pixel_features else num_boxes
    agents = tuple(replace(agent, memory=terms) for agent in method.agents)
    return replace(method, name=f"{method.name}+{memory}", agents=agents, num_boxes=num_boxes)


ALL_FEATURES = ("cx", "cy", "dcx", "dcy", "dw", "dh")  #: Source: paper, Eq. 1.


def _seeing(agents: tuple[AgentSpec, ...], *terms: observations.ObservationTerm) -> tuple[AgentSpec, ...]:
    return tuple(replace(agent, observation=terms) for agent in agents)


def methods_of(workcell: WorkcellSpec) -> dict[str, Method]:
    """Return all methods for a work cell, by name.

    Source: paper, Sec. V-A. Release: `journal`, which adds palm displacement and joint targets. Ours:
    `object_position` observes the object in 3D, `object_extent` also its size; `shared_reward` gives all
    agents the sum of their rewards; `agent_per_robot` has an agent for each robot; `catch` has a shared
    reward with costs of unrest and self-contact, `catch_alone` the same as one agent; `catch_teacher`
    observes the object in 3D and can be imitated. `analytic` and `analytic_told` are what the computed
    policies of these names observe, see `policy.analytic`. With a `local_critic` no value network sees the
    state.
    """
    agents, resting = agents_of(workcell), agents_of(workcell, RESTING_REWARDS)
    alone = together(resting)
    own, joints = observations.PROPRIOCEPTION, (observations.joint_pos, observations.last_action)
    oracle = (observations.object_position, *own)
    blind = partial(Method, pixel_features=())
    proposed = Method(name="proposed", agents=agents, pixel_features=ALL_FEATURES)
    single = replace(proposed, name="single_agent", agents=(together(agents),))
    methods = (
        proposed,
        blind(name="without_pf", agents=_seeing(agents, observations.initial_object_position, *own)),
        replace(proposed, name="only_wh", pixel_features=("w", "h", "dw", "dh")),
        replace(proposed, name="only_center", pixel_features=("cx", "cy", "dcx", "dcy")),
        single,
        replace(proposed, name="proposed_local_critic", value_input="observation"),
        replace(single, name="single_agent_local_critic", value_input="observation"),
        blind(name="object_position", agents=_seeing(agents, *oracle)),
        blind(name="object_extent", agents=_seeing(agents, observations.object_extent, *oracle)),
        replace(proposed, name="shared_reward", agents=sharing(agents)),
        replace(proposed, name="agent_per_robot", agents=agents_by_robot(workcell, agents)),
        replace(proposed, name="journal", agents=_seeing(agents, *observations.JOURNAL_TERMS)),
        replace(proposed, name="catch", agents=sharing(resting)),
        replace(proposed, name="catch_alone", agents=(alone,)),
        blind(name="catch_teacher", agents=_seeing((alone,), *oracle)),
        replace(proposed, name="analytic", agents=_seeing((alone,), observations.pixels, *joints)),
        blind(name="analytic_told", agents=_seeing((alone,), observations.object_position, *joints)),
    )
    return {method.name: method for method in methods}


METHODS = catalogue(Method, methods_of(UR5E_ALLEGRO))
"""Methods for the paper's robot, and those of users' files."""

PROPOSED = METHODS["proposed"]


def find_method(name: str, workcell: WorkcellSpec = UR5E_ALLEGRO) -> Method:
    """Return the method of a name for a work cell; `NAME+MEMORY` has a memory, such as `catch+fit`.

    Raises UnknownNameError, and InvalidValueError for a user's method of other robots.
    """
    base, *memories = name.split("+")
    if base not in METHODS:
        raise UnknownNameError("method", base, METHODS)
    others = {} if workcell == UR5E_ALLEGRO else methods_of(workcell)
    method = others.get(base, METHODS[base])
    num_joints = sum(agent.num_joints for agent in method.agents)
    if num_joints != len(workcell.joints):
        raise InvalidValueError(
            f"method '{base}' moves {num_joints} joints, and work cell '{workcell.name}' has "
            f"{len(workcell.joints)}; make its agents by agents_of(WORKCELL)."
        )
    return remembering(method, "+".join(memories)) if memories else method
