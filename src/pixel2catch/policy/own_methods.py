"""The method of a policy, also where it is one of the user's own: by its contract, or by an imported file."""

from dataclasses import replace
from typing import cast

from pixel2catch.agents import AgentSpec, agents_of
from pixel2catch.errors import PolicyMismatchError
from pixel2catch.mdp import observations, rewards
from pixel2catch.mdp.observations import ObservationTerm
from pixel2catch.mdp.rewards import RewardTerm
from pixel2catch.methods import MEMORIES, METHODS, Method, find_method
from pixel2catch.own_files import OPTION, import_files
from pixel2catch.policy.contract import AgentContract, PolicyContract
from pixel2catch.robots.workcell import WorkcellSpec
from pixel2catch.workcells import find_workcell

NO_REWARD = RewardTerm(function=rewards.elapsed_time, weight=0.0)
"""What an agent is rewarded for whose rewards are not written down; only a training needs them."""


def method_of(contract: PolicyContract) -> Method:
    """The method of a policy: the one of its name, or what its contract says where there is none.

    A contract is enough where all terms are of this package, and memories, too (`NAME+MEMORY`).

    Raises:
        PolicyMismatchError: If it is not enough.
        InvalidValueError: If a file that is to be imported cannot be.
    """
    import_files()
    base, _, suffix = contract.method.partition("+")
    workcell = find_workcell(contract.workcell)
    if base in METHODS:
        return find_method(contract.method, workcell)
    memory = MEMORIES.get(suffix if contract.pixel_features else suffix and "age")
    agents = tuple(_agent(name, agent, contract.method, workcell) for name, agent in contract.agents.items())
    if any(agent.memory != (memory.terms if memory else ()) for agent in agents):
        raise _undefined(contract.method, "remembers images in a way of its own")
    return Method(
        name=contract.method,
        agents=agents,
        pixel_features=contract.pixel_features,
        num_boxes=memory.num_boxes if memory else 1,
    )


def _agent(name: str, contract: AgentContract, method: str, workcell: WorkcellSpec) -> AgentSpec:
    """An agent as far as its contract tells: two frames of the same terms, oldest first, then its memory."""
    names = [name.partition("[")[0] for name, _ in contract.observation]
    num_frame_terms = sum(term.endswith("[t-1]") for term, _ in contract.observation)
    terms = tuple(_term(each, method) for each in names[num_frame_terms:])
    parts = tuple(
        replace(part, reward=(NO_REWARD,))
        for agent in agents_of(workcell)
        for part in agent.parts
        if workcell.joints[part.joints][0].name in contract.joints
    )
    return AgentSpec(
        name=name, parts=parts, observation=terms[:num_frame_terms], memory=terms[num_frame_terms:]
    )


def _term(name: str, method: str) -> ObservationTerm:
    term = vars(observations).get(name)
    if getattr(term, "__module__", None) != observations.__name__:
        raise _undefined(method, f"observes '{name}'")
    return cast(ObservationTerm, term)


def _undefined(method: str, what: str) -> PolicyMismatchError:
    return PolicyMismatchError(
        f"unknown method '{method}', and its policy {what}; name the Python file that registers it: "
        f"pixel2catch {OPTION} FILE.py COMMAND ... Methods of this package: {', '.join(METHODS)}."
    )
