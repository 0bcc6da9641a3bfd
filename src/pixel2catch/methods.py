"""The methods that are compared, as values of one type. No code asks for a method by name."""

from dataclasses import dataclass, replace

from pixel2catch.agents import ARM, HAND, AgentSpec
from pixel2catch.errors import UnknownNameError
from pixel2catch.mdp.observations import JOURNAL_TERMS


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


PROPOSED = Method(name="proposed", agents=(ARM, HAND), pixel_features=("cx", "cy", "dcx", "dcy", "dw", "dh"))

METHODS: dict[str, Method] = {
    method.name: method
    for method in (
        PROPOSED,
        replace(
            PROPOSED, name="journal", agents=tuple(replace(a, observation=JOURNAL_TERMS) for a in (ARM, HAND))
        ),
        replace(PROPOSED, name="only_wh", pixel_features=("w", "h", "dw", "dh")),
        replace(PROPOSED, name="only_center", pixel_features=("cx", "cy", "dcx", "dcy")),
        replace(PROPOSED, name="single_agent", agents=(ARM + HAND,)),
    )
}
"""Source: paper, Sec. V-A; `journal` adds palm displacement and joint targets, as the release does."""


def find_method(name: str) -> Method:
    """The method of that name.

    Raises:
        UnknownNameError: With the valid names.
    """
    if name not in METHODS:
        raise UnknownNameError("method", name, METHODS)
    return METHODS[name]
