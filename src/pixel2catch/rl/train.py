"""Train a method: act, step, record, update, until the transitions are used up or somebody stops it."""

import contextlib
import dataclasses
import time
from collections.abc import Callable
from pathlib import Path
from typing import Literal

import torch

from pixel2catch.errors import CheckpointError
from pixel2catch.interruption import StopRequest
from pixel2catch.policy import Policy, PolicyContract
from pixel2catch.rl.checkpoint import Progress, load_checkpoint, save_checkpoint
from pixel2catch.rl.config import TrainCfg
from pixel2catch.rl.environment import Environment, Observation
from pixel2catch.rl.finite import check_rollout, check_update
from pixel2catch.rl.learner import Learner
from pixel2catch.rl.log import TrainingLog
from pixel2catch.rl.metrics import Row
from pixel2catch.rl.run_folder import RunFolder
from pixel2catch.rl.stages import Stages
from pixel2catch.rl.workers import start_workers


@dataclasses.dataclass(frozen=True, kw_only=True)
class TrainResult:
    """How a training ended.

    Attributes:
        status: "finished", or "interrupted" by Ctrl-C or a termination signal; "failed" is only in the file.
        transitions: Transitions learnt from.
        seconds: Wall-clock time over all sessions [s].
        policy: Folder of the policy.
        metrics: The last row of metrics.
    """

    status: Literal["failed", "interrupted", "finished"]
    transitions: int
    seconds: float
    policy: Path
    metrics: Row


def train(
    cfg: TrainCfg,
    make_env: Callable[[TrainCfg], Environment],
    contract: PolicyContract,
    out_dir: Path,
    *,
    resume: bool = False,
) -> TrainResult:
    """Train a method and write its run folder; in a process that torchrun started, together with the others.

    Args:
        cfg: The configuration of the whole training.
        make_env: Makes this process's environments, from num_envs, device, seed and the one physics rate of
            its share of the configuration; called again where the rate changes; closed here.
        contract: What the policy will need to act elsewhere.
        out_dir: The run folder; see `RunFolder` for its files.
        resume: Go on from the checkpoint in `out_dir`.

    Raises:
        NonFiniteError: NaN or infinity appeared; the message names the quantity, the last checkpoint is good.
        CheckpointError: The folder cannot be used, or the last checkpoint could not be written.
        DeviceUnavailableError: The machine does not have `cfg.device`.
        WorkerError: Another process failed; only in the first, which alone reports it.
        InvalidValueError: The environments cannot be split over the processes.
    """
    folder = RunFolder(out_dir, cfg.inputs)
    with start_workers(cfg.device) as workers, contextlib.ExitStack() as stack:
        with workers.together():
            share = workers.share(cfg)
            if workers.is_first:
                stack.enter_context(folder.open(resume=resume))
        with workers.together():
            stages = stack.enter_context(contextlib.closing(Stages(share, make_env, contract)))
            torch.manual_seed(cfg.seed)
            learner = stack.enter_context(contextlib.closing(Learner(share, stages.env, workers)))
            training = _Training(cfg, stages, contract, folder, learner)
            if cfg.start and not resume:
                with workers.together():
                    learner.adopt(_policy_to_start_from(cfg.start, contract))
            if resume:
                training.progress = load_checkpoint(folder.checkpoint, learner, contract)
            workers.diverge(cfg.seed, training.progress.transitions)
        return training.run()


def _policy_to_start_from(folder: Path, contract: PolicyContract) -> Policy:
    """Read a policy that a training goes on from.

    Raises:
        PolicyMismatchError: There is none, or it does not fit; the message names the field.
    """
    policy = Policy.load(folder / "policy" if (folder / "policy").is_dir() else folder)
    policy.contract.require(contract)
    return policy


class _Training:
    """The loop and what it holds."""

    def __init__(
        self, cfg: TrainCfg, stages: Stages, contract: PolicyContract, folder: RunFolder, learner: Learner
    ) -> None:
        self.cfg, self.stages, self.contract, self.folder = cfg, stages, contract, folder
        self.learner, self.workers = learner, learner.workers
        self.progress = Progress()
        self.row: Row = {}

    def run(self) -> TrainResult:
        """Train to the end, and write down how it ended whatever happens."""
        status: Literal["failed", "interrupted", "finished"] = "failed"
        try:
            with contextlib.ExitStack() as stack:
                with self.workers.together():
                    log = stack.enter_context(self._open_log())
                stop = stack.enter_context(StopRequest())
                status = self._loop(log, stop)
                with self.workers.together():
                    self._save_last(log, status)
        finally:
            result = {"status": status, **dataclasses.asdict(self.progress), "metrics": self.row}
            if self.workers.is_first:
                with contextlib.suppress(OSError):
                    self.folder.write_json("summary.json", result)
        return TrainResult(
            status=status, **dataclasses.asdict(self.progress), policy=self.folder.policy, metrics=self.row
        )

    def _open_log(self) -> TrainingLog:
        """Write down under which circumstances this session begins, and open its log."""
        is_first = self.workers.is_first
        if is_first:
            train, env = dataclasses.asdict(self.cfg), dataclasses.asdict(self.stages.env.cfg)
            config = {"train": train, "env": env, "policy": self.contract.to_dict()}
            self.folder.describe(config, self.workers.size)
        return TrainingLog(self.cfg, self.folder, self.progress.transitions, is_silent=not is_first)

    def _loop(self, log: TrainingLog, stop: StopRequest) -> Literal["interrupted", "finished"]:
        observation = None
        next_checkpoint = time.monotonic() + self.cfg.checkpoint_seconds
        while self.progress.transitions < self.cfg.transitions:
            started = time.monotonic()
            with self.workers.together():
                if self.stages.enter(self.progress.transitions) or observation is None:
                    observation = self.stages.env.reset()
                observation = self._collect(observation, stop)
            if self.workers.any(stop.is_set):
                self.learner.discard_rollout()
                return "interrupted"
            self._update(started)
            log.write(self.row)
            if time.monotonic() >= next_checkpoint:
                log.attempt("checkpoint", self._save)
                next_checkpoint = time.monotonic() + self.cfg.checkpoint_seconds
        return "finished"

    def _collect(self, observation: Observation, stop: StopRequest) -> Observation:
        """Fill the learner's memory, and wait for the device to see that the simulation is well.

        Inputs are copied: an environment may reuse its buffers in `step`.
        """
        for _ in range(self.cfg.rollout_steps):
            if stop.is_set:
                break
            policy = {agent: inputs.clone() for agent, inputs in observation.policy.items()}
            state = observation.state.clone()
            actions = self.learner.act(observation)
            step = self.stages.env.step(actions)
            self.learner.record(policy, state, actions, step)
            observation = step.observation
        self.stages.env.check()
        return observation

    def _update(self, started: float) -> None:
        """Check, learn, check, and make a row of metrics."""
        statistics = self.stages.env.statistics.pop(self.workers.sum, self.workers.max)
        with self.workers.together():
            rewards = check_rollout(self.learner, self.contract, statistics)
        rolled_out = time.monotonic()
        losses = self.learner.update(self.progress.transitions / self.cfg.transitions)
        with self.workers.together():
            check_update(self.learner, losses)
        ended = time.monotonic()
        self.progress = Progress(
            transitions=self.progress.transitions + self.cfg.rollout_transitions,
            seconds=self.progress.seconds + ended - started,
        )
        self.row = {
            **dataclasses.asdict(self.progress),
            "transitions_per_second": self.cfg.rollout_transitions / (ended - started),
            "rollout_seconds": rolled_out - started,
            "update_seconds": ended - rolled_out,
            **statistics,
            **self.workers.means(rewards),
            **losses,
        }

    def _save(self) -> None:
        if self.workers.is_first:
            save_checkpoint(self.folder.checkpoint, self.learner, self.contract, self.progress)
            self.learner.export(self.contract).save(self.folder.policy)

    def _save_last(self, log: TrainingLog, status: str) -> None:
        try:
            self._save()
        except OSError as error:
            raise CheckpointError(
                f"the end of the training could not be written to '{self.folder.path}': {error}. "
                "An earlier checkpoint there is still good: free some space and go on with --resume."
            ) from error
        transitions, minutes = self.progress.transitions, self.progress.seconds / 60
        log.console.say(
            f"{status}: {transitions:,} transitions in {minutes:.1f} min; policy in '{self.folder.policy}'"
            + ("; go on with --resume" if status == "interrupted" else "")
        )
