"""Writes the contract of a method down from the values that define it."""

import dataclasses

import torch

from pixel2catch.agents import AgentSpec, commands_of
from pixel2catch.mdp.box_history import BoxHistory
from pixel2catch.mdp.observations import Frame, pixel_columns
from pixel2catch.mdp.snapshot import Measurement
from pixel2catch.methods import Method
from pixel2catch.policy.contract import AgentContract, PolicyContract
from pixel2catch.robots.workcell import WorkcellSpec
from pixel2catch.scene.constants import CONTROL_DT, RGB_CAMERA, CameraSpec
from pixel2catch.workcells.ur5e_allegro import UR5E_ALLEGRO


def contract_of(
    method: Method, workcell: WorkcellSpec = UR5E_ALLEGRO, camera: CameraSpec = RGB_CAMERA
) -> PolicyContract:
    """Return what a policy of this method expects and promises.

    Args:
        method: The method.
        workcell: The robots.
        camera: The camera that the policy is for.
    """
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
