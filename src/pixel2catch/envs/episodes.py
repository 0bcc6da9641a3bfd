"""What an episode has been so far, environment by environment, on the device."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from pixel2catch.envs.physics_log import PhysicsLog
from pixel2catch.mdp.columns import Columns, take
from pixel2catch.mdp.snapshot import Transition
from pixel2catch.mdp.terminations import HOLD_STEPS, is_dropped, is_near, is_success
from pixel2catch.scene.constants import CONTROL_DT

REST_STEPS = HOLD_STEPS // 2
"""Last control steps before a success in which robot and hold should have come to rest. Source: ours."""


@dataclass(frozen=True, kw_only=True)
class EpisodeRecord:
    """The present episode of each environment so far."""

    object_id: Int[Tensor, " num_envs"]  #: Row of the object in the table of objects.
    aim: Float[Tensor, "num_envs 3"]  #: Where the throw was aimed at, world frame [m].
    steps: Int[Tensor, " num_envs"]  #: Control steps.
    #: Consecutive control steps with the object near the palm, up to now.
    held_steps: Int[Tensor, " num_envs"]
    is_tracked: Bool[Tensor, " num_envs"]  #: Whether the palm reached the object (T.R.).
    is_success: Bool[Tensor, " num_envs"]  #: Whether it was held long enough (S.R.).
    is_palm_contact: Bool[Tensor, " num_envs"]  #: Whether a palm itself touched it.
    is_hand_contact: Bool[Tensor, " num_envs"]  #: Whether any part of the hand did.
    is_dropped: Bool[Tensor, " num_envs"]  #: Whether it fell or passed the robot.
    is_table_contact: Bool[Tensor, " num_envs"]  #: Whether the robot touched the table.
    is_self_contact: Bool[Tensor, " num_envs"]  #: Whether the robot touched itself.
    self_contact_steps: Int[Tensor, " num_envs"]  #: Control steps in which it did.
    #: Height of the object at its first contact with the hand [m]; 0 before.
    contact_height: Float[Tensor, " num_envs"]
    contact_steps: Int[Tensor, " num_envs"]  #: Control steps with contact of object and hand.
    penetration_sum: Float[Tensor, " num_envs"]  #: Deepest overlap of each of them, summed [m].
    #: Deepest overlap of the object with anything, over all physics steps [m].
    max_penetration: Float[Tensor, " num_envs"]
    max_table_penetration: Float[Tensor, " num_envs"]  #: Likewise of robot and table [m].
    #: Largest speed of an arm joint, over all physics steps [rad/s].
    max_joint_speed: Float[Tensor, " num_envs"]
    max_torque_share: Float[Tensor, " num_envs"]  #: Largest joint torque as a share of its limit.
    #: Mean speed of the arm's joints in the last `REST_STEPS` of a success [rad/s]; of no meaning without
    #: one.
    hold_speed: Float[Tensor, " num_envs"]
    #: Mean torque of the hand's joints then, as a share of their limits; likewise.
    hold_torque_share: Float[Tensor, " num_envs"]
    #: Largest change of the object's velocity in a control step over its duration, from that of the first
    #: contact with the hand to success [m/s²].
    peak_deceleration: Float[Tensor, " num_envs"]

    @classmethod
    def start(cls, object_id: Int[Tensor, " num_envs"], aim: Float[Tensor, "num_envs 3"]) -> "EpisodeRecord":
        """Records of episodes that have just begun."""
        none, no, zero = (
            torch.zeros_like(object_id),
            torch.zeros_like(object_id, dtype=torch.bool),
            aim.new_zeros(len(aim)),
        )
        return cls(
            object_id=object_id,
            aim=aim,
            steps=none,
            held_steps=none,
            is_tracked=no,
            is_success=no,
            is_palm_contact=no,
            is_hand_contact=no,
            is_dropped=no,
            is_table_contact=no,
            is_self_contact=no,
            self_contact_steps=none,
            contact_height=zero,
            contact_steps=none,
            penetration_sum=zero,
            max_penetration=zero,
            max_table_penetration=zero,
            max_joint_speed=zero,
            max_torque_share=zero,
            hold_speed=zero,
            hold_torque_share=zero,
            peak_deceleration=zero,
        )

    def advanced(
        self, transition: Transition, log: PhysicsLog, arms: Columns, palms: Columns
    ) -> "EpisodeRecord":
        """The records one control step later; `held_steps` and `steps` are those of the transition.

        Args:
            transition: The step.
            log: What happened within it.
            arms: Columns of the joints of arms.
            palms: Columns of the palms among what may touch the object.
        """
        touched = log.is_touching.any(dim=-1)
        first = touched & ~self.is_hand_contact
        return replace(
            self,
            object_id=self.object_id.clone(),
            aim=self.aim.clone(),
            steps=transition.episode_steps,
            held_steps=transition.held_steps,
            is_tracked=self.is_tracked | is_near(transition.now),
            is_success=self.is_success | is_success(transition),
            is_palm_contact=self.is_palm_contact | take(log.is_touching, palms).any(dim=-1),
            is_hand_contact=self.is_hand_contact | touched,
            is_dropped=self.is_dropped | is_dropped(transition.now),
            is_table_contact=self.is_table_contact | log.is_robot_on_table,
            is_self_contact=self.is_self_contact | log.is_self_contact,
            self_contact_steps=self.self_contact_steps + log.is_self_contact.long(),
            contact_height=torch.where(first, transition.now.object_pos[:, 2], self.contact_height),
            contact_steps=self.contact_steps + touched.long(),
            penetration_sum=self.penetration_sum + torch.where(touched, log.penetration, 0.0),
            max_penetration=torch.maximum(self.max_penetration, log.penetration),
            max_table_penetration=torch.maximum(self.max_table_penetration, log.table_penetration),
            max_joint_speed=torch.maximum(self.max_joint_speed, log.joint_speed),
            max_torque_share=torch.maximum(self.max_torque_share, log.torque_share),
            hold_speed=self._at_rest(self.hold_speed, _speed(transition, arms), transition),
            hold_torque_share=self._at_rest(self.hold_torque_share, log.hand_torque_share, transition),
            peak_deceleration=torch.where(
                (self.is_hand_contact | touched) & ~self.is_success,
                torch.maximum(self.peak_deceleration, _deceleration(transition)),
                self.peak_deceleration,
            ),
        )

    def _at_rest(
        self, mean: Float[Tensor, " num_envs"], value: Float[Tensor, " num_envs"], transition: Transition
    ) -> Float[Tensor, " num_envs"]:
        """A mean over the last steps of a hold, one step later; a hold that fails has none.

        Args:
            mean: The sum so far over the number of these steps; that of a success stays.
            value: What is added.
            transition: The step.
        """
        is_resting = transition.held_steps > HOLD_STEPS - REST_STEPS
        longer = torch.where(is_resting, mean + value / REST_STEPS, 0.0)
        return torch.where(self.is_success, mean, longer)


def _speed(transition: Transition, joints: Columns) -> Float[Tensor, " num_envs"]:
    """Mean speed of joints [rad/s]."""
    return take(transition.now.joint_vel, joints).abs().mean(dim=-1)


def _deceleration(transition: Transition) -> Float[Tensor, " num_envs"]:
    """Mean acceleration of the object in the control step, gravity included [m/s²]."""
    change = transition.now.object_lin_vel - transition.before.object_lin_vel
    return torch.linalg.vector_norm(change, dim=-1) / CONTROL_DT


FAILURES = ("never_reached", "bounced_off", "dropped", "not_held")
"""Why an episode without success failed: the palm never came near; it came near and was never touched again
within three control steps; it was touched longer and fell; time ran out with the object still up."""


def failure(record: EpisodeRecord) -> Int[Tensor, " num_envs"]:
    """Index into `FAILURES` of each episode; meaningless for a success."""
    lost = torch.where(record.contact_steps <= 3, 1, 2)
    reached = torch.where(record.is_dropped, lost, 3)
    return torch.where(record.is_tracked, reached, 0)
