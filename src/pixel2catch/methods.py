"""The methods that are compared, as values of one type. No code asks for a method by name."""

from dataclasses import dataclass, replace

from pixel2catch.agents import ARM, HAND, AgentSpec
from pixel2catch.errors import UnknownNameError
from pixel2catch.mdp.observations import (
    JOURNAL_TERMS,
    PROPRIOCEPTION,
    ObservationTerm,
    initial_object_position,
    object_position,
)


@dataclass(frozen=True, kw_only=True)
class Method:
    """Which agents learn, and which pixel features they see.

    Attributes:
        name: Name on the command line and in policy files.
        agents: The learners, in joint order.
        pixel_features: Names out of `camera.features.PIXEL_FEATURES`.
    """

    name: str
    agents: tuple[AgentSpec, ...]
    pixel_features: tuple[str, ...]


def _seeing(*observation: ObservationTerm) -> tuple[AgentSpec, ...]:
    """Arm and hand with other observations."""
    return tuple(replace(agent, observation=observation) for agent in (ARM, HAND))


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
    )
}
"""Source: paper, Sec. V-A; ours: `object_position`, an oracle that sees the object in 3D, and
`shared_reward`, in which arm and hand are both paid the sum of their rewards; release: `journal`, which adds
palm displacement and joint targets."""


def find_method(name: str) -> Method:
    """The method of that name.

    Raises:
        UnknownNameError: With the valid names.
    """
    if name not in METHODS:
        raise UnknownNameError("method", name, METHODS)
    return METHODS[name]
