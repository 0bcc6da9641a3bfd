"""From joint positions and the object's boxes to joint targets, once in every control step, as in training.

Observation builder, policy and action map are the very ones of the environment.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from pixel2catch.agents import COMMANDS
from pixel2catch.errors import NonFiniteError, PolicyMismatchError
from pixel2catch.mdp.actions import ActionMap
from pixel2catch.mdp.box_history import BoxHistory
from pixel2catch.mdp.observations import Frame, pixel_columns
from pixel2catch.mdp.snapshot import History, Measurement
from pixel2catch.methods import Method, find_method
from pixel2catch.policy import Policy, contract_of
from pixel2catch.robot.constants import ARM_JOINTS, JOINTS, RGB_CAMERA, CameraSpec
from pixel2catch.robot.kinematics import palm_pose


@dataclass(frozen=True)
class _Past:
    """What is remembered from the step before."""

    history: History
    action: Float[Tensor, "1 num_joints"]
    joint_pos_target: Float[Tensor, "1 num_joints"]


class Controller:
    """A policy at its control rate: call `reset` before a throw, then `step` in every control step.

    Attributes:
        method: The method that the policy was trained with.
    """

    def __init__(self, policy: Policy, handedness: str, camera: CameraSpec = RGB_CAMERA) -> None:
        """Take over a policy.

        Args:
            policy: The policy.
            handedness: "left" or "right": which hand is on the arm.
            camera: The camera of the laboratory.

        Raises:
            PolicyMismatchError: It was trained for another robot, hand or camera, or needs what no camera
                sees.
        """
        self.method = find_method(policy.contract.method)
        policy.contract.require(contract_of(self.method, handedness, camera))
        self._policy = policy
        policy.reset()
        self._action_map = ActionMap.of(COMMANDS, torch.device("cpu"))
        self._past: _Past | None = None
        self._held: Tensor | None = None
        nowhere = BoxHistory.begun(torch.zeros(1, 4), torch.zeros(1), self.method.num_boxes)
        at_zero = self._measure(torch.zeros(1, len(JOINTS)), nowhere)
        _refuse_trackers(self.method, at_zero)

    def reset(self, joint_pos_target: Float[Tensor, "1 num_joints"] | None = None) -> None:
        """Begin a new throw: the next step is the first of an episode.

        Args:
            joint_pos_target: Where the joints are held [rad]; where they are measured if absent.
        """
        self._past, self._held = None, joint_pos_target
        self._policy.reset()

    @property
    def measurement(self) -> Measurement | None:
        """What the policy saw in the last step; none before the first."""
        return None if self._past is None else self._past.history.now

    def step(
        self, joint_pos: Float[Tensor, "1 num_joints"], boxes: BoxHistory
    ) -> Float[Tensor, "1 num_joints"]:
        """Decide on the next control step.

        Args:
            joint_pos: Joint encoders in joint order [rad].
            boxes: The last measured boxes of the object, as many as the method remembers.

        Returns:
            Where the joints shall be at its end [rad].

        Raises:
            NonFiniteError: There is a NaN or an infinity; nothing is remembered of it.
        """
        _refuse_non_finite(joint_pos, boxes)
        past, now = self._past, self._measure(joint_pos, boxes)
        history = History(now, now, now)
        if past is not None:
            history = History(past.history.before, past.history.now, now)
        actions = self._policy.act(self.method.observe(history))
        action = torch.cat([actions[agent.name] for agent in self.method.agents], dim=-1)
        target = self._action_map.joint_pos_target(action, now.joint_pos)
        self._past = _Past(history, action, target)
        return target

    def _measure(self, joint_pos: Float[Tensor, "1 num_joints"], boxes: BoxHistory) -> Measurement:
        """The measurement as the environment makes it; what only a tracker sees is not a number."""
        past = self._past
        palm_pos, palm_quat = palm_pose(joint_pos[:, : len(ARM_JOINTS)])
        held = joint_pos if self._held is None else self._held
        return Measurement(
            boxes=boxes,
            object_pos=_UNKNOWN,
            initial_object_pos=_UNKNOWN,
            joint_pos=joint_pos,
            joint_pos_target=held if past is None else past.joint_pos_target,
            palm_pos=palm_pos,
            palm_quat=palm_quat,
            action=torch.zeros_like(joint_pos) if past is None else past.action,
        )


_UNKNOWN = torch.full((1, 3), torch.nan)


def _refuse_trackers(method: Method, measurement: Measurement) -> None:
    """Refuse a method whose observation depends on what a measurement does not have."""
    columns = pixel_columns(method.pixel_features)
    for agent in method.agents:
        frame = Frame(before=measurement, now=measurement, joints=agent.joints, pixel_columns=columns)
        terms = (*agent.observation, *agent.memory)
        blind = [term.__name__ for term in terms if not term(frame).isfinite().all()]
        if blind:
            raise PolicyMismatchError(
                f"a policy of method '{method.name}' reads {', '.join(blind)}, which one camera cannot give; "
                "deploy a policy that reads pixel features, such as 'proposed'."
            )


def _refuse_non_finite(joint_pos: Float[Tensor, "1 num_joints"], boxes: BoxHistory) -> None:
    is_good = joint_pos.isfinite()[0].tolist()
    bad = [joint.name for joint, good in zip(JOINTS, is_good, strict=True) if not good]
    bad += [] if boxes.box.isfinite().all() else ["the object's box"]
    bad += [] if boxes.age.isfinite().all() else ["the age of the object's box"]
    if bad:
        raise NonFiniteError(
            f"a reading has a NaN or an infinity for {', '.join(bad)}; stop, and look at what sent it."
        )
