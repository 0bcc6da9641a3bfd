"""The analytic catcher: ballistic fit, inverse kinematics, and a hand that closes by time. Nothing is learnt.

It keeps no state: an observation has all boxes of the flight, and the last action has the share by which the
hand is closed. At the start of a throw all actions are 0. It computes on the CPU.

Source: ours. The constants are tuned on throws of the nominal task (experiments/LOG.md, 2026-11-30).
"""

from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.functional import normalize

from pixel2catch.agents import commands_of
from pixel2catch.batches import Features, Flags, Joints, Vectors
from pixel2catch.errors import InvalidValueError, PolicyMismatchError
from pixel2catch.mdp.throws import ThrowCfg
from pixel2catch.methods import find_method
from pixel2catch.policy.ballistics import BallisticFit
from pixel2catch.policy.contract import AgentContract, contract_of
from pixel2catch.policy.policy import Policy
from pixel2catch.robots.geometry import Chain, chain_of
from pixel2catch.robots.inverse import damped_step, joints_reaching, pose_and_slopes
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

FALL = torch.tensor([0.0, 0.0, -GRAVITY], dtype=torch.float64)  #: Acceleration in flight [m/s²].


class Catcher(nn.Module):
    """From the observation to the actions of all joints."""

    def __init__(self, workcell: WorkcellSpec, contract: AgentContract, throws: ThrowCfg) -> None:
        """Read the robot from a work cell with one palm, and the order of the observation from a contract."""
        super().__init__()
        if len(workcell.palms) != 1:
            raise InvalidValueError(
                f"work cell '{workcell.name}' has {len(workcell.palms)} palms; an analytic policy needs one."
            )
        self._fit, self._sizes = BallisticFit(throws), dict(contract.observation)
        (palm,) = workcell.palms
        self._arm, self._hand = palm.carriers, slice(palm.carriers.stop, None)
        joints = [(j.home, j.lower, j.upper, j.velocity_limit) for j in workcell.joints]
        home, *limits, speeds = _tensor(joints).T
        limits = torch.stack(limits)
        self._limits, self._speeds = limits[:, self._arm].clone(), speeds[self._arm]
        self._chain = chain_of(workcell, palm)
        self._normal = _tensor(palm.spec.normal)
        aim = [sum(values) / 2.0 for values in (throws.aim_x, throws.aim_y, throws.aim_z)]
        place, axis = _tensor([aim]) + _tensor(WAIT_OFFSET), _tensor([WAIT_AXIS])
        start = home[None, self._arm]
        self._ready = self._reaching(start, place, axis, num_steps=50)  # where the arm waits [rad]

        at_home = pose_and_slopes(self._chain, start)[0][0]
        normal, palm_pos = at_home[:3, :3] @ self._normal, at_home[:3, 3]
        limits[:, self._arm] = home[self._arm]
        cup, closed, tips = home.clone(), home.clone(), list[Tensor]()
        for finger in palm.spec.fingers:
            chain = Chain(workcell, finger.tip, "cpu", torch.float64)
            columns = chain.columns
            tips.append(pose_and_slopes(chain, home[None, columns])[0][0, :3, 3])
            grip = (palm_pos + GRIP * normal)[None]
            bent = joints_reaching(chain, home[None, columns], limits[:, columns], grip, num_steps=60)[0]
            own = [column for column in columns if column >= palm.carriers.stop]
            closed[own] = bent[-len(own) :]
            share = _tensor([CUP_FIRST] + [CUP_OTHERS] * (len(own) - 1))
            cup[own] = home[own] + share * (closed[own] - home[own])
        offset, scale = _tensor([(c.offset, c.scale) for c in commands_of(workcell)]).T
        postures = (((each - offset) / scale).clamp(-1.0, 1.0)[self._hand] for each in (home, cup, closed))
        self._open, self._cup, self._closed = postures  # actions of the hand
        way = torch.stack(tips).mean(dim=0) - palm_pos
        local_way = at_home[:3, :3].T @ normalize(way - (way @ normal) * normal, dim=0)
        # Where fingers point as the arm waits, world frame.
        self._fingers = pose_and_slopes(self._chain, self._ready)[0][0, :3, :3] @ local_way

    def forward(self, observation: Features) -> Joints:
        """Return the actions of all joints."""
        parts = observation.cpu().double().split([*self._sizes.values()], dim=-1)
        part = dict(zip(self._sizes, parts, strict=True))
        joint_pos, last = part["joint_pos[t]"][:, self._arm], part["last_action[t]"]
        pos, vel, is_flying = self._flight(part)
        time, meeting, meeting_vel = self._meeting(pos, vel, joint_pos)
        way, hand = self._closed - self._cup, last[:, self._hand]
        share = ((hand - self._cup) @ way / way.square().sum()).clamp(0.0, 1.0)  # by which it is closed
        share = torch.where((hand == 0.0).all(-1) | (share < 0.5 * CLOSING_STEP), 0.0, share)
        is_closing = (share > 0.0) | (is_flying & (time < CLOSING_TIME))
        share = torch.where(is_closing, (share + CLOSING_STEP).clamp(max=1.0), 0.0)[:, None]
        run = (RUN_UP + LEAD - time).clamp(min=0.0)[:, None]  # time since the run-up began
        reference = meeting + 0.5 * meeting_vel * (run.square() / RUN_UP - RUN_UP)
        approach = meeting_vel * run / RUN_UP + GAIN * (reference - joint_pos)
        action = torch.where(is_flying[:, None], approach, 0.5 * GAIN * (self._ready - joint_pos))
        action = action / (action.abs() / self._speeds).amax(-1, keepdim=True).clamp(min=1.0) / self._speeds
        arm = torch.where(share > HELD_SHARE, FADE * last[:, self._arm], action)
        is_cupped = is_closing | (is_flying & (time < CUP_TIME))
        hand = torch.where(is_cupped[:, None], self._cup + share * way, self._open)
        return torch.cat((arm, hand), dim=-1).to(observation)

    def _flight(self, part: dict[str, Tensor]) -> tuple[Vectors, Vectors, Flags]:
        """Return position [m] and velocity [m/s] of the object now, and whether it flies."""
        if "measured_boxes[t]" in part:
            *box, age = part["measured_boxes[t]"].unflatten(-1, (5, -1)).unbind(1)
            return self._fit(torch.stack(box, dim=-1), age, part["camera_position[t]"])
        pos, step = part["object_position[t]"].split(3, dim=-1)
        age = CONTROL_DT * part["box_age[t]"]
        vel = step / CONTROL_DT + (age + 0.5 * CONTROL_DT) * FALL  # the mean one of a step, and what follows
        return pos + (vel - 0.5 * age * FALL) * age, vel, torch.linalg.vector_norm(step, dim=-1) > IS_STEP

    def _meeting(self, pos: Vectors, vel: Vectors, joint_pos: Joints) -> tuple[Tensor, Joints, Joints]:
        """Return time [s], joints and joint velocities of the best meeting: in time, in reach, and low."""
        height = self._fit.catch_height + _tensor(HEIGHTS)
        square = vel[:, 2:].square() + 2.0 * GRAVITY * (pos[:, 2:] - height)
        time = (vel[:, 2:] + square.clamp(min=0.0).sqrt()) / GRAVITY
        late = time[..., None]
        place = (pos[:, None] + (vel[:, None] + 0.5 * late * FALL) * late).flatten(0, 1)
        speed = (vel[:, None] + late * FALL).flatten(0, 1)
        give = speed * _tensor(GIVE)
        axis = normalize(give - speed, dim=-1)
        along = normalize(self._fingers - (axis @ self._fingers)[:, None] * axis, dim=-1)
        point = place - SEAT * axis + FORWARD * along
        reached = self._reaching(self._ready.expand(len(point), -1), point, axis)
        pose, slopes = pose_and_slopes(self._chain, reached)
        joint_vel = damped_step(slopes[..., :3, 3], give, VELOCITY_DAMPING)
        excess = (joint_vel.abs() / (SPEED_SHARE * self._speeds)).amax(-1, keepdim=True)
        missed = torch.linalg.vector_norm(point - pose[:, :3, 3], dim=-1).unflatten(0, time.shape)
        reached = reached.unflatten(0, time.shape)
        needed = ((reached - joint_pos[:, None]).abs() / self._speeds).amax(-1)
        cost = (needed - time).clamp(min=0.0) / LATE + missed / MISSED + (height - height[0]).abs() / HIGH
        best = torch.arange(len(pos)), torch.where(square > 0.0, cost, torch.inf).argmin(-1)
        return time[best], reached[best], (joint_vel / excess.clamp(min=1.0)).unflatten(0, time.shape)[best]

    def _reaching(self, start: Joints, point: Vectors, axis: Vectors, num_steps: int = 8) -> Joints:
        return joints_reaching(self._chain, start, self._limits, point, axis, self._normal, num_steps)


def _tensor(values: Any) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


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
