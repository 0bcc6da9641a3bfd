"""The methods that are compared, as values of one type. No code asks for a method by name."""

from dataclasses import dataclass, replace

from jaxtyping import Float
from torch import Tensor

from pixel2catch.agents import ARM, HAND, RESTING_ARM, RESTING_HAND, AgentSpec
from pixel2catch.camera.box_history import NUM_BOXES
from pixel2catch.errors import UnknownNameError
from pixel2catch.mdp.observations import (
    JOURNAL_TERMS,
    PROPRIOCEPTION,
    ObservationTerm,
    box_age,
    box_fit,
    box_track,
    initial_object_position,
    object_position,
    observe,
    pixel_columns,
)
from pixel2catch.mdp.snapshot import History


@dataclass(frozen=True, kw_only=True)
class Method:
    """Which agents learn, and which pixel features they see.

    Attributes:
        name: Name on the command line and in policy files.
        agents: The learners, in joint order.
        pixel_features: Names out of `camera.features.PIXEL_FEATURES`.
        num_boxes: Measured boxes that it remembers.
    """

    name: str
    agents: tuple[AgentSpec, ...]
    pixel_features: tuple[str, ...]
    num_boxes: int = 1

    @property
    def knows_age(self) -> bool:
        """Whether its agents know how old the boxes are that they see."""
        return any(agent.memory for agent in self.agents)

    def observe(self, history: History) -> dict[str, Float[Tensor, "num_envs _"]]:
        """What each agent sees, by name."""
        columns = pixel_columns(self.pixel_features)
        return {
            agent.name: observe(agent.observation, agent.memory, agent.joints, columns, history)
            for agent in self.agents
        }


def _seeing(*observation: ObservationTerm) -> tuple[AgentSpec, ...]:
    """Arm and hand with other observations."""
    return tuple(replace(agent, observation=observation) for agent in (ARM, HAND))


@dataclass(frozen=True, kw_only=True)
class Memory:
    """What agents remember of the images besides the paper's two frames.

    Attributes:
        num_boxes: Measured boxes.
        terms: What is observed of them.
    """

    num_boxes: int
    terms: tuple[ObservationTerm, ...]


MEMORIES: dict[str, Memory] = {
    "age": Memory(num_boxes=1, terms=(box_age,)),
    "boxes": Memory(num_boxes=8, terms=(box_track,)),
    "fit": Memory(num_boxes=NUM_BOXES, terms=(box_fit,)),
}
"""Memories by name. Source: ours: a policy that knows how old its boxes are can be told of any latency, and
what the images have shown of a flight is in more than two of them."""


def remembering(method: Method, memory: str) -> Method:
    """The method with a memory; one that sees no pixel features gets no more than the age of the images."""
    name = memory if method.pixel_features else "age"
    kept = MEMORIES[name]
    agents = tuple(replace(agent, memory=kept.terms) for agent in method.agents)
    return replace(method, name=f"{method.name}+{memory}", agents=agents, num_boxes=kept.num_boxes)


PROPOSED = Method(name="proposed", agents=(ARM, HAND), pixel_features=("cx", "cy", "dcx", "dcy", "dw", "dh"))

METHODS: dict[str, Method] = {
    method.name: method
    for method in (
        PROPOSED,
        Method(
            name="without_pf", agents=_seeing(initial_object_position, *PROPRIOCEPTION), pixel_features=()
        ),
        replace(PROPOSED, name="only_wh", pixel_features=("w", "h", "dw", "dh")),
        replace(PROPOSED, name="only_center", pixel_features=("cx", "cy", "dcx", "dcy")),
        replace(PROPOSED, name="single_agent", agents=(ARM + HAND,)),
        Method(name="object_position", agents=_seeing(object_position, *PROPRIOCEPTION), pixel_features=()),
        replace(
            PROPOSED,
            name="shared_reward",
            agents=(replace(ARM, teammates=HAND.parts), replace(HAND, teammates=ARM.parts)),
        ),
        replace(PROPOSED, name="journal", agents=_seeing(*JOURNAL_TERMS)),
        replace(
            PROPOSED,
            name="catch",
            agents=(
                replace(RESTING_ARM, teammates=RESTING_HAND.parts),
                replace(RESTING_HAND, teammates=RESTING_ARM.parts),
            ),
        ),
        replace(PROPOSED, name="catch_alone", agents=(RESTING_ARM + RESTING_HAND,)),
        Method(
            name="catch_teacher",
            agents=(replace(RESTING_ARM + RESTING_HAND, observation=(object_position, *PROPRIOCEPTION)),),
            pixel_features=(),
        ),
    )
}
"""Source: paper, Sec. V-A; ours: `object_position`, an oracle that sees the object in 3D, and
`shared_reward`, in which arm and hand are both paid the sum of their rewards; release: `journal`, which adds
palm displacement and joint targets; ours: `catch`, a `shared_reward` that also pays for unrest after a catch
and for touching itself, `catch_alone`, the same as a single agent, and `catch_teacher`, which sees the object
in 3D and can be imitated."""


def find_method(name: str) -> Method:
    """The method of that name; `NAME+MEMORY` is a method with a memory, such as `catch+fit`.

    Raises:
        UnknownNameError: With the valid names.
    """
    base, *memories = name.split("+")
    if base not in METHODS:
        raise UnknownNameError("method", base, METHODS)
    if memories and (len(memories) > 1 or memories[0] not in MEMORIES):
        raise UnknownNameError("memory", "+".join(memories), MEMORIES)
    return remembering(METHODS[base], memories[0]) if memories else METHODS[base]
