"""The analytic catcher: ballistic fit, inverse kinematics, and a hand that closes by time. Nothing is learnt.

It keeps no state: an observation has all boxes of the flight, and the last action has the share by which the
hand is closed. At the start of a throw all actions are 0.

Source: ours. The constants are tuned on throws of the nominal task (experiments/LOG.md, 2026-11-30).
"""

from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from pixel2catch.agents import commands_of
from pixel2catch.errors import InvalidValueError, PolicyMismatchError
from pixel2catch.mdp.throws import ThrowCfg
from pixel2catch.methods import find_method
from pixel2catch.policy.ballistics import BallisticFit
from pixel2catch.policy.contract import AgentContract, contract_of
from pixel2catch.policy.policy import Policy
from pixel2catch.robots.inverse import chain_to, damped_solution, joints_reaching, pose_and_slopes
from pixel2catch.robots.workcell import WorkcellSpec
from pixel2catch.scene.constants import CONTROL_DT, GRAVITY
from pixel2catch.workcells import known_workcell
from pixel2catch.workcells.ur5e_allegro import UR5E_ALLEGRO

HEIGHTS = (0.04, -0.04, 0.12, 0.2, 0.32, 0.44)
"""Heights of meeting points over the task's catch height, the preferred one first [m]."""
WAIT_OFFSET = (-0.03, 0.0, 0.25)  #: Where the palm waits, from the mean aim of the task's throws [m].
WAIT_AXIS = (0.5, 0.0, 0.866)  #: Direction of the palm there.
SEAT, FORWARD = 0.059, 0.012
"""Distance of the object from the palm at the meeting, and how far the palm is then further towards the
direction of its fingers than the object [m]."""
GIVE = (0.21, 0.21, 0.6)  #: Shares of the object's velocity that the palm has at the meeting, along x, y, z.
LEAD = 0.35 * CONTROL_DT  #: Time by which the reference is ahead, for the lag of the arm [s].
RUN_UP = 0.225  #: Time in which the palm accelerates to that velocity [s].
GAIN = 7.8  #: Speed by distance from the reference [1/s].
SPEED_SHARE = 0.95  #: Largest planned share of a joint's speed limit.
VELOCITY_DAMPING = 3e-3  #: Damping of the joint velocities at the meeting [m²/rad²].
CUP_TIME = 0.55
"""Time from the command to cup the hand to the meeting [s]. Source: ours; the servo expects no object at the
fingers in the first 0.4 s of a quick motion that follows 0.6 s of rest."""
CLOSING_TIME = 2.15 * CONTROL_DT  #: Time from the first command to close to the meeting [s].
CLOSING_STEP, HELD_SHARE = 0.25, 0.6
"""Share by which the hand closes in a control step, and share from which the arm comes to rest."""
FADE = 0.41  #: Factor by which the arm's action falls in each further control step.
CUP_FIRST, CUP_OTHERS = 0.435, 0.065
"""Shares by which the first joint and the other joints of each finger are closed before the meeting."""
GRIP = 0.037  #: Distance from the palm to which closed fingertips reach [m].
IS_STEP = 0.03  #: Distance in a control step from which an object flies [m]; it falls 5 mm in the first.
LATE, MISSED, HIGH = 0.1, 0.02, 0.3
"""Lack of time [s], distance from the point [m] and distance from the preferred height [m] of equal cost."""


METHODS_OF = {"analytic": "analytic+flight", "analytic_told": "analytic_told+age"}
"""What each policy observes: the name of its method and memory."""


class Meeting(NamedTuple):
    """Where and when the palm meets the object."""

    time: Float[Tensor, " num_envs"]  #: Time from now [s].
    joint_pos: Float[Tensor, "num_envs num_joints"]  #: Positions of the arm's joints then [rad].
    joint_vel: Float[Tensor, "num_envs num_joints"]  #: Their velocities then [rad/s].


class Catcher(nn.Module):
    """From the observation to the actions of all joints."""

    matrices: Tensor  #: Those of the `Chain` to the palm.
    limits: Tensor  #: Lower and upper limits of the arm's joints [rad].
    speeds: Tensor  #: Their largest speeds [rad/s].
    normal: Tensor  #: Direction out of the palm, in its frame.
    ready: Tensor  #: Joint positions in which the arm waits [rad].
    fingers: Tensor  #: Direction of the fingers there, world frame.
    open: Tensor  #: Actions of the hand at its start position.
    cup: Tensor  #: Those before the meeting.
    closed: Tensor  #: Those of the closed hand.

    def __init__(self, workcell: WorkcellSpec, contract: AgentContract, throws: ThrowCfg) -> None:
        """Read the robot from a work cell with one palm, and the order of the observation from a contract."""
        super().__init__()
        if len(workcell.palms) != 1:
            raise InvalidValueError(
                f"work cell '{workcell.name}' has {len(workcell.palms)} palms; an analytic policy needs one."
            )
        self.fit = BallisticFit(throws)
        self._sizes = dict(contract.observation)
        (palm,) = workcell.palms
        self._arm, self._hand = palm.carriers, slice(palm.stop, None)
        arm, commands = workcell.joints[self._arm], commands_of(workcell)[self._hand]
        matrices, home = chain_to(workcell, palm.spec.site)[0].matrices, _tensor([j.home for j in arm])
        limits, normal = _tensor([[j.lower for j in arm], [j.upper for j in arm]]), _tensor(palm.spec.normal)
        aim = [sum(values) / 2.0 for values in (throws.aim_x, throws.aim_y, throws.aim_z)]
        place, axis = _tensor([aim]) + _tensor(WAIT_OFFSET), _tensor([WAIT_AXIS])
        ready = joints_reaching(matrices, home[None], limits, place, axis, normal, num_steps=50)
        *postures, fingers = _hand_postures(workcell)
        offset, scale = _tensor([[c.offset for c in commands], [c.scale for c in commands]])
        opened, cup, closed = (((each - offset) / scale).clamp(-1.0, 1.0) for each in postures)
        buffers = {
            "matrices": matrices,
            "limits": limits,
            "speeds": _tensor([joint.velocity_limit for joint in arm]),
            "normal": normal,
            "ready": ready[0],
            "fingers": pose_and_slopes(matrices, ready)[0][0, :3, :3] @ fingers,
            "open": opened,
            "cup": cup,
            "closed": closed,
        }
        for name, values in buffers.items():
            self.register_buffer(name, values)

    def forward(self, observation: Float[Tensor, "num_envs k"]) -> Float[Tensor, "num_envs num_joints"]:
        """Return the actions of all joints."""
        parts = observation.double().split([*self._sizes.values()], dim=-1)
        part = dict(zip(self._sizes, parts, strict=True))
        joint_pos, last = part["joint_pos[t]"][:, self._arm], part["last_action[t]"]
        pos, vel, is_flying = self._flight(part)
        meeting = self._meeting(pos, vel, joint_pos)
        share = self._closed_share(last[:, self._hand])
        is_closing = (share > 0.0) | (is_flying & (meeting.time < CLOSING_TIME))
        share = torch.where(is_closing, (share + CLOSING_STEP).clamp(max=1.0), 0.0)[:, None]
        waiting = 0.5 * GAIN * (self.ready - joint_pos)
        action = torch.where(is_flying[:, None], self._approach(meeting, joint_pos), waiting) / self.speeds
        action = action / action.abs().amax(-1, keepdim=True).clamp(min=1.0)
        arm = torch.where(share > HELD_SHARE, FADE * last[:, self._arm], action)
        is_cupped = is_closing | (is_flying & (meeting.time < CUP_TIME))
        hand = torch.where(is_cupped[:, None], self.cup + share * (self.closed - self.cup), self.open)
        return torch.cat((arm, hand), dim=-1).to(observation)

    def _flight(
        self, part: dict[str, Tensor]
    ) -> tuple[Float[Tensor, "num_envs 3"], Float[Tensor, "num_envs 3"], Bool[Tensor, " num_envs"]]:
        """Return position [m] and velocity [m/s] of the object now, and whether it flies."""
        if "measured_boxes[t]" in part:
            *box, age = part["measured_boxes[t]"].unflatten(-1, (5, -1)).unbind(1)
            return self.fit(torch.stack(box, dim=-1), age, part["camera_position[t]"])
        pos, step = part["object_position[t]"].split(3, dim=-1)
        age, fall = CONTROL_DT * part["box_age[t]"], _gravity(pos)
        vel = step / CONTROL_DT + (age + 0.5 * CONTROL_DT) * fall  # the mean one of a step, and what follows
        is_flying = torch.linalg.vector_norm(step, dim=-1) > IS_STEP
        return pos + (vel - 0.5 * age * fall) * age, vel, is_flying

    def _meeting(self, pos: Tensor, vel: Tensor, joint_pos: Tensor) -> Meeting:
        """Return the best meeting at `HEIGHTS`: in time, within reach, of preferred height."""
        height = self.fit.catch_height + pos.new_tensor(HEIGHTS)
        up, fall = vel[:, 2:], _gravity(pos)
        square = up.square() + 2.0 * GRAVITY * (pos[:, 2:] - height)
        time = (up + square.clamp(min=0.0).sqrt()) / GRAVITY
        late = time[..., None]
        place = pos[:, None] + (vel[:, None] + 0.5 * late * fall) * late
        speed = (vel[:, None] + late * fall).flatten(0, 1)
        give = speed * speed.new_tensor(GIVE)
        axis = nn.functional.normalize(give - speed, dim=-1)
        along = nn.functional.normalize(self.fingers - (axis @ self.fingers)[:, None] * axis, dim=-1)
        point, start = place.flatten(0, 1) - SEAT * axis + FORWARD * along, self.ready.expand(len(speed), -1)
        reached = joints_reaching(self.matrices, start, self.limits, point, axis, self.normal)
        pose, slopes = pose_and_slopes(self.matrices, reached)
        damp = VELOCITY_DAMPING * torch.eye(len(self.ready)).to(pose)
        joint_vel = damped_solution(slopes[..., :3, 3], give, damp)
        joint_vel = joint_vel / (joint_vel.abs() / (SPEED_SHARE * self.speeds)).amax(-1, keepdim=True).clamp(
            min=1.0
        )
        missed = torch.linalg.vector_norm(point - pose[:, :3, 3], dim=-1).unflatten(0, time.shape)
        reached, joint_vel = (values.unflatten(0, time.shape) for values in (reached, joint_vel))
        needed = ((reached - joint_pos[:, None]).abs() / self.speeds).amax(-1)
        cost = (needed - time).clamp(min=0.0) / LATE + missed / MISSED + (height - height[0]).abs() / HIGH
        best = torch.where(square > 0.0, cost, torch.inf).argmin(-1)
        row = torch.arange(len(best), device=best.device)
        return Meeting(time[row, best], reached[row, best], joint_vel[row, best])

    def _approach(self, meeting: Meeting, joint_pos: Tensor) -> Float[Tensor, "num_envs num_joints"]:
        """Return joint velocities towards a run-up of constant acceleration that ends at the meeting."""
        run = (RUN_UP + LEAD - meeting.time).clamp(min=0.0)[:, None]
        reference = meeting.joint_pos + 0.5 * meeting.joint_vel * (run.square() / RUN_UP - RUN_UP)
        return meeting.joint_vel * run / RUN_UP + GAIN * (reference - joint_pos)

    def _closed_share(self, action: Float[Tensor, "num_envs num_fingers"]) -> Float[Tensor, " num_envs"]:
        """Return the share by which a hand's action closes it; 0 at the start, when all actions are 0."""
        way = self.closed - self.cup
        share = ((action - self.cup) @ way / way.square().sum()).clamp(0.0, 1.0)
        return torch.where((action == 0.0).all(-1) | (share < 0.5 * CLOSING_STEP), 0.0, share)


def _hand_postures(workcell: WorkcellSpec) -> tuple[Tensor, ...]:
    """Return the hand's joints at the start, before the meeting and closed [rad], and where fingers point.

    That is a direction in the frame of the palm.
    """
    (palm,) = workcell.palms
    home = _tensor([joint.home for joint in workcell.joints])
    limits = _tensor([[joint.lower for joint in workcell.joints], [joint.upper for joint in workcell.joints]])
    limits[:, palm.carriers] = home[palm.carriers]
    chain, columns = chain_to(workcell, palm.spec.site)
    pose = pose_and_slopes(chain.matrices, home[None, columns])[0][0]
    axis, place = pose[:3, :3] @ _tensor(palm.spec.normal), pose[:3, 3]
    cup, closed, tips = home.clone(), home.clone(), list[Tensor]()
    for finger in palm.spec.fingers:
        chain, columns = chain_to(workcell, finger.tip)
        start, point = home[None, columns], (place + GRIP * axis)[None]
        tips.append(pose_and_slopes(chain.matrices, start)[0][0, :3, 3])
        bent = joints_reaching(chain.matrices, start, limits[:, columns], point, num_steps=60)[0]
        own = [column for column in columns if column >= palm.stop]
        closed[own] = bent[-len(own) :]
        share = _tensor([CUP_FIRST] + [CUP_OTHERS] * (len(own) - 1))
        cup[own] = home[own] + share * (closed[own] - home[own])
    way = torch.stack(tips).mean(dim=0) - place
    fingers = nn.functional.normalize(way - (way @ axis) * axis, dim=0)
    return home[palm.stop :], cup[palm.stop :], closed[palm.stop :], pose[:3, :3].T @ fingers


def _tensor(values: Any) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def _gravity(like: Tensor) -> Float[Tensor, " 3"]:
    return like.new_tensor((0.0, 0.0, -GRAVITY))


class AnalyticPolicy(Policy):
    """A policy that is computed from a work cell and the ranges of the paper's throws; it has no networks."""

    def __init__(self, name: str) -> None:
        """Make the policy of a name: analytic, analytic_told, or one of them with `@WORKCELL`.

        Raises:
            UnknownNameError: There is no such work cell.
            InvalidValueError: It has several palms.
        """
        nn.Module.__init__(self)
        method_name, _, cell = name.partition("@")
        workcell = known_workcell(cell or UR5E_ALLEGRO.name)
        method = find_method(METHODS_OF[method_name], workcell)
        self.contract, self.hidden = contract_of(method, workcell), ()
        self.agents = nn.ModuleDict(
            {name: Catcher(workcell, agent, ThrowCfg()) for name, agent in self.contract.agents.items()}
        )

    @property
    def description(self) -> str:
        """Raise PolicyMismatchError: no file has this policy."""
        raise PolicyMismatchError(
            f"policy '{self.contract.method}' is computed and has no networks to save, export or train; "
            "give a trained policy."
        )
