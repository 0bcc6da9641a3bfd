"""What the tests start with torchrun, in two processes: `torchrun … two_processes.py WHAT FOLDER DEVICE`.

`update` checks that two learners are as one; `fail` and `endless` train the small task.
"""

import dataclasses
import json
import os
import sys
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import torch
from reaching import CONTRACT, SMALL, ReachingCfg, ReachingEnv, Step, roll_out

from pixel2catch.rl import TrainCfg, train
from pixel2catch.rl.learner import Learner
from pixel2catch.rl.memory import RolloutMemory
from pixel2catch.rl.workers import Workers, start_workers

CFG = dataclasses.replace(SMALL, schedule="kl", kl_target=0.004, gradient_clip=0.5, entropy_scale=0.01)
NUM_UPDATES = 2
TOLERANCES = {"cpu": (1e-5, 2e-6), "cuda": (1e-2, 1e-3)}
"""Relative and absolute; a CUDA device rounds the networks' products to TF32."""


class OrderedMemory(RolloutMemory):
    """Mini-batches of successive control steps, so that one of the whole is made of one of each half."""

    def sample(
        self, names: list[str], *, batch_size: int, mini_batches: int = 1, sequence_length: int = 1
    ) -> Iterator[list[torch.Tensor]]:
        for indices in torch.arange(batch_size, device=self.device).chunk(mini_batches):
            yield [self.tensors_view[name].index_select(0, indices) for name in names]


def make_learner(cfg: TrainCfg, workers: Workers | None = None) -> Learner:
    torch.manual_seed(0)
    learner = Learner(cfg, ReachingEnv(cfg), workers)
    for memory in learner.memories.values():
        memory.__class__ = OrderedMemory
    return learner


def give_half(whole: Learner, half: Learner, rank: int) -> None:
    """Put one half of the environments' transitions into a learner's memory."""
    size = half.cfg.num_envs
    mine = slice(rank * size, (rank + 1) * size)
    for agent, memory in half.memories.items():
        for name, tensor in memory.tensors.items():
            tensor.copy_(whole.memories[agent].tensors[name][:, mine])
        memory.filled = True
        half.mappo._current_next_states[agent] = whole.mappo._current_next_states[agent][mine]


def all_tensors(learner: Learner) -> dict[str, torch.Tensor]:
    return {
        f"{agent}.{part}.{name}": tensor.clone()
        for agent, parts in learner.state_dict().items()
        for part in parts
        if part != "optimizer"
        for name, tensor in parts[part].items()
    }


def check_halves_learn_as_the_whole(workers: Workers) -> None:
    """Fed the same transitions, two processes take the steps of one, and hold its statistics."""
    cfg = dataclasses.replace(CFG, device=workers.device)
    rtol, atol = TOLERANCES[torch.device(cfg.device).type]
    whole, half = make_learner(cfg), make_learner(workers.share(cfg), workers)
    start, env = all_tensors(whole), ReachingEnv(cfg)
    for _ in range(NUM_UPDATES):
        roll_out(whole, env)
        give_half(whole, half, workers.rank)
        expected, found = whole.update(0.0), half.update(0.0)
        for name, value in expected.items():
            torch.testing.assert_close(found[name], value, rtol=10 * rtol, atol=atol)
    expected, found = all_tensors(whole), all_tensors(half)
    for name in expected:
        assert not torch.equal(start[name], found[name]), name
        torch.testing.assert_close(found[name], expected[name], rtol=rtol, atol=atol)
    half.close()


def check_networks_stay_the_same(workers: Workers) -> None:
    """With episodes and exploration of their own, the processes hold the same numbers, to the last bit."""
    share = workers.share(SMALL)
    learner, env = make_learner(share, workers), ReachingEnv(share)
    workers.diverge(SMALL.seed, 0)
    for _ in range(NUM_UPDATES):
        roll_out(learner, env)
        actions = learner.memories["arm"].get_tensor_by_name("actions").sum()
        assert workers.max(actions.clone()) > -workers.max(-actions)
        learner.update(0.0)
    for name, tensor in all_tensors(learner).items():
        assert torch.equal(workers.max(tensor.clone()), -workers.max(-tensor)), name
    learner.close()


class CountingEnv(ReachingEnv):
    """Goes wrong in the second process, in the second rollout; writes down the episodes of the first."""

    def __init__(self, cfg: TrainCfg, folder: Path) -> None:
        is_second = cfg.seed != SMALL.seed
        super().__init__(cfg, ReachingCfg(bad_step=20 if is_second else -1, bad_quantity="hand/reward"))
        self.file, self.num_ended = folder / f"seed{cfg.seed}.json", 0
        self.counted: dict[str, float] = {"num_envs": cfg.num_envs}

    def step(self, actions: dict[str, torch.Tensor]) -> Step:
        step = super().step(actions)
        self.num_ended += int((step.terminated | step.truncated).sum())
        if self.num_steps == SMALL.rollout_steps:
            self.counted |= {"episodes": self.num_ended, "noise": torch.rand(()).item()}
        return step

    def close(self) -> None:
        self.file.write_text(json.dumps(self.counted))


def fail_in_the_second(folder: Path, device: str) -> None:
    cfg = dataclasses.replace(SMALL, device=device)
    train(cfg, partial(CountingEnv, folder=folder), CONTRACT, folder / "run")


def train_endlessly(folder: Path, device: str) -> None:
    cfg = dataclasses.replace(SMALL, device=device, transitions=10**9, report_seconds=0.0)
    result = train(cfg, ReachingEnv, CONTRACT, folder / "run")
    (folder / f"{os.environ['RANK']}.json").write_text(json.dumps([result.status, result.transitions]))


def update(folder: Path, device: str) -> None:
    with start_workers(device) as workers:
        check_halves_learn_as_the_whole(workers)
        check_networks_stay_the_same(workers)
        (folder / f"checked{workers.rank}").touch()
    # A thread of the group that outlives it may end the process with "terminate called".
    threads = [(task / "comm").read_text().strip() for task in Path("/proc/self/task").iterdir()]
    assert not [name for name in threads if "gloo" in name], threads


WHAT = {"update": update, "fail": fail_in_the_second, "endless": train_endlessly}

if __name__ == "__main__":
    WHAT[sys.argv[1]](Path(sys.argv[2]), sys.argv[3])
