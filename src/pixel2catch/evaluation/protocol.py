"""The protocol of an evaluation: rounds of throws with all noise and randomisation, and a test of every hold.

A round has one throw in every environment. Reaching and success count within the first 3.0 s, as in training,
or as much longer as the task's objects hover longer.
After a success the policy stops: the arm holds its measured position, the hand repeats its last action. For
one second at least two parts of the hand must touch the object at every control step. Then the arm shakes for
half a second. If the object is still at the palm, the hold is verified.

The closed-loop hold of every third throw goes on from the state at its success in the other way: the policy
acts for two seconds, in which the arm shakes likewise. The object must stay at the palm and in front of the
robot's base, and at least two parts of the hand must touch it at the end.

Source: paper, Sec. V: 100 environments and 10 trials in each, deterministic policy; ours: the tests.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, fields, replace
from math import pi
from typing import Annotated, Protocol, final, runtime_checkable

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from torch import Tensor

from pixel2catch.agents import commands_of
from pixel2catch.batches import Counts, Flags, Joints
from pixel2catch.checks import NOT_EMPTY, Count, Device, Seed, require_valid
from pixel2catch.envs.catch_env import CatchEnv, CatchEnvCfg, LiveState, Observation, Step
from pixel2catch.envs.episode import FAILURES, EpisodeRecord, failure
from pixel2catch.evaluation.reach import is_reachable
from pixel2catch.mdp.control_step import JointCommand, put, take
from pixel2catch.mdp.tensors import clone, mapped, select, write
from pixel2catch.mdp.terminations import EpisodeCfg
from pixel2catch.methods import Method
from pixel2catch.robots.workcell import WorkcellSpec
from pixel2catch.scene.constants import CONTROL_DT, OBJECT_VEL

TRIAL_STEPS = CatchEnvCfg().trial_steps  #: Control steps in which reaching and success count, nominal task.
HOLD_TEST_STEPS = 30  #: Control steps of the hold test: 1.0 s. Source: ours.
SHAKE_STEPS = 15  #: Control steps of the shake: 0.5 s. Source: ours.

CLOSED_LOOP_STEPS = 60  #: Control steps of the closed-loop hold: 2.0 s. Source: ours.
CLOSED_LOOP_EVERY = 3  #: One in every third environment takes a fifth more time. Source: ours.

TEST_STEPS = HOLD_TEST_STEPS + SHAKE_STEPS

LIMIT_SHARE = 0.99  #: Share of its limit from which a torque counts as at it. Source: ours.

LEAST_PARTS = 2  #: Parts of the hand (palm, fingers) that must touch a held object. Source: ours.
SHAKE_FREQUENCY = 3.0  #: Frequency of the shake [Hz]: one and a half periods. Source: ours.

SHAKE_LEAD = (0.058, 0.058)
"""Largest distance of the arm joints' targets from their positions in the shake [rad]: pan moves the palm
sideways, lift up and down. Source: ours, a peak acceleration of the palm of about 5 m/s² without action
noise."""

FLIGHT_SPEED = 1.0  #: The object flies from this speed on [m/s]. Source: ours.
CAUGHT, LOST = "caught", "lost"
OUTCOMES = {
    CAUGHT: "caught, and held when shaken",
    LOST: "caught, but lost in the test of the hold",
    "never_reached": "missed: the hand never came near",
    "bounced_off": "missed: bounced off the hand",
    "dropped": "missed: touched, then dropped",
    "not_held": "missed: not held near the palm in time",
}
"""Outcomes of a throw with a description; all but the first two are the failure modes."""


@dataclass(frozen=True, kw_only=True)
class EvaluationCfg:
    """The throws of an evaluation."""

    objects: Annotated[tuple[str, ...], NOT_EMPTY]  #: Names of the objects; each throw draws one.
    num_envs: Count = 100  #: Throws in a round. Source: paper.
    trials: Count = 10  #: Rounds. Source: paper.
    seed: Seed = 0  #: Seed of everything that is drawn.
    device: Device = "cpu"  #: "cpu" or a CUDA device.
    #: The task, with all its noise; objects and endings are set here.
    task: CatchEnvCfg = field(default_factory=CatchEnvCfg)
    __post_init__ = require_valid

    def make_env(self, method: Method) -> CatchEnv:
        """Return environments whose episodes end only when the object is lost or robots hit each other."""
        steps = self.task.trial_steps + TEST_STEPS + CLOSED_LOOP_STEPS
        endings = EpisodeCfg(max_steps=steps, rest_steps=steps, ends_on_robot_contact=True)
        task = replace(self.task, objects=self.objects, episode=endings)
        return CatchEnv(task, method, num_envs=self.num_envs, device=self.device, seed=self.seed)


@runtime_checkable
class Actor(Protocol):
    """A `Policy`, or anything else with its `act`."""

    def act(self, observations: dict[str, Tensor]) -> dict[str, Tensor]:
        """Return the action of every agent in [-1, 1]."""
        ...


@dataclass(frozen=True, kw_only=True)
class Trials:
    """What happened in trials, tests of the hold included; torques are those at the ends of control steps."""

    record: EpisodeRecord  #: Events of each trial.
    is_verified: Bool[Tensor, " num_trials"]  #: Whether the hold passed both tests.
    hold_steps: Int[Tensor, " num_trials"]  #: Control steps of these tests with the object in reach.
    #: Squares of the finger joints' shares of their torque limits, summed over `hold_steps`.
    torque_squares: Float[Tensor, "num_trials num_fingers"]
    limit_steps: Int[Tensor, " num_trials"]  #: Control steps with an arm joint at its torque limit.
    #: Whether the closed-loop hold passed; -1 where it was not tested.
    closed_loop: Int[Tensor, " num_trials"]
    is_reachable: Bool[Tensor, " num_trials"]  #: Whether an arm can reach the throw in time.

    @classmethod
    def concatenate(cls, several: "list[Trials]") -> "Trials":
        """Return the trials of several rounds, on the host."""
        return mapped(lambda *rounds: torch.cat(rounds).cpu(), *several)


@dataclass(frozen=True, kw_only=True)
class RoundState(Trials):
    """The state of each trial of a round."""

    is_running: Flags  #: Whether the trial is undecided.
    is_testing: Flags  #: Whether the hold is being tested.
    test_steps: Counts  #: Control steps of the test so far.
    is_firm: Flags  #: Whether enough parts touched the object at every step of the hold test so far.
    action: Joints  #: Last actions in joint order.

    def chosen(self, action: Joints, workcell: WorkcellSpec) -> Joints:
        """Return the policy's action; in a test, the arms' hold or shake and the hands' last action."""
        arms, hands = workcell.of_role("arm"), workcell.of_role("hand")
        shake = _shake(self.test_steps, workcell)
        held = put([(arms, take(shake, arms)), (hands, take(self.action, hands))])
        return select(self.is_testing, held, action)

    def advanced(self, step: Step, action: Joints, workcell: WorkcellSpec, *, is_late: bool) -> "RoundState":
        """Return the state after a control step with these actions; after the trial it is late."""
        is_counted = self.is_testing if is_late else self.is_running
        record = select(is_counted, step.record, self.record)
        test_steps = self.test_steps + self.is_testing.long()
        is_firm = step.log.is_touching.sum(dim=-1) >= LEAST_PARTS
        is_exempt = ~self.is_testing | (test_steps > HOLD_TEST_STEPS)
        is_firm = self.is_firm & (is_firm | is_exempt)
        is_tested = self.is_testing & (test_steps == TEST_STEPS)
        is_running = is_counted & ~step.terminated & ~is_tested
        is_held = self.is_testing & (step.record.held_steps > 0)
        arms, hands = (take(step.torque_share, workcell.of_role(role)) for role in ("arm", "hand"))
        is_limited = is_counted & (arms >= LIMIT_SHARE).any(dim=-1)
        return replace(
            self,
            record=record,
            is_running=is_running,
            is_testing=is_running & record.is_success,
            test_steps=test_steps,
            is_firm=is_firm,
            is_verified=self.is_verified | (is_tested & is_firm & is_held),
            hold_steps=self.hold_steps + is_held.long(),
            torque_squares=self.torque_squares + is_held[:, None] * hands.square(),
            limit_steps=self.limit_steps + is_limited.long(),
            action=action,
        )


def evaluate(
    actor: Actor,
    method: Method,
    cfg: EvaluationCfg,
    on_round: Callable[[Trials], None] = lambda _: None,
    on_share: Callable[[float], None] = lambda _: None,
    *,
    env: CatchEnv | None = None,
    is_seeded: bool = False,
) -> Trials:
    """Evaluate a policy in environments, by default those of `cfg.make_env`; close them at the end.

    `on_round` gets the trials of every round, `on_share` after every control step the share of all rounds
    that is done. Seeded rounds have seeds of their own, one after the other, so that all policies get the
    same throws. Otherwise the throws of later rounds depend on when the holds of earlier ones are decided.
    """
    env, rounds = env or cfg.make_env(method), []
    length = env.cfg.trial_steps + TEST_STEPS
    num_steps = cfg.trials * length
    try:
        for number in range(cfg.trials):
            if is_seeded:
                env.seed(cfg.seed + number)
            hold, observation, state = ClosedLoopHold(env, actor), env.reset(), _round_start(env)
            reachable = is_reachable(env.episode, env.workcell)
            for step, (_, state) in enumerate(round_steps(env, actor, observation), start=1):
                hold.watch(state)
                on_share((number * length + step) / num_steps)
            trials = _end_of_round(env, state)
            rounds.append(replace(trials, closed_loop=hold.result(), is_reachable=reachable))
            on_round(rounds[-1])
            on_share((number + 1) / cfg.trials)
    finally:
        env.close()
    return Trials.concatenate(rounds)


@dataclass(frozen=True, kw_only=True)
class RecordedThrow:
    """One throw, from its start to the decision of the trial."""

    object_name: str  #: Name of the object.
    outcome: str  #: Outcome, a key of `OUTCOMES`.
    qpos: Float[ndarray, "num_steps nq"]  #: Positions of the simulation at every control step.
    qvel: Float[ndarray, "num_steps nv"]  #: Velocities of the simulation at every control step.
    box: Float[ndarray, "num_steps 4"]  #: Box that the policy received [px].
    num_untested: int  #: Control steps before the test of the hold; all steps if there was no success.

    @property
    def release(self) -> int:
        """The first control step in which the object flies."""
        flying = np.linalg.norm(self.qvel[:, OBJECT_VEL], axis=-1) > FLIGHT_SPEED
        return int(np.flatnonzero(flying)[0]) if flying.any() else len(flying) - 1


def recorded_throws(cfg: EvaluationCfg, actor: Actor, method: Method) -> list[RecordedThrow]:
    """Return the throws of one round, each until its decision; arguments as of `evaluate`."""
    env, rows = cfg.make_env(method), list[tuple[Tensor, ...]]()
    names, states = env.world.objects.names, [env.world.simulation.bind(name) for name in ("qpos", "qvel")]

    def watch(step: Step, state: RoundState) -> None:
        seen = (*states, step.measurement.box, state.is_running, state.is_testing)
        rows.append(tuple(values.cpu().clone() for values in seen))

    try:
        trials = run_round(env, actor, watch)
    finally:
        env.close()
    record, modes, throws = trials.record, failure(trials.record).tolist(), []
    columns = (torch.stack(column, dim=1).numpy() for column in zip(*rows, strict=True))
    for i, (qpos, qvel, box, running, testing) in enumerate(zip(*columns, strict=True)):
        held = CAUGHT if trials.is_verified[i] else LOST
        throw = RecordedThrow(
            object_name=names[int(record.object_id[i])],
            outcome=held if record.is_success[i] else FAILURES[modes[i]],
            qpos=qpos[running],
            qvel=qvel[running],
            box=box[running],
            num_untested=int((running & ~testing).sum()),
        )
        throws.append(throw)
    return throws


def run_round(
    env: CatchEnv, actor: Actor, watch: Callable[[Step, RoundState], None] = lambda *_: None
) -> Trials:
    """Throw once in every environment, and return the trials.

    After every control step `watch` is called; it must copy what it keeps, because the next step overwrites
    it. Environments whose trial is decided are stepped and ignored.
    """
    observation, state = env.reset(), _round_start(env)
    for step, state in round_steps(env, actor, observation):
        watch(step, state)
    return _end_of_round(env, state)


def _end_of_round(env: CatchEnv, state: RoundState) -> Trials:
    env.check()
    return Trials(**{field.name: getattr(state, field.name) for field in fields(Trials)})


def round_steps(env: CatchEnv, actor: Actor, observation: Observation) -> Iterator[tuple[Step, RoundState]]:
    """Yield the control steps of a round that has begun; each overwrites what the one before yielded."""
    state, trial_steps = _round_start(env), env.cfg.trial_steps
    for number in range(1, trial_steps + TEST_STEPS + 1):
        action = state.chosen(env.method.joint_actions(actor.act(observation.policy)), env.workcell)
        step = _step(env, action, state.is_running)
        state = state.advanced(step, action, env.workcell, is_late=number > trial_steps)
        observation = step.observation
        yield step, state
        if number >= trial_steps and not state.is_testing.any():
            break


@final
class ClosedLoopHold:
    """The closed-loop hold of every third throw of a round."""

    def __init__(self, env: CatchEnv, actor: Actor) -> None:
        self._env, self._actor = env, actor
        self._kept: LiveState | None = None
        self._is_tested = torch.arange(env.num_envs, device=env.device) % CLOSED_LOOP_EVERY == 0
        self._is_held = torch.zeros_like(self._is_tested)

    def watch(self, state: RoundState) -> None:
        """Copy the state of tested throws that have just become a success; call it after every step."""
        begun = self._is_tested & state.is_testing & (state.test_steps == 0)
        if begun.any():
            self._kept = self._kept or clone(self._env.live)
            write(begun, self._env.live, self._kept)
            self._is_held |= begun

    def result(self) -> Counts:
        """Return whether each throw passes, -1 where it is not tested; call it after the round."""
        if self._kept is not None:
            with self._env.branched(self._kept) as observation:
                self._go_on(observation)
        return torch.where(self._is_tested, self._is_held.long(), -1)

    def _go_on(self, observation: Observation) -> None:
        env = self._env
        for number in range(HOLD_TEST_STEPS, HOLD_TEST_STEPS + CLOSED_LOOP_STEPS):
            steps = torch.full_like(self._is_held, number, dtype=torch.long)
            chosen = env.method.joint_actions(self._actor.act(observation.policy))
            action = chosen + _shake(steps, env.workcell)
            step = _step(env, action, self._is_held)
            observation = step.observation
            self._is_held &= ~step.terminated & (step.record.held_steps > 0)
            if number == HOLD_TEST_STEPS + CLOSED_LOOP_STEPS - 1:
                self._is_held &= step.log.is_touching.sum(dim=-1) >= LEAST_PARTS


def shake_action(test_steps: Counts, commands: Sequence[JointCommand]) -> Joints:
    """Return an arm's action by the number of steps since the test began: 0 in the hold test, then a sine."""
    time = (test_steps - HOLD_TEST_STEPS + 0.5) * CONTROL_DT
    wave = torch.where(time > 0.0, torch.sin(2.0 * pi * SHAKE_FREQUENCY * time), 0.0)
    amplitude = [lead / command.scale for lead, command in zip(SHAKE_LEAD, commands, strict=False)]
    amplitude += [0.0] * (len(commands) - len(amplitude))
    return wave[:, None] * torch.tensor(amplitude, device=test_steps.device)


def _shake(test_steps: Counts, workcell: WorkcellSpec) -> Joints:
    commands, waves = commands_of(workcell), list[Tensor]()
    for group in workcell.groups:
        wave = shake_action(test_steps, commands[workcell.columns(group.name)])
        waves.append(wave if group.role == "arm" else 0.0 * wave)
    return torch.cat(waves, dim=-1)


def _step(env: CatchEnv, action: Tensor, is_running: Flags) -> Step:
    """Make a control step; on the CPU the physics of other environments stands still."""
    env.world.is_active = is_running if env.device.type == "cpu" else None
    step = env.step({agent.name: take(action, agent.joints) for agent in env.method.agents})
    env.world.is_active = None
    return step


def _round_start(env: CatchEnv) -> RoundState:
    yes = torch.ones(env.num_envs, dtype=torch.bool, device=env.device)
    none, action = yes.long() * 0, env.world.joint_pos * 0.0
    return RoundState(
        record=EpisodeRecord.start(none),
        is_running=yes,
        is_testing=~yes,
        test_steps=none,
        is_firm=yes,
        is_verified=~yes,
        hold_steps=none,
        torque_squares=take(action, env.workcell.of_role("hand")),
        limit_steps=none,
        closed_loop=none - 1,
        is_reachable=yes,
        action=action,
    )
