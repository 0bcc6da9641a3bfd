"""What is drawn at the start of each environment's episode, what happened in it, and sums over episodes."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cache
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from pixel2catch.batches import ByAgent, Counts, Features, Flags, Joints, Scalars, Vectors
from pixel2catch.devices import constant
from pixel2catch.envs.cfg import CatchEnvCfg
from pixel2catch.mdp.control_step import Columns, Privileged, Transition, take
from pixel2catch.mdp.randomization import EpisodeParameters, RandomizationCfg, sample_delay, sample_parameters
from pixel2catch.mdp.sensing import CameraErrors, is_camera_exact, sample_camera_errors
from pixel2catch.mdp.tensors import select
from pixel2catch.mdp.terminations import HOLD_STEPS, is_dropped, is_near, near_palms
from pixel2catch.mdp.throws import Throw, drawn, sample_throws
from pixel2catch.robots.geometry import WorkcellGeometry
from pixel2catch.scene.objects import OBJECTS, ObjectSpec

REST_STEPS = HOLD_STEPS // 2
"""Last control steps before a success, in which robot and hold should be at rest. Source: ours."""


class StepExtremes(NamedTuple):
    """Extremes over the physics steps of one control step."""

    #: Which palms and fingers touched the object: each palm, then its fingers.
    is_touching: Bool[Tensor, "num_envs num_parts"]
    is_robot_on_table: Flags  #: Whether a robot touched the table.
    is_self_contact: Flags  #: Whether a robot touched itself, or another one.
    is_robot_contact: Flags  #: Whether a robot touched another one.
    penetration: Scalars  #: Deepest overlap of the object with anything [m].
    joint_speed: Scalars  #: Largest speed of an arm joint [rad/s].
    torque_share: Scalars  #: Largest joint torque, as a share of its limit.
    object_force: Scalars  #: Largest net contact force on the object [N]; 0 in other engines than MuJoCo.

    def cleared(self, mask: Flags) -> "StepExtremes":
        """Return the log, cleared in the masked environments."""
        return select(mask, StepExtremes(*(torch.zeros_like(value) for value in self)), self)

    def merged(self, other: "StepExtremes") -> "StepExtremes":
        """Return the extremes of both."""
        return StepExtremes(*(torch.maximum(a, b) for a, b in zip(self, other, strict=True)))


@dataclass(frozen=True, kw_only=True)
class EpisodeRecord:
    """The present episode of each environment so far."""

    object_id: Counts  #: Row of the object in the table of objects.
    steps: Counts  #: Control steps.
    held_steps: Counts  #: Consecutive control steps with the object near the palm, up to now.
    rested_steps: Counts  #: Control steps from the first success on, that one included.
    is_tracked: Flags  #: Whether the palm reached the object (T.R.).
    is_palm_contact: Flags  #: Whether a palm itself touched it.
    is_hand_contact: Flags  #: Whether any part of the hand touched it.
    is_dropped: Flags  #: Whether it fell or passed the robot.
    is_table_contact: Flags  #: Whether the robot touched the table.
    is_self_contact: Flags  #: Whether the robot touched itself.
    is_robot_contact: Flags  #: Whether it touched another robot.
    contact_steps: Counts  #: Control steps with contact of object and hand.
    #: Deepest overlap of the object with anything in each step of `contact_steps`, summed over them [m].
    penetration_sum: Scalars
    max_penetration: Scalars  #: Deepest overlap of the object with anything, over all physics steps [m].
    max_joint_speed: Scalars  #: Largest speed of an arm joint, over all physics steps [rad/s].
    max_torque_share: Scalars  #: Largest joint torque as a share of its limit.
    max_object_force: Scalars  #: Largest `object_force` in steps in which the hand touched the object [N].
    #: Mean speed of the arm's joints in the last `REST_STEPS` of a success [rad/s]; meaningless without one.
    hold_speed: Scalars
    hold_palms: Scalars  #: Mean number of palms in reach then; likewise.

    @classmethod
    def start(cls, object_id: Counts) -> "EpisodeRecord":
        """Return records of episodes that have just begun."""
        none, no = torch.zeros_like(object_id), torch.zeros_like(object_id, dtype=torch.bool)
        begun = {name: no if name.startswith("is_") else none.float() for name in cls.__dataclass_fields__}
        counts = dict.fromkeys(("steps", "held_steps", "rested_steps", "contact_steps"), none)
        return cls(**(begun | counts | {"object_id": object_id}))

    @property
    def is_success(self) -> Flags:
        """Return whether the object was held for `HOLD_STEPS` (S.R.). Source: release."""
        return self.rested_steps > 0

    def transition(
        self,
        before: Privileged,
        now: Privileged,
        action: Joints,
        joint_pos_target: Joints,
        geometry: WorkcellGeometry,
    ) -> Transition:
        """Return the next control step, from the states before and after it."""
        held_steps = torch.where(is_near(now), self.held_steps + 1, 0)
        is_success = self.is_success | (held_steps == HOLD_STEPS)
        return Transition(
            before=before,
            now=now,
            action=action,
            joint_pos_target=joint_pos_target,
            held_steps=held_steps,
            rested_steps=torch.where(is_success, self.rested_steps + 1, 0),
            episode_steps=self.steps + 1,
            geometry=geometry,
        )

    def advanced(
        self, transition: Transition, log: StepExtremes, arms: Columns, palms: Columns
    ) -> "EpisodeRecord":
        """Return the records one control step later.

        `arms` are the columns of arm joints, `palms` those of palms in `StepExtremes.is_touching`.
        """
        touched, now = log.is_touching.any(dim=-1), transition.now
        force = torch.where(touched, log.object_force, 0.0)
        speed = take(now.joint_vel, arms).abs().mean(dim=-1)
        return replace(
            self,
            object_id=self.object_id.clone(),
            steps=transition.episode_steps,
            held_steps=transition.held_steps,
            rested_steps=transition.rested_steps,
            is_tracked=self.is_tracked | is_near(now),
            is_palm_contact=self.is_palm_contact | take(log.is_touching, palms).any(dim=-1),
            is_hand_contact=self.is_hand_contact | touched,
            is_dropped=self.is_dropped | is_dropped(now),
            is_table_contact=self.is_table_contact | log.is_robot_on_table,
            is_self_contact=self.is_self_contact | log.is_self_contact,
            is_robot_contact=self.is_robot_contact | log.is_robot_contact,
            contact_steps=self.contact_steps + touched.long(),
            penetration_sum=self.penetration_sum + torch.where(touched, log.penetration, 0.0),
            max_penetration=torch.maximum(self.max_penetration, log.penetration),
            max_joint_speed=torch.maximum(self.max_joint_speed, log.joint_speed),
            max_torque_share=torch.maximum(self.max_torque_share, log.torque_share),
            max_object_force=torch.maximum(self.max_object_force, force),
            hold_speed=self._at_rest(self.hold_speed, speed, transition),
            hold_palms=self._at_rest(self.hold_palms, near_palms(now).sum(dim=-1).float(), transition),
        )

    def _at_rest(self, mean: Scalars, value: Scalars, transition: Transition) -> Scalars:
        """Update a mean over the last steps of a hold; after a success it stays."""
        is_resting = transition.held_steps > HOLD_STEPS - REST_STEPS
        longer = torch.where(is_resting, mean + value / REST_STEPS, 0.0)
        return torch.where(self.is_success, mean, longer)


FAILURES = ("never_reached", "bounced_off", "dropped", "not_held")
"""Failures: no palm near and no contact with a hand; contact of at most three control steps; longer contact,
then a fall; time-out with the object still up."""


def failure(record: EpisodeRecord) -> Counts:
    """Return the index into `FAILURES` of each episode; meaningless for a success."""
    lost = torch.where(record.contact_steps <= 3, 1, 2)
    reached = torch.where(record.is_dropped, lost, 3)
    return torch.where(record.is_tracked | (record.contact_steps > 0), reached, 0)


@dataclass(frozen=True, kw_only=True)
class Episode:
    """The present episode of each environment."""

    parameters: EpisodeParameters  #: Object, dynamics, biases and latency.
    throw: Throw  #: The throw.
    camera_errors: CameraErrors | None  #: None without camera errors in the task.
    command_delay: Scalars  #: Control steps between a command and its effect; not always whole.
    drag: Scalars | None  #: Deceleration by air over the square of the speed [1/m]; none without air.
    side_force: Vectors | None  #: Likewise its sideways acceleration, world frame; none without such a force.
    record: EpisodeRecord  #: What became of the episode so far.

    def drawn_parameters(self) -> Features:
        """Return draws and progress of the episode, scaled to the order of 1, for value networks (ours)."""
        parameters, throw, record = self.parameters, self.throw, self.record
        columns = [
            parameters.mass_scale,
            parameters.restitution,
            parameters.friction,
            parameters.latency,
            self.command_delay,
            record.steps / 90.0,
            record.held_steps / 20.0,
            record.rested_steps / 20.0,
            (throw.hover_steps - record.steps).clamp(min=0) / 20.0,
            torch.linalg.vector_norm(throw.ang_vel, dim=-1) / 10.0,
        ]
        if self.drag is not None:
            columns.append(10.0 * self.drag)
        tables = [parameters.stiffness_scale, parameters.damping_scale, parameters.action_bias, throw.aim]
        if self.camera_errors is not None:
            columns += [10.0 * self.camera_errors.drop_rate, self.camera_errors.clock_error]
            tables += [self.camera_errors.box_bias]
        if self.side_force is not None:
            tables.append(100.0 * self.side_force)
        return torch.cat((torch.stack(columns, dim=-1), *tables), dim=-1)


def draw_episode(
    cfg: CatchEnvCfg,
    action_bias: Float[Tensor, " num_joints"],
    object_ids: Int[Tensor, " num_objects"],
    num_envs: int,
    generator: torch.Generator,
) -> Episode:
    """Draw an episode for every environment, on the generator's device.

    Each is of one of the task's variants, or of none, by their shares. `action_bias` is the standard
    deviation of the bias of each action, `object_ids` are the thrown objects. Optional disturbances are drawn
    last, so that a seed throws the same without them.
    """
    has_side_force = any(each.randomization.side_force for each in cfg.all_variants)
    has_air = has_side_force or any(each.randomization.air_density for each in cfg.all_variants)
    is_exact = all(is_camera_exact(each.sensing) for each in cfg.all_variants)

    def draw(task: CatchEnvCfg) -> Episode:
        ranges, drag = task.randomization, None
        parameters = sample_parameters(ranges, task.sensing, action_bias, object_ids, num_envs, generator)
        if has_air:
            density = drawn(ranges.air_density, num_envs, generator)
            by_object = _drag_by_object(task.scene.object_scale, tuple(OBJECTS.values()))
            by_object = constant(by_object, generator.device)[parameters.object_id]
            drag = density * by_object / parameters.mass_scale
        throw = sample_throws(task.throws, num_envs, generator, drag)
        camera_errors = None if is_exact else sample_camera_errors(task.sensing, throw, generator)
        delay = ranges.command_delay
        is_drawn = delay[0] != delay[1]  # otherwise a seed throws the same without a delay
        return Episode(
            parameters=parameters,
            throw=throw,
            camera_errors=camera_errors,
            command_delay=sample_delay(delay, ranges.command_delay_grid, num_envs, generator)
            if is_drawn
            else drawn(delay[0], num_envs, generator),
            drag=drag,
            side_force=_side_force(ranges, throw, generator) if has_side_force else None,
            record=EpisodeRecord.start(parameters.object_id),
        )

    episode = draw(cfg)
    if not cfg.variants:
        return episode
    chance = torch.rand(num_envs, generator=generator, device=generator.device)
    for variant in cfg.variants:
        is_of = (chance >= 0.0) & (chance < variant.share)
        episode = select(is_of, draw(variant.of(cfg)), episode)
        chance = chance - variant.share
    return episode


def _side_force(ranges: RandomizationCfg, throw: Throw, generator: torch.Generator) -> Vectors:
    """Draw level accelerations across the throws, to either side, over the square of the speed [1/m]."""
    num_envs = len(throw.pos)
    along = torch.nn.functional.normalize(throw.lin_vel[:, :2], dim=-1)
    across = torch.stack((-along[:, 1], along[:, 0], torch.zeros_like(along[:, 0])), dim=-1)
    sign = 1.0 - 2.0 * (torch.rand(num_envs, generator=generator, device=generator.device) < 0.5).float()
    return (sign * drawn(ranges.side_force, num_envs, generator))[:, None] * across


@cache
def _drag_by_object(scale: float, objects: tuple[ObjectSpec, ...]) -> tuple[float, ...]:
    """Return the drag of every object in air of 1 kg/m³ [1/m], in the order of the object table."""
    return tuple(0.5 * each.scaled(scale).drag_area / each.mass for each in objects)


RATES = ("success", "palm_contact", "table_contact", "self_contact", "robot_contact")
"""Names of rates, besides `tracking_rate`."""

SHARES = ("is_tracked", "is_hand_contact", "is_dropped", *(f"is_{name}" for name in RATES))
SUMS = ("steps", "contact_steps", "penetration_sum")
SUCCESS_SUMS = ("hold_speed", "hold_palms")  #: Sums over successes.

MAXIMA = ("max_penetration", "max_joint_speed", "max_torque_share", "max_object_force")


class EpisodeStatistics:
    """Sums over ended episodes, and over the reward terms of every step, since the last `pop`."""

    def __init__(
        self, object_names: tuple[str, ...], reward_names: Mapping[str, tuple[str, ...]], device: torch.device
    ) -> None:
        """Start empty, for objects by row of the object table and the reward terms of each agent."""
        self._object_names, self._reward_names = object_names, reward_names
        self._modes = torch.arange(len(FAILURES), device=device)
        num_columns = 1 + len(SHARES) + len(SUMS) + len(SUCCESS_SUMS) + len(FAILURES)
        self._by_object = torch.zeros(len(object_names), num_columns, device=device)
        self._maxima = torch.zeros(len(MAXIMA), device=device)
        self._rewards = torch.zeros(2 + sum(map(len, reward_names.values())), device=device)

    def add(self, ended: Flags, record: EpisodeRecord, reward_terms: ByAgent, is_diverged: Flags) -> None:
        """Add the reward terms of a control step, the records of episodes that it ended, and divergences."""
        columns = [getattr(record, name).float() for name in (*SHARES, *SUMS)]
        columns += [torch.where(record.is_success, getattr(record, name), 0.0) for name in SUCCESS_SUMS]
        modes = (failure(record)[:, None] == self._modes) & ~record.is_success[:, None]
        rows = torch.cat((torch.ones_like(columns[0])[:, None], torch.stack(columns, dim=-1), modes), dim=-1)
        rows = torch.where(ended[:, None], rows, 0.0)
        self._by_object.index_add_(0, record.object_id, rows)
        maxima = torch.stack([getattr(record, name) for name in MAXIMA], dim=-1)
        torch.maximum(self._maxima, torch.where(ended[:, None], maxima, 0.0).amax(dim=0), out=self._maxima)
        means = torch.cat([values.mean(dim=0) for values in reward_terms.values()])
        self._rewards += torch.cat((torch.ones_like(means[:1]), is_diverged.sum()[None], means))

    def pop(
        self,
        total: Callable[[Tensor], Tensor] = torch.clone,
        largest: Callable[[Tensor], Tensor] = torch.clone,
    ) -> dict[str, float]:
        """Return rates and means since the last call, NaN without episodes; wait for the device.

        `total` adds the sums of all processes, `largest` takes the largest of their maxima.
        """
        buffers = (self._by_object, self._rewards, self._maxima)
        *sums, maxima = (buffer.flatten() for buffer in buffers)
        packed = torch.cat((total(torch.cat(sums)), largest(maxima.clone())))
        objects, rewards, maxima = (
            part.view_as(buffer).tolist()
            for part, buffer in zip(packed.cpu().split([b.numel() for b in buffers]), buffers, strict=True)
        )
        for buffer in buffers:
            buffer.zero_()
        result = _means([sum(column) for column in zip(*objects, strict=True)])
        result |= dict(zip(MAXIMA, maxima, strict=True)) | {"diverged": rewards[1]}
        result |= {
            f"success_rate/{n}": _means(row)["success_rate"]
            for n, row in zip(self._object_names, objects, strict=True)
        }
        names = [f"reward_term/{name}" for names in self._reward_names.values() for name in names]
        return result | {
            name: value / max(rewards[0], 1.0) for name, value in zip(names, rewards[2:], strict=True)
        }


def _means(row: list[float]) -> dict[str, float]:
    episodes = row[0]
    values: dict[str, float] = dict(zip((*SHARES, *SUMS, *SUCCESS_SUMS), row[1:], strict=False))
    failures = dict(zip(FAILURES, row[-len(FAILURES) :], strict=True))
    return {
        "episodes": episodes,
        "tracking_rate": _ratio(values["is_tracked"], episodes),
        **{f"{name}_rate": _ratio(values[f"is_{name}"], episodes) for name in RATES},
        "mean_penetration": _ratio(values["penetration_sum"], values["contact_steps"]),
        **{name: _ratio(values[name], values["is_success"]) for name in SUCCESS_SUMS},
        "episode_steps": _ratio(values["steps"], episodes),
        **{f"failure/{name}": _ratio(count, episodes) for name, count in failures.items()},
    }


def _ratio(part: float, whole: float) -> float:
    return part / whole if whole else float("nan")
