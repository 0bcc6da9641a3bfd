"""The analytic catcher: ballistic fit, inverse kinematics, and a hand that closes by time. Nothing is learnt.

It keeps no state: an observation has all boxes of the flight, and the last action has the share by which the
hand is closed. At the start of a throw all actions are 0. It computes on the CPU.

Source: ours. The constants are tuned on throws of the nominal task (experiments/LOG.md, 2026-11-30).
"""

from math import sqrt
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import normalize, pad

from pixel2catch.agents import commands_of
from pixel2catch.batches import Features, Flags, Joints, Vectors
from pixel2catch.camera.level import LEVEL_CAMERA
from pixel2catch.camera.pinhole import center_and_size, project
from pixel2catch.errors import InvalidValueError, PolicyMismatchError
from pixel2catch.mdp.throws import ThrowCfg, launch_velocity
from pixel2catch.methods import find_method
from pixel2catch.policy.contract import AgentContract, contract_of
from pixel2catch.policy.policy import Policy
from pixel2catch.robots.geometry import Chain, chain_of, damped_step, joints_reaching, pose_and_slopes
from pixel2catch.robots.workcell import WorkcellSpec
from pixel2catch.scene.constants import CONTROL_DT, GRAVITY
from pixel2catch.workcells import find_workcell
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

CENTER_NOISE = 2.2  #: Deviation of a box centre [px]. Source: ours, edges that are up to 5 px off.
OUTLIER = 5.0  #: Deviation of a centre at which its weight is halved [of `CENTER_NOISE`]. Source: ours.
UNLIKELY = 2.0
"""Deviation of a parameter at which the prior's weight is halved [deviations of its range]. Source: ours."""
MOTION = 12.0  #: Distance from the oldest centre from which an object flies [px]. Source: ours.
NUM_STEPS, NUM_PLAIN = 6, 2  #: Gauss-Newton steps, and those that weight all boxes alike. Source: ours.
DIFFERENCE = 1e-4  #: Change of a parameter for a derivative [deviations]. Source: ours.
TIME_STIFFNESS = 1e-3  #: Damping of the release time, which has no prior [1/step²]. Source: ours.
LEAST_RISE = 0.05  #: Least height of the peak over release and catch height [m]. Source: ours.

METHODS_OF = {"analytic": "analytic+flight", "analytic_told": "analytic_told+age"}
"""What each policy observes: the name of its method and memory."""

FALL = torch.tensor([0.0, 0.0, -GRAVITY], dtype=torch.float64)  #: Acceleration in flight [m/s²].


class BallisticFit:
    """Fits the most probable throw to boxes, with gravity as the scale; a task's ranges are the prior.

    Parameters of a throw: position at release, peak height, the point in the plane of the catch height
    through which it falls, and the time of release, before which the object is at rest.
    """

    def __init__(self, throws: ThrowCfg) -> None:
        ranges = (throws.release_x, throws.release_y, throws.release_z)
        ranges += (throws.peak_z, throws.aim_x, throws.aim_y)
        middle, deviation = zip(*(((a + b) / 2.0, (b - a) / sqrt(12.0)) for a, b in ranges), strict=True)
        self._middle = torch.tensor([*middle, 0.0], dtype=torch.float64)
        self._scale = torch.tensor([*deviation, CONTROL_DT], dtype=torch.float64)
        self._is_drawn = torch.tensor([1.0] * len(ranges) + [0.0], dtype=torch.float64)
        self.catch_height = sum(throws.aim_z) / 2.0  #: Middle of the task's catch heights [m].

    def __call__(
        self,
        box: Float[Tensor, "num_envs num_boxes 4"],
        age: Float[Tensor, "num_envs num_boxes"],
        camera_pos: Vectors,
    ) -> tuple[Vectors, Vectors, Flags]:
        """Return the object's position [m] and velocity [m/s] now, and whether it flies.

        Boxes are those of the level camera [px], newest first, with their ages [control steps].
        """
        (center, _), time = center_and_size(box), -age * CONTROL_DT
        is_repeated = (box[:, 1:] == box[:, :-1]).all(-1)  # a history begins with one box, several times
        is_known = pad(~is_repeated, (1, 0), value=True).to(center)
        has_moved = torch.linalg.vector_norm(center - center[:, -1:], dim=-1) > MOTION
        first = (has_moved * torch.arange(1, age.shape[1] + 1)).amax(1)
        release = time.gather(1, (first[:, None] - 1).clamp(min=0)) - 0.5 * CONTROL_DT
        throw = torch.cat((self._middle[:-1].expand(len(age), -1), release), dim=-1)
        changes = pad(DIFFERENCE * torch.diag(self._scale), (0, 0, 1, 0))
        for step in range(NUM_STEPS):
            seen = self._pixels(throw[:, None] + changes, time, camera_pos)
            error = (center - seen[:, 0]) / CENTER_NOISE
            slope = (seen[:, 1:] - seen[:, :1]) / (DIFFERENCE * CENTER_NOISE)
            outliers = error.square().sum(-1) / OUTLIER**2 if step >= NUM_PLAIN else 0.0
            weighted = (slope * (is_known / (1.0 + outliers))[:, None, :, None]).flatten(2)
            away = (throw - self._middle) / self._scale
            prior = self._is_drawn / (1.0 + (away / UNLIKELY).square())
            damp = torch.diag_embed(prior + TIME_STIFFNESS * (1.0 - self._is_drawn))
            normal = weighted @ slope.flatten(2).transpose(1, 2) + damp
            down = (weighted @ error.flatten(1)[..., None])[..., 0] - prior * away
            throw = throw + self._scale * torch.linalg.solve(normal, down).clamp(-5.0, 5.0)
        pos, vel = self._states(throw, torch.zeros_like(time[:, :1]))
        return pos[:, 0], vel[:, 0], first > 0

    def _pixels(self, throw: Tensor, time: Tensor, camera_pos: Vectors) -> Tensor:
        """Return where the level camera sees several throws of each environment at its times [px]."""
        several = throw.shape[1]
        pos, _ = self._states(throw.flatten(0, 1), time.repeat_interleave(several, 0))
        place = pos - camera_pos.repeat_interleave(several, 0)[:, None]
        return project(LEVEL_CAMERA, place)[0].unflatten(0, (-1, several))

    def _states(self, throw: Float[Tensor, "n 7"], time: Float[Tensor, "n k"]) -> tuple[Tensor, Tensor]:
        """Return positions [m] and velocities [m/s] of throws at times [s]."""
        pos, height = throw[:, :3], torch.full_like(throw[:, :1], self.catch_height)
        peak = torch.maximum(throw[:, 3], pos[:, 2].clamp(min=self.catch_height) + LEAST_RISE)
        vel = launch_velocity(pos, torch.cat((throw[:, 4:6], height), dim=-1), peak)
        since = (time - throw[:, 6:]).clamp(min=0.0)[..., None]
        fall = since * FALL
        return pos[:, None] + (vel[:, None] + 0.5 * fall) * since, vel[:, None] + fall


class Catcher(nn.Module):
    """From the observation to the actions of all joints."""

    def __init__(self, workcell: WorkcellSpec, contract: AgentContract, throws: ThrowCfg) -> None:
        """Read the robot from a work cell with one palm, and the order of the observation from a contract."""
        super().__init__()
        if len(workcell.palms) != 1:
            raise InvalidValueError(f"'{workcell.name}' has {len(workcell.palms)} palms; 'analytic' needs 1.")
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
        """Make the policy of a name: analytic, analytic_told, or one of them with `@WORKCELL`."""
        nn.Module.__init__(self)
        method_name, _, cell = name.partition("@")
        workcell = find_workcell(cell or UR5E_ALLEGRO.name)
        method = find_method(METHODS_OF[method_name], workcell)
        self.contract, self.hidden = contract_of(method, workcell), ()
        self.agents = nn.ModuleDict(
            {name: Catcher(workcell, agent, ThrowCfg()) for name, agent in self.contract.agents.items()}
        )

    @property
    def description(self) -> str:
        """Raise PolicyMismatchError: no file has this policy."""
        name = self.contract.method
        raise PolicyMismatchError(f"policy '{name}' is computed, without networks; give a trained policy.")
