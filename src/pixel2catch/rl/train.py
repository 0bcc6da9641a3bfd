"""Train a method: act, step, record, update, until the transitions are used up or somebody stops it."""

import contextlib
import dataclasses
import time
from collections.abc import Callable
from pathlib import Path
from typing import Literal

import torch

from pixel2catch.errors import CheckpointError, DeviceUnavailableError, PolicyMismatchError
from pixel2catch.policy import PolicyContract
from pixel2catch.rl.checkpoint import Progress, load_checkpoint, save_checkpoint
from pixel2catch.rl.config import TrainCfg
from pixel2catch.rl.console import TrainingConsole
from pixel2catch.rl.environment import Environment, Observation
from pixel2catch.rl.finite import check_rollout, check_update
from pixel2catch.rl.interruption import StopRequest
from pixel2catch.rl.learner import Learner
from pixel2catch.rl.metrics import METRICS_FILE, CsvLog, Row, TensorBoardLog
from pixel2catch.rl.run_folder import RunFolder


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
    """Train a method and write its run folder.

    Args:
        cfg: The configuration.
        make_env: Makes the environment from num_envs, device and seed of the configuration; closed here.
        contract: What the policy will need to act elsewhere.
        out_dir: The run folder; see `RunFolder` for its files.
        resume: Go on from the checkpoint in `out_dir`.

    Raises:
        NonFiniteError: NaN or infinity appeared; the message names the quantity, the last checkpoint is good.
        CheckpointError: The folder cannot be used, or the last checkpoint could not be written.
        DeviceUnavailableError: The machine does not have `cfg.device`.
    """
    _require_device(cfg.device)
    folder = RunFolder(out_dir)
    folder.open(resume=resume)
    torch.manual_seed(cfg.seed)
    with contextlib.closing(make_env(cfg)) as env:
        _require_fit(cfg, env, contract)
        training = _Training(cfg, env, contract, folder)
        if resume:
            training.progress = load_checkpoint(folder.checkpoint, training.learner, contract)
        folder.describe(
            {
                "train": dataclasses.asdict(cfg),
                "env": dataclasses.asdict(env.cfg),
                "policy": contract.to_dict(),
            }
        )
        return training.run()


class _Training:
    """The loop and what it holds."""

    def __init__(self, cfg: TrainCfg, env: Environment, contract: PolicyContract, folder: RunFolder) -> None:
        self.cfg, self.env, self.contract, self.folder = cfg, env, contract, folder
        self.learner = Learner(cfg, env)
        self.progress = Progress()
        self.row: Row = {}

    def run(self) -> TrainResult:
        """Train to the end, and write down how it ended whatever happens."""
        status: Literal["failed", "interrupted", "finished"] = "failed"
        try:
            with contextlib.ExitStack() as stack:
                log = stack.enter_context(_Log(self.cfg, self.folder, self.progress.transitions))
                stop = stack.enter_context(StopRequest())
                self._loop(log, stop)
                status = "interrupted" if stop.is_set else "finished"
                self._save_last(log, status)
        finally:
            result = {"status": status, **dataclasses.asdict(self.progress), "metrics": self.row}
            with contextlib.suppress(OSError):
                self.folder.write_json("summary.json", result)
        return TrainResult(
            status=status, **dataclasses.asdict(self.progress), policy=self.folder.policy, metrics=self.row
        )

    def _loop(self, log: "_Log", stop: StopRequest) -> None:
        observation = self.env.reset()
        next_checkpoint = time.monotonic() + self.cfg.checkpoint_seconds
        while self.progress.transitions < self.cfg.transitions:
            started = time.monotonic()
            observation = self._collect(observation, stop)
            if stop.is_set:
                self.learner.discard_rollout()
                return
            self._update(started)
            log.write(self.row)
            if time.monotonic() >= next_checkpoint:
                log.attempt("checkpoint", self._save)
                next_checkpoint = time.monotonic() + self.cfg.checkpoint_seconds

    def _collect(self, observation: Observation, stop: StopRequest) -> Observation:
        """Fill the learner's memory. Inputs are copied: an environment may reuse its buffers in `step`."""
        for _ in range(self.cfg.rollout_steps):
            if stop.is_set:
                break
            policy = {agent: inputs.clone() for agent, inputs in observation.policy.items()}
            state = observation.state.clone()
            actions = self.learner.act(observation)
            step = self.env.step(actions)
            self.learner.record(policy, state, actions, step)
            observation = step.observation
        return observation

    def _update(self, started: float) -> None:
        """Check, learn, check, and make a row of metrics; the only place that waits for the device."""
        self.env.check()
        statistics = self.env.statistics.pop()
        rewards = check_rollout(self.learner, self.contract, statistics)
        rolled_out = time.monotonic()
        losses = self.learner.update(self.progress.transitions / self.cfg.transitions)
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
            **rewards,
            **losses,
        }

    def _save(self) -> None:
        save_checkpoint(self.folder.checkpoint, self.learner, self.contract, self.progress)
        self.learner.export(self.contract).save(self.folder.policy)

    def _save_last(self, log: "_Log", status: str) -> None:
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


class _Log:
    """Console, CSV and TensorBoard; a full disk is reported and does not end the training."""

    def __init__(self, cfg: TrainCfg, folder: RunFolder, transitions: int) -> None:
        self.console = TrainingConsole(cfg.transitions, cfg.report_seconds, transitions)
        self._csv = CsvLog(folder.path / METRICS_FILE, transitions)
        self._tensorboard = TensorBoardLog(folder.path, transitions)

    def __enter__(self) -> "_Log":
        return self

    def __exit__(self, *_: object) -> None:
        self.attempt("TensorBoard events", self._tensorboard.close)
        self.console.close()

    def write(self, row: Row) -> None:
        """Show and write a row of metrics."""
        self.console.report(row)
        self.attempt("metrics", lambda: self._csv.write(row))
        self.attempt("TensorBoard events", lambda: self._tensorboard.write(row))

    def attempt(self, what: str, write: Callable[[], None]) -> None:
        """Write something; if that fails, say so and go on."""
        try:
            write()
        except OSError as error:
            self.console.say(f"warning: could not write {what} ({error}); training goes on")


def _require_device(device: str) -> None:
    if device.startswith("cuda") and not torch.cuda.is_available():
        raise DeviceUnavailableError(
            f"device '{device}' was asked for, but torch finds no CUDA device; use 'cpu'."
        )


def _require_fit(cfg: TrainCfg, env: Environment, contract: PolicyContract) -> None:
    sizes = {
        "num_envs": (cfg.num_envs, env.num_envs),
        "observation_sizes": (
            {name: agent.num_inputs for name, agent in contract.agents.items()},
            env.observation_sizes,
        ),
        "action_sizes": (
            {name: len(agent.joints) for name, agent in contract.agents.items()},
            env.action_sizes,
        ),
    }
    for name, (expected, found) in sizes.items():
        if expected != found:
            raise PolicyMismatchError(
                f"{name}: configuration and contract say {expected}, the environment {found}."
            )
