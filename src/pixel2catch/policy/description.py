"""The contract of a method, from the values that define it; and the method of a contract, own ones too."""

import dataclasses
from typing import cast

import torch

from pixel2catch.agents import AgentSpec, agents_of, commands_of
from pixel2catch.errors import PolicyMismatchError
from pixel2catch.mdp import observations, rewards
from pixel2catch.mdp.box_history import BoxHistory
from pixel2catch.mdp.observations import Frame, ObservationTerm, pixel_columns
from pixel2catch.mdp.rewards import RewardTerm
from pixel2catch.mdp.snapshot import Measurement
from pixel2catch.methods import MEMORIES, METHODS, Method, find_method
from pixel2catch.own_files import OPTION, import_files
from pixel2catch.policy.contract import AgentContract, PolicyContract
from pixel2catch.robots.workcell import WorkcellSpec
from pixel2catch.scene.constants import CONTROL_DT, RGB_CAMERA, CameraSpec
from pixel2catch.workcells import find_workcell
from pixel2catch.workcells.ur5e_allegro import UR5E_ALLEGRO

NO_REWARD = RewardTerm(function=rewards.elapsed_time, weight=0.0)
"""What an agent is rewarded for whose rewards are not written down; only a training needs them."""


def contract_of(
    method: Method, workcell: WorkcellSpec = UR5E_ALLEGRO, camera: CameraSpec = RGB_CAMERA
) -> PolicyContract:
    """Return what a policy of this method, for these robots and this camera, expects and promises."""
    return PolicyContract(
        method=method.name,
        pixel_features=method.pixel_features,
        agents={agent.name: _agent_contract(agent, method, workcell) for agent in method.agents},
        commands={
            joint.name: dataclasses.asdict(command)
            for joint, command in zip(workcell.joints, commands_of(workcell), strict=True)
        },
        control_dt=CONTROL_DT,
        camera=dataclasses.asdict(camera),
        workcell=workcell.name,
    )


def _agent_contract(agent: AgentSpec, method: Method, workcell: WorkcellSpec) -> AgentContract:
    """Two consecutive frames, oldest first, then the memory, as `mdp.observations.observe` puts them."""
    blank = _blank_measurement(method.num_boxes, workcell)
    columns = pixel_columns(method.pixel_features)
    frame = Frame(before=blank, now=blank, joints=agent.joints, palms=agent.palms, pixel_columns=columns)
    sizes, memory = (
        [(term.__name__, term(frame).shape[-1]) for term in terms]
        for terms in (agent.observation, agent.memory)
    )
    frames = ((f"{name}[{when}]", size) for when in ("t-1", "t") for name, size in sizes)
    return AgentContract(
        observation=(*frames, *((f"{name}[t]", size) for name, size in memory)),
        joints=tuple(joint.name for columns in agent.joints for joint in workcell.joints[columns]),
    )


def _blank_measurement(num_boxes: int, workcell: WorkcellSpec) -> Measurement:
    joints, num_palms = torch.zeros(1, len(workcell.joints)), len(workcell.palms)
    return Measurement(
        boxes=BoxHistory.begun(torch.zeros(1, 4), torch.zeros(1), num_boxes),
        object_pos=torch.zeros(1, 3),
        initial_object_pos=torch.zeros(1, 3),
        joint_pos=joints,
        joint_pos_target=joints,
        palm_pos=torch.zeros(1, num_palms, 3),
        palm_quat=torch.zeros(1, num_palms, 4),
        action=joints,
    )


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
        dataclasses.replace(part, reward=(NO_REWARD,))
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
