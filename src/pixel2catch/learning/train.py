"""Train a method: act, step, record, update, until all transitions are done or the user stops it."""

import contextlib
import dataclasses
import io
import math
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Literal

import torch
from rich.console import Console
from torch import Tensor

from pixel2catch.devices import DeviceTime
from pixel2catch.envs.catch_env import CatchEnv, Observation
from pixel2catch.errors import CheckpointError, NonFiniteError
from pixel2catch.files import json_text, write_atomically
from pixel2catch.interruption import StopRequest
from pixel2catch.learning.checkpoint import Checkpoint, Progress, RunFolder, save_checkpoint
from pixel2catch.learning.config import TrainCfg
from pixel2catch.learning.distributed import Workers, start_workers
from pixel2catch.learning.log import Row, TrainingLog, start_wandb
from pixel2catch.learning.mappo import Mappo
from pixel2catch.policy import Policy, PolicyContract
from pixel2catch.progress import heartbeat
from pixel2catch.shipped import policy_folder

Status = Literal["failed", "interrupted", "finished"]
"""How a training ended: interrupted by Ctrl-C or a termination signal; failed only in the run folder."""

BeginStep = Callable[[str], None]  #: Names the step that goes on; an empty name ends it.
MakeEnv = Callable[..., CatchEnv]
"""Makes environments from a share of the `TrainCfg` and a physics rate [1/s], or None for their own rate."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class TrainResult:
    """How a training ended."""

    status: Status
    stopped_by: str  #: Signal that ended it early, such as SIGTERM; empty if none did.
    transitions: int  #: Transitions that were used.
    seconds: float  #: Wall-clock time over all sessions [s].
    policy: Path  #: Folder of the policy.
    metrics: Row  #: The last row of metrics.


def train(
    cfg: TrainCfg,
    make_env: MakeEnv,
    contract: PolicyContract,
    out_dir: Path,
    *,
    resume: bool = False,
    record: Mapping[str, Any] | None = None,
    remark: str = "",
) -> TrainResult:
    """Train a method and write its run folder; in a process that torchrun started, together with the others.

    Args:
        cfg: How the policy learns, for the whole training.
        make_env: Makes this process's environments, which are closed here.
        contract: What the policy will need to act elsewhere.
        out_dir: The run folder; see `RunFolder` for its files.
        resume: Go on from the checkpoint in `out_dir`.
        record: Other entries of `config.json`: the environments, the agents, the preset.
        remark: What is printed behind the first line.

    Raises:
        NonFiniteError: NaN or infinity appeared; the message names the quantity, the last checkpoint is good.
        CheckpointError: The folder cannot be used, or the last checkpoint could not be written.
        WorkerError: Another process failed; only in the first, which alone reports it.
    """
    folder, record = RunFolder(out_dir), record or {}
    with start_workers(cfg.device) as workers, contextlib.ExitStack() as stack:
        console = Console(highlight=False, quiet=not workers.is_first)
        begin_step = stack.enter_context(heartbeat(console))
        with workers.sync_errors():
            share = workers.share(cfg)
            if workers.is_first:
                stack.enter_context(folder.open(resume=resume))
        with workers.sync_errors():
            checkpoint = Checkpoint.load(folder.checkpoint, share.device) if resume else None
            progress = checkpoint.progress if checkpoint else Progress()
            start = Policy.load(policy_folder(cfg.start)) if cfg.start and not resume else None
            if start:
                start.contract.require(contract)
            name = "cpu" if workers.device == "cpu" else torch.cuda.get_device_name(workers.device)
            where = f"{workers.size} x {name}, {cfg.num_envs:,} environments"
            text = f"training {contract.method} on {where}, preset: {record.get('preset') or 'none'}{remark}"
            console.print(text, markup=False, soft_wrap=True)
            begin_step("making the environments")
            training = _Training(cfg, make_env, contract, folder, workers, record, progress)
            stack.enter_context(contextlib.closing(training))
            if checkpoint:
                checkpoint.restore(training.mappo)
            elif start:
                training.mappo.adopt(start)
            workers.diverge(cfg.seed, progress.transitions)
        return training.run(console, begin_step)


@dataclasses.dataclass
class _Training:
    cfg: TrainCfg
    make_env: MakeEnv
    contract: PolicyContract
    folder: RunFolder
    workers: Workers
    record: Mapping[str, Any]
    progress: Progress

    def __post_init__(self) -> None:
        self.share, self.rate = self.workers.share(self.cfg), self.cfg.rate_at(self.progress.transitions)
        self.env = self.make_env(self.share, self.rate)
        torch.manual_seed(self.cfg.seed)
        self.mappo = Mappo(self.share, self.env, self.contract, self.workers)
        self.row: Row = {}
        self._is_unlogged = False

    def close(self) -> None:
        """Close the environments, and release what would keep the process group from ending."""
        self.mappo.drop_recordings()
        self.env.close()

    def run(self, console: Console, begin_step: BeginStep) -> TrainResult:
        """Train to the end; in any case write how it ended."""
        status: Status = "failed"
        stop = StopRequest()
        with contextlib.ExitStack() as stack:
            with self.workers.sync_errors():
                log = stack.enter_context(self._open_log(console))
            try:
                status = self._loop(log, stack.enter_context(stop), begin_step)
                with self.workers.sync_errors():
                    self._save_last(log, status)
            finally:
                result: Any = {"status": status, **dataclasses.asdict(self.progress), "metrics": self.row}
                if self.workers.is_first:
                    with contextlib.suppress(OSError):
                        self.folder.write_json("summary.json", result)
        return TrainResult(policy=self.folder.policy, stopped_by=stop.by, **result)

    def _open_log(self, console: Console) -> TrainingLog:
        is_first, run = self.workers.is_first, None
        if is_first:
            config = {"train": dataclasses.asdict(self.cfg), "policy": self.contract.to_dict(), **self.record}
            if self.cfg.wandb:  # first, so that a run that cannot begin leaves nothing
                run = start_wandb(self.cfg.wandb, self.folder.path, config)
            self.folder.describe(config, self.workers.size)
        transitions = self.progress.transitions
        return TrainingLog(self.cfg, self.folder.path, transitions, console, run)

    def _loop(self, log: TrainingLog, stop: StopRequest, begin_step: BeginStep) -> Status:
        observation = None
        next_checkpoint = time.monotonic() + self.cfg.checkpoint_seconds
        try:
            while self.progress.transitions < self.cfg.transitions:
                started = time.monotonic()
                with self.workers.sync_errors():
                    if self._change_rate() or observation is None:
                        is_compiled = self.share.fuse or self.workers.device != "cpu"
                        begin_step(
                            f"first rollout{is_compiled * '; kernels that are not cached are compiled'}"
                        )
                        observation = self.env.reset(is_staggered=self.cfg.staggered)
                    begun = DeviceTime(self.workers.device)
                    observation = self._collect(observation, stop)
                self._log_row(log)  # of the previous update, while the device collects
                if self.workers.any(stop.is_set):
                    self.mappo.discard_rollout()
                    return "interrupted"
                self._update(started, begun)
                begin_step("")
                if time.monotonic() >= next_checkpoint:
                    self._log_row(log)
                    log.checkpoint(self._save)
                    next_checkpoint = time.monotonic() + self.cfg.checkpoint_seconds
        finally:
            self._log_row(log)
        return "finished"

    def _change_rate(self) -> bool:
        """Make the environments anew where the physics rate changes; return whether it does."""
        rate = self.cfg.rate_at(self.progress.transitions)
        if rate == self.rate:
            return False
        self.env.close()
        self.rate = rate
        self.env = self.make_env(self.share, rate)
        return True

    def _log_row(self, log: TrainingLog) -> None:
        if self._is_unlogged:
            self._is_unlogged = False
            log.write(self.row)

    def _collect(self, observation: Observation, stop: StopRequest) -> Observation:
        for _ in range(self.cfg.rollout_steps):
            if stop.is_set:
                break
            step = self.env.step(self.mappo.act(observation))
            self.mappo.record(step)
            observation = step.observation
        return observation

    def _update(self, started: float, begun: DeviceTime) -> None:
        """Learn, then wait for the device, check everything, and make a row of metrics."""
        collected = DeviceTime(self.workers.device)
        metrics = self.mappo.update(self.progress.transitions / self.cfg.transitions)
        updated = DeviceTime(self.workers.device)
        given = launch_sums(rollout_quantities(self.mappo, self.contract))
        found = launch_sums(update_quantities(self.mappo, metrics))
        rewards = torch.stack([self.mappo.rewards[agent].mean() for agent in self.mappo.agents])
        rewards = self.workers.sum(rewards) / self.workers.size
        with self.workers.sync_errors():  # first: NaN of one process reaches the networks of all
            self.env.check()
            self._require_finite(given())
        statistics = self.env.statistics.pop(self.workers.sum, self.workers.max)
        with self.workers.sync_errors():
            terms = {name: value for name, value in statistics.items() if name.startswith("reward_term/")}
            self._require_finite(terms | found())
        ended = time.monotonic()
        self.progress = Progress(
            transitions=self.progress.transitions + self.cfg.rollout_transitions,
            seconds=self.progress.seconds + ended - started,
        )
        named_rewards = zip(self.mappo.agents, rewards.tolist(), strict=True)
        self.row = {
            **dataclasses.asdict(self.progress),
            "transitions_per_second": self.cfg.rollout_transitions / (ended - started),
            "rollout_seconds": begun.until(collected),
            "update_seconds": collected.until(updated),
            **statistics,
            **{f"reward/{agent}": reward for agent, reward in named_rewards},
            **self.mappo.named(metrics.tolist()),
        }
        self._is_unlogged = True

    def _require_finite(self, named: Mapping[str, float]) -> None:
        """Write the state into the run folder and raise NonFiniteError if a quantity is not finite."""
        if all(map(math.isfinite, named.values())):
            return
        terms = {name: v for name, v in self.env.statistics.pop().items() if name.startswith("reward_term/")}
        bad = [name for name, value in {**terms, **named}.items() if not math.isfinite(value)]
        state = {
            "not_finite": bad,
            "config": json_text({"train": dataclasses.asdict(self.cfg), **self.record}),
            "transitions": self.progress.transitions,
            "rollout": {name: batch._asdict() for name, batch in self.mappo.rollout.items()},
            "rewards": self.mappo.rewards,
            "learner": self.mappo.state_dict(),
        }
        file, buffer = self.folder.path / f"failure{self.workers.rank or ''}.pt", io.BytesIO()
        torch.save(state, buffer)
        with contextlib.suppress(OSError):
            write_atomically({file: buffer.getvalue()})
        fix = "go on with --resume" if self.folder.checkpoint.exists() else "start again in another folder"
        raise NonFiniteError(
            f"NaN or infinity in {', '.join(bad)}; training stopped. '{file}' has the last rollout, the "
            f"networks and the configuration (torch.load): correct that quantity, then {fix}."
        )

    def _save(self) -> None:
        if self.workers.is_first:
            save_checkpoint(self.folder.checkpoint, self.mappo, self.contract, self.progress)
            self.mappo.export().save(self.folder.policy)

    def _save_last(self, log: TrainingLog, status: Status) -> None:
        try:
            self._save()
        except OSError as error:
            fix = "There is no earlier checkpoint: free some space and start again."
            if self.folder.checkpoint.exists():
                fix = "An earlier checkpoint there is still good: free some space, then add --resume."
            raise CheckpointError(
                f"the end of the training could not be written to '{self.folder.path}': {error}. {fix}"
            ) from error
        transitions, minutes = self.progress.transitions, self.progress.seconds / 60
        log.say(
            f"{status}: {transitions:,} transitions in {minutes:.1f} min; policy in '{self.folder.policy}'"
            + ("; go on with --resume" if status == "interrupted" else "")
        )


def launch_sums(tensors: Mapping[str, Tensor]) -> Callable[[], dict[str, float]]:
    """Launch sums of named tensors, finite only if all terms are; return a function that waits for them."""
    sums = torch.stack([tensor.sum() for tensor in tensors.values()])
    return lambda: dict(zip(tensors, sums.tolist(), strict=True))


def rollout_quantities(mappo: Mappo, contract: PolicyContract) -> dict[str, Tensor]:
    """Return what the environments returned since the last update, by name."""
    found: dict[str, Tensor] = {}
    for agent, rollout in mappo.rollout.items():
        found[f"reward of agent '{agent}'"] = mappo.rewards[agent]
        layout = contract.agents[agent].observation
        columns = rollout.observations.sum((0, 1)).split([size for _, size in layout])
        for (name, _), term in zip(layout, columns, strict=True):
            found[f"observation term '{name}' of agent '{agent}'"] = term
        found["value input (state)"] = rollout.states.sum((0, 1)) + mappo.next_states[agent].sum(0)
        found[f"sampled action of agent '{agent}'"] = rollout.actions
    return found


def update_quantities(mappo: Mappo, metrics: Tensor) -> dict[str, Tensor]:
    """Return parameters and `METRICS` of every agent after an update, by name."""
    found = {f"loss or metric '{name}'": value for name, value in mappo.named(metrics).items()}
    for agent, networks in mappo.networks.items():
        for role, parameters in networks.parts.items():
            norm = torch.nn.utils.get_total_norm([parameter.detach() for parameter in parameters])
            found[f"parameters of the {role} network of agent '{agent}'"] = norm
    return found
