"""Writes the contract of a method down from the values that define it."""

import dataclasses

import torch

from pixel2catch.agents import COMMANDS, AgentSpec
from pixel2catch.mdp.box_history import BoxHistory
from pixel2catch.mdp.observations import Frame, pixel_columns
from pixel2catch.mdp.snapshot import Measurement
from pixel2catch.methods import Method
from pixel2catch.policy.contract import AgentContract, PolicyContract
from pixel2catch.robot.constants import CONTROL_DT, JOINTS, RGB_CAMERA, CameraSpec


def contract_of(method: Method, handedness: str, camera: CameraSpec = RGB_CAMERA) -> PolicyContract:
    """Return what a policy of this method expects and promises.

    Args:
        method: The method.
        handedness: "left" or "right": which hand is on the arm.
        camera: The camera that the policy is for.
    """
    return PolicyContract(
        method=method.name,
        pixel_features=method.pixel_features,
        agents={agent.name: _agent_contract(agent, method) for agent in method.agents},
        commands={
            joint.name: dataclasses.asdict(command) for joint, command in zip(JOINTS, COMMANDS, strict=True)
        },
        control_dt=CONTROL_DT,
        camera=dataclasses.asdict(camera),
        handedness=handedness,
    )


def _agent_contract(agent: AgentSpec, method: Method) -> AgentContract:
    """Two consecutive frames, oldest first, then the memory, as `mdp.observations.observe` puts them."""
    blank = _blank_measurement(method.num_boxes)
    columns = pixel_columns(method.pixel_features)
    frame = Frame(before=blank, now=blank, joints=agent.joints, pixel_columns=columns)
    sizes, memory = (
        [(term.__name__, term(frame).shape[-1]) for term in terms]
        for terms in (agent.observation, agent.memory)
    )
    frames = ((f"{name}[{when}]", size) for when in ("t-1", "t") for name, size in sizes)
    return AgentContract(
        observation=(*frames, *((f"{name}[t]", size) for name, size in memory)),
        joints=tuple(joint.name for joint in JOINTS[agent.joints]),
    )


def _blank_measurement(num_boxes: int) -> Measurement:
    joints = torch.zeros(1, len(JOINTS))
    return Measurement(
        boxes=BoxHistory.begun(torch.zeros(1, 4), torch.zeros(1), num_boxes),
        object_pos=torch.zeros(1, 3),
        initial_object_pos=torch.zeros(1, 3),
        joint_pos=joints,
        joint_pos_target=joints,
        palm_pos=torch.zeros(1, 3),
        palm_quat=torch.zeros(1, 4),
        action=joints,
    )
