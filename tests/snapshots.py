"""Snapshots to test terms with: everything is zero but for what a test sets."""

from dataclasses import fields, is_dataclass
from typing import Any

import torch
from torch import Tensor

from paper_robot import JOINTS
from pixel2catch.mdp.control_step import BoxHistory, Measurement, Privileged, Transition
from pixel2catch.mdp.terminations import HOLD_STEPS
from pixel2catch.robots.geometry import WorkcellGeometry
from pixel2catch.workcells.ur5e_allegro import UR5E_ALLEGRO

NUM_JOINTS = len(JOINTS)
GEOMETRY = WorkcellGeometry(UR5E_ALLEGRO)


def numbers(num_envs: int, size: int, start: float) -> Tensor:
    """start, start + 1, ... along a row, and 100 more in each further environment."""
    return start + torch.arange(size, dtype=torch.float32) + 100.0 * torch.arange(num_envs)[:, None]


def boxes(num_envs: int, num_boxes: int, start: float) -> BoxHistory:
    """Boxes that differ by 10 px and 2 control steps, and in every number; the newest is 1.5 steps old."""
    box = torch.stack([numbers(num_envs, 4, start - 10.0 * i) for i in range(num_boxes)], dim=1)
    age = 1.5 + 2.0 * torch.arange(num_boxes, dtype=torch.float32) + 0.25 * torch.arange(num_envs)[:, None]
    return BoxHistory(box=box, age=age)


def measurement(num_envs: int = 1, start: float = 0.0, num_boxes: int = 1) -> Measurement:
    """A measurement in which every number is another one; `start` marks the control step."""
    return Measurement(
        boxes=boxes(num_envs, num_boxes, start + 1000.0),
        camera_pos=numbers(num_envs, 3, start + 900.0),
        object_pos=numbers(num_envs, 3, start**2 + 1100.0),
        initial_object_pos=numbers(num_envs, 3, start + 1200.0),
        joint_pos=numbers(num_envs, NUM_JOINTS, start + 2000.0),
        joint_pos_target=numbers(num_envs, NUM_JOINTS, start + 3000.0),
        palm_pos=numbers(num_envs, 3, start + 4000.0)[:, None],
        palm_quat=numbers(num_envs, 4, start + 5000.0)[:, None],
        action=numbers(num_envs, NUM_JOINTS, start + 6000.0),
    )


def privileged(**values: Tensor) -> Privileged:
    """What only the simulator knows, in as many environments as the given values have."""
    num_envs = len(next(iter(values.values()))) if values else 1
    fields = {
        "palm_pos": torch.zeros(num_envs, 1, 3),
        "fingertip_pos": torch.zeros(num_envs, 4, 3),
        "object_pos": torch.tensor([1.0, 0.0, 1.0]).repeat(num_envs, 1),
        "object_lin_vel": torch.zeros(num_envs, 3),
        "object_reach": torch.full((num_envs,), 0.08),
        "is_touching": torch.zeros(num_envs, 5, dtype=torch.bool),
        "is_robot_on_table": torch.zeros(num_envs, dtype=torch.bool),
        "is_self_contact": torch.zeros(num_envs, dtype=torch.bool),
        "is_robot_contact": torch.zeros(num_envs, dtype=torch.bool),
        "joint_vel": torch.zeros(num_envs, NUM_JOINTS),
        "torque_share": torch.zeros(num_envs, NUM_JOINTS),
    }
    if "palm_pos" in values and values["palm_pos"].ndim == 2:
        values["palm_pos"] = values["palm_pos"][:, None]  # of the only palm
    fields |= values
    up = torch.tensor([0.0, 0.0, 1.0]).expand_as(fields["palm_pos"])
    return Privileged(**{"palm_normal": up} | fields)


def transition(
    before: Privileged | None = None,
    now: Privileged | None = None,
    *,
    action: Tensor | None = None,
    joint_pos_target: Tensor | None = None,
    held_steps: tuple[int, ...] | None = None,
    rested_steps: tuple[int, ...] | None = None,
    episode_steps: tuple[int, ...] | None = None,
) -> Transition:
    """A control step after which nothing is held, unless told otherwise; the first hold is a success."""
    now = now or privileged()
    num_envs = len(now.object_pos)
    held_steps = held_steps or (0,) * num_envs
    return Transition(
        before=before or now,
        now=now,
        action=torch.zeros(num_envs, NUM_JOINTS) if action is None else action,
        joint_pos_target=torch.zeros(num_envs, NUM_JOINTS) if joint_pos_target is None else joint_pos_target,
        held_steps=torch.tensor(held_steps),
        rested_steps=torch.tensor(rested_steps or [int(held == HOLD_STEPS) for held in held_steps]),
        episode_steps=torch.tensor(episode_steps or (1,) * num_envs),
        geometry=GEOMETRY,
    )


def tensors(value: Any) -> list[Tensor]:
    """Every tensor in dataclasses, tuples and dictionaries of them, in a fixed order."""
    if isinstance(value, Tensor):
        return [value]
    if is_dataclass(value):
        return [item for field in fields(value) for item in tensors(getattr(value, field.name))]
    items = value.values() if isinstance(value, dict) else value
    return [tensor for item in items for tensor in tensors(item)]
