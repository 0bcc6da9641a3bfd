"""The catching environment: act, simulate, reward, reset, observe."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from pixel2catch.agents import commands_of
from pixel2catch.batches import Boxes, ByAgent, Flags, Joints, Scalars, Vectors
from pixel2catch.camera.level import level_boxes
from pixel2catch.checks import Count, Device, Seed, typed
from pixel2catch.envs.cfg import CatchEnvCfg
from pixel2catch.envs.detector import Detector
from pixel2catch.envs.episode import Episode, EpisodeRecord, EpisodeStatistics, StepExtremes, draw_episode
from pixel2catch.envs.world import CatchWorld
from pixel2catch.errors import InvalidValueError
from pixel2catch.mdp.control_step import ActionMap, BoxHistory, History, Measurement, Privileged, Transition
from pixel2catch.mdp.observations import privileged_state
from pixel2catch.mdp.randomization import by_joint
from pixel2catch.mdp.sensing import Detection
from pixel2catch.mdp.tensors import DelayLine, assign, clone, require_shapes, select, write
from pixel2catch.mdp.terminations import is_ended
from pixel2catch.mdp.throws import sample_paths
from pixel2catch.methods import Method, require_terms
from pixel2catch.scene.objects import select_objects
from pixel2catch.sim.graphs import fused
from pixel2catch.workcells import find_workcell

NUM_SEEN = 64  #: Drawn throws of which a camera must see a point. Source: ours.
STAGGER_STEPS = 45
"""Largest additional hovering in a staggered episode [control steps], about a missed throw. Source: ours."""


@dataclass(frozen=True, kw_only=True)
class Observation:
    """Inputs of the networks."""

    policy: ByAgent  #: Observation of each agent, by name.
    #: Input of every value network: all observations, and values that only the simulator has.
    state: Float[Tensor, "num_envs _"]
    teacher: ByAgent  #: Observation of each agent of the imitated method; empty without one.


@dataclass(frozen=True, kw_only=True)
class Step:
    """Result of one control step; environments whose episode ended have begun a new one."""

    observation: Observation  #: Inputs of the networks for the next step.
    rewards: dict[str, Scalars]  #: Reward of each agent, by name.
    terminated: Flags  #: Whether the episode ended, time-outs included (paper).
    truncated: Flags  #: Never: a time-out is a termination.
    record: EpisodeRecord  #: The episodes up to this step, before any reset.
    log: StepExtremes  #: Contacts in this step, and the largest overlaps, speeds and torques.
    measurement: Measurement  #: Measurement that `observation` was computed from.
    joint_pos_target: Joints  #: Commanded joint targets [rad].
    torque_share: Joints  #: Torques of the joints at its end as shares of their limits, without signs.


LastAction = tuple[Joints, Joints]
"""The last action in joint order, in [-1, 1], and the joint targets that it led to [rad]."""


@dataclass(frozen=True, kw_only=True)
class SensorState:
    """Detections on their way, measurements, and true states of the last control steps."""

    image: Detection  #: What the newest image shows.
    detections: DelayLine[Detection]  #: Detections that were not yet delivered, and older ones.
    history: History  #: The last three measurements.
    before: Privileged  #: True state one control step earlier.
    now: Privileged  #: True state.


LiveState = tuple[tuple[Tensor, ...], Episode, DelayLine[Tensor], SensorState]
"""State of world, episodes, delayed targets and sensors."""


class CatchEnv:
    """`num_envs` robots that learn to catch; `step` does not wait for the device.

    `observation_sizes` and `action_sizes` have the lengths of each agent's observation and action, by name,
    `state_size` that of the value networks' input. The next step overwrites the tensors of `episode`.
    """

    @typed
    def __init__(
        self,
        cfg: CatchEnvCfg,
        method: Method,
        *,
        num_envs: Count,
        device: Device = "cpu",
        seed: Seed = 0,
        teacher: Method | None = None,
        is_fused: bool = False,
    ) -> None:
        """Build the environments; the first `reset` begins their episodes.

        Observations of a `teacher` are computed, too. With `is_fused`, the first step compiles the control
        step: see `sim.graphs.fused`.
        """
        method.require_same_view(teacher)
        self.workcell = find_workcell(cfg.scene.workcell)
        self.cfg = cfg = cfg.for_workcell(self.workcell)
        if cfg.scene.camera not in (CatchEnvCfg().scene.camera, cfg.sensing.camera.camera):
            raise InvalidValueError("scene.camera is not sensing.camera; give cameras by task.with_camera.")
        for each in cfg.all_variants:
            each.sensing.require_sight(sample_paths(each.throws, NUM_SEEN).flatten(0, 1)[None])
        self.method, self.teacher, self.num_envs = method, teacher, num_envs
        self.world = CatchWorld(cfg.scene, cfg.dynamics, num_envs=num_envs, device=device)
        self.device = self.world.device
        self._generator = torch.Generator(self.device).manual_seed(seed)
        names, objects = self.world.objects.names, select_objects(cfg.objects)
        self._object_ids = torch.tensor([names.index(name) for name in objects], device=self.device)
        self._action_map = ActionMap.of(commands_of(self.workcell), self.device)
        noise = by_joint(self.workcell, "action_noise", self.device)
        self._action_noise = cfg.randomization.action_noise * noise
        self._action_bias = by_joint(self.workcell, "action_bias", self.device)
        rewards = {each.name: each.reward_names for each in method.agents}
        self.statistics = EpisodeStatistics(names, rewards, self.device)
        self._detector = Detector(cfg.sensing, self.world, self._generator)
        self._is_nan = torch.zeros(len(method.agents), dtype=torch.bool, device=self.device)
        self._everywhere = torch.ones(num_envs, dtype=torch.bool, device=self.device)
        self.episode = clone(self._draw_episode())
        self._commands = clone(self._waiting_commands())
        self._sensors = self._first_sensor_state()
        self._widths: dict[str, int] = {}
        self._require_terms()
        observed = method.observe(self._sensors.history)
        self.observation_sizes = {name: value.shape[1] for name, value in observed.items()}
        step = fused(self._control_step, self.world.simulation) if is_fused else self._control_step
        self._advance = self.world.simulation.record(step, self._generator)
        self.action_sizes = {agent.name: agent.num_joints for agent in method.agents}
        self.state_size = self.reset().state.shape[1]

    @typed
    def seed(self, seed: Seed) -> None:
        """Seed all draws; the next `reset` begins the episodes of this seed."""
        self._generator.manual_seed(seed)

    def reset(self, *, is_staggered: bool = False) -> Observation:
        """Begin a new episode in every environment.

        With `is_staggered`, the objects of these episodes hover up to `STAGGER_STEPS` longer, so that short
        rollouts hold all parts of episodes. Source: Bharthulwar et al. 2025; by hovering (ours).
        """
        assign(self.episode, self._draw_episode(self.cfg.with_longer_hovering(is_staggered * STAGGER_STEPS)))
        self.world.reset(self._everywhere, self.episode.parameters, self.episode.throw)
        self.world.simulation.forward(self._everywhere)
        assign(self._commands, self._waiting_commands())
        assign(self._sensors, self._first_sensor_state())
        with self._naming_terms():
            return self._of_known_sizes(self._observe())

    def step(self, actions: ByAgent) -> Step:
        """Act for one control step; what lies outside [-1, 1] is clipped, NaN raises, on a device in `check`.

        The next step overwrites the returned tensors, except `observation` and `rewards`.
        """
        shapes = {name: (self.num_envs, n) for name, n in self.action_sizes.items()}
        require_shapes("action", actions, shapes, self.device.type)
        action = self.method.joint_actions(actions)
        self._is_nan |= torch.stack([actions[agent.name].isnan().any() for agent in self.method.agents])
        with self._naming_terms():
            if self.device.type == "cpu":
                self._require_numbers()
            step = self._advance(action.clamp(-1.0, 1.0))
            self._of_known_sizes(step.observation)
        return replace(step, observation=clone(step.observation), rewards=clone(step.rewards))

    @property
    def live(self) -> LiveState:
        """Return the tensors of all state, one row per environment; steps change them in place."""
        return self.world.live, self.episode, self._commands, self._sensors

    @contextmanager
    def branched(self, state: LiveState) -> Iterator[Observation]:
        """Go back to a copy of `live`; afterwards draws go on as if nothing had been drawn in between."""
        draws = self._generator.get_state()
        _, episode, _, _ = state
        self.world.reset(self._everywhere, episode.parameters, episode.throw)
        assign(self.live, state)
        self.world.simulation.forward()  # with a mask a GPU would find contacts one physics step later
        try:
            yield self._observe()
        finally:
            self._generator.set_state(draws)

    def check(self) -> None:
        """Check contacts and actions since the last call; wait for the device."""
        self.world.simulation.check()
        self._require_numbers()

    @property
    def measurement(self) -> Measurement:
        """Return the last measurement; the next step overwrites it."""
        return self._sensors.history.now

    def close(self) -> None:
        """Free the simulation."""
        self.world.simulation.close()

    @contextmanager
    def _naming_terms(self) -> Iterator[None]:
        """Raise the error of the term that is the cause of another error, if one is."""
        try:
            yield
        except Exception:
            self._require_terms()
            raise

    def _of_known_sizes(self, observation: Observation) -> Observation:
        sizes = {name: (self.num_envs, size) for name, size in self.observation_sizes.items()}
        require_shapes("observation", observation.policy, sizes)
        return observation

    def _require_terms(self) -> None:
        past = self._sensors.history
        command = past.now.action, past.now.joint_pos_target
        reached = self._transition(command, self.world.quiet_log(), ~self._everywhere)
        require_terms(self.method, reached, past.before, past.now, self._widths)

    def _require_numbers(self) -> None:
        found = zip(self.method.agents, self._is_nan.tolist(), strict=True)
        if names := [agent.name for agent, is_nan in found if is_nan]:
            self._is_nan.zero_()
            raise InvalidValueError(f"an action of agent '{names[0]}' is NaN; give numbers from -1 to 1.")

    def _control_step(self, action: Joints) -> Step:
        """Advance by a control step in memory that keeps its address: a device records and replays it."""
        noise = torch.randn(action.shape, generator=self._generator, device=self.device)
        disturbed = action + self.episode.parameters.action_bias + self._action_noise * noise
        target = self._action_map.joint_pos_target(disturbed, self._sensors.history.now.joint_pos)
        commands = self._commands.pushed(target)
        late = commands.interpolated(self.episode.command_delay)
        log = self.world.run(late, self.episode.drag, self.episode.side_force)
        is_diverged = self.world.is_diverged()
        log = log.cleared(is_diverged)
        command = (action, target)
        transition = self._transition(command, log, is_diverged)
        terms = {agent.name: agent.reward_terms(transition) for agent in self.method.agents}
        terminated = is_ended(transition, self.cfg.episode)
        record = self.episode.record.advanced(transition, log, self.world.arms, self.world.palms)
        self.statistics.add(terminated, record, terms, is_diverged)
        self._begin(terminated, record)
        assign(self._commands, select(terminated, self._waiting_commands(), commands))
        self._sense(terminated, command, log)
        return Step(
            observation=self._observe(),
            rewards={name: values.sum(dim=-1) for name, values in terms.items()},
            terminated=terminated,
            truncated=torch.zeros_like(terminated),
            record=record,
            log=log,
            measurement=self._sensors.history.now,
            joint_pos_target=target,
            torque_share=transition.now.torque_share,
        )

    def _first_sensor_state(self) -> SensorState:
        joint_pos, log = self.world.joint_pos, self.world.quiet_log()
        now = self.world.privileged(log)
        image = self._detector.look(now, self.episode)
        detection = self._detector.disturbed(image, self.episode)
        started = (torch.zeros_like(joint_pos), joint_pos)
        measurement = self._measure(started, detection, self._first_boxes(detection), detection.object_pos)
        sensors = SensorState(
            image=image,
            detections=DelayLine.filled(detection, self.cfg.longest_latency),
            history=History(measurement, measurement, measurement),
            before=now,
            now=now,
        )
        return clone(sensors)

    def _waiting_commands(self) -> DelayLine[Tensor]:
        """Return the delayed targets at the beginning of an episode: the joint positions."""
        return DelayLine.filled(self.world.joint_pos, self.cfg.longest_command_delay)

    def _transition(self, command: LastAction, log: StepExtremes, is_diverged: Flags) -> Transition:
        """Return the last control step; where the simulation diverged, the object counts as fallen."""
        before = self._sensors.now
        fallen = replace(before, object_pos=torch.zeros_like(before.object_pos))
        now = select(is_diverged, fallen, self.world.privileged(log))
        return self.episode.record.transition(before, now, *command, self.world.geometry)

    def _draw_episode(self, cfg: CatchEnvCfg | None = None) -> Episode:
        return draw_episode(
            cfg or self.cfg, self._action_bias, self._object_ids, self.num_envs, self._generator
        )

    def _begin(self, ended: Flags, record: EpisodeRecord) -> None:
        """Begin new episodes where one ended, and release objects whose hovering is over."""
        fresh = self._draw_episode()
        assign(self.episode.record, record)
        write(ended, fresh, self.episode)
        self.world.reset(ended, fresh.parameters, fresh.throw)
        is_released = self.episode.record.steps == self.episode.throw.hover_steps
        self.world.release(is_released, self.episode.throw)
        self.world.simulation.forward(ended | is_released)

    def _sense(self, begun: Flags, command: LastAction, log: StepExtremes) -> None:
        """Detect and measure after a control step; ended episodes leave nothing behind.

        Images are exposed a fraction of a control step earlier, and arrive after whole ones.
        """
        sensors, latency = self._sensors, self.episode.parameters.latency
        truth = self.world.privileged(log.cleared(begun))
        image = self._detector.look(truth, self.episode)
        exposed = image.exposed_before(select(begun, image, sensors.image), latency - latency.floor())
        detected = self._detector.disturbed(exposed, self.episode)
        detection = detected.held(begun | detected.is_seen, sensors.detections.ages[0])
        first = DelayLine.filled(detection, self.cfg.longest_latency)
        detections = select(begun, first, sensors.detections.pushed(detection))
        started = (torch.zeros_like(self.world.joint_pos), self.world.joint_pos)
        delivered = detections.delivered(latency)
        boxes = sensors.history.now.boxes.advanced(
            self._measured_box(delivered), self._age(delivered), delivered.stale == 0.0
        )
        now = self._measure(
            select(begun, started, command),
            delivered,
            select(begun, self._first_boxes(detection), boxes),
            select(begun, detection.object_pos, sensors.history.now.initial_object_pos),
        )
        history = History(sensors.history.before, sensors.history.now, now)
        updated = SensorState(
            image=image,
            detections=detections,
            history=select(begun, History(now, now, now), history),
            before=select(begun, truth, sensors.now),
            now=truth,
        )
        assign(sensors, updated)

    def _age(self, detection: Detection) -> Scalars:
        """Return the age of a delivered detection, by its stamp [control steps]."""
        return self.episode.parameters.latency + detection.stale + detection.age_error

    def _first_boxes(self, detection: Detection) -> BoxHistory:
        return BoxHistory.begun(self._measured_box(detection), self._age(detection), self.method.num_boxes)

    def _measured_box(self, detection: Detection) -> Boxes:
        """Return the box of a detection as the method observes it [px]."""
        if not self.method.is_levelled:
            return detection.box
        return level_boxes(detection.box, self._detector.assumed(self.episode))

    def _measure(
        self, command: LastAction, detection: Detection, boxes: BoxHistory, initial_object_pos: Vectors
    ) -> Measurement:
        joint_pos = self.world.joint_pos
        noise = torch.randn(joint_pos.shape, generator=self._generator, device=self.device)
        joint_pos = joint_pos + self.episode.parameters.joint_bias + self.cfg.sensing.joint_noise * noise
        palm_pos, palm_quat = self.world.geometry.palm_poses(joint_pos)
        return Measurement(
            boxes=boxes,
            camera_pos=self._detector.assumed(self.episode).center.expand(self.num_envs, 3),
            object_pos=detection.object_pos,
            initial_object_pos=initial_object_pos,
            joint_pos=joint_pos,
            joint_pos_target=command[1],
            palm_pos=palm_pos,
            palm_quat=palm_quat,
            action=command[0],
        )

    def _observe(self) -> Observation:
        sensors = self._sensors
        policy = self.method.observe(sensors.history)
        teacher = self.teacher.observe(sensors.history) if self.teacher else {}
        drawn = (self.episode.drawn_parameters(),) if self.cfg.value_sees_parameters else ()
        truth = privileged_state(sensors.before, sensors.now)
        state = torch.cat((*policy.values(), *drawn, truth), dim=-1)
        return Observation(policy=policy, state=state, teacher=teacher)
