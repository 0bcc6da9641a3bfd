"""What the tests start with torchrun, in two processes: `torchrun … two_processes.py WHAT FOLDER DEVICE`.

`update` checks that two learners are as one; `fail` and `endless` train the small task.
"""

import json
import os
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from reaching import CONTRACT, SMALL, ReachingCfg, ReachingEnv, roll_out

from pixel2catch.learning import mappo as algorithm
from pixel2catch.learning.config import TrainCfg
from pixel2catch.learning.distributed import Workers, start_workers
from pixel2catch.learning.mappo import Mappo
from pixel2catch.learning.train import train

CFG = replace(SMALL, schedule="kl", kl_target=0.004, gradient_clip=0.5, entropy_scale=0.01)
NUM_UPDATES = 2
TOLERANCES = {"cpu": (1e-5, 2e-6), "cuda": (1e-2, 1e-3)}
"""Relative and absolute; a CUDA device rounds the networks' products to TF32."""


def ordered(cfg: TrainCfg) -> torch.Tensor:
    """An order by which a mini-batch of the whole is made of one of each half."""
    return torch.arange(cfg.rollout_transitions, device=cfg.device)


def make_mappo(cfg: TrainCfg, workers: Workers | None = None) -> Mappo:
    torch.manual_seed(0)
    return Mappo(cfg, ReachingEnv(cfg), CONTRACT, workers)


def give_half(whole: Mappo, half: Mappo, rank: int) -> None:
    """Put one half of the environments' transitions into the rollout of another."""
    size = half.cfg.num_envs
    mine = slice(rank * size, (rank + 1) * size)
    half.is_done = whole.is_done[:, mine]
    half.next_states = {agent: states[mine] for agent, states in whole.next_states.items()}
    for agent, rollout in half.rollout.items():
        half.rewards[agent] = whole.rewards[agent][:, mine]
        for target, source in zip(rollout, whole.rollout[agent], strict=True):
            target.copy_(source[:, mine])


def all_tensors(mappo: Mappo) -> dict[str, torch.Tensor]:
    return {
        f"{agent}.{name}": tensor.clone()
        for agent, networks in mappo.networks.items()
        for name, tensor in networks.state_dict().items()
    }


def check_halves_learn_as_the_whole(workers: Workers) -> None:
    """Fed the same transitions, two processes take the steps of one, and hold its statistics."""
    cfg = replace(CFG, device=workers.device)
    rtol, atol = TOLERANCES[torch.device(cfg.device).type]
    whole, half = make_mappo(cfg), make_mappo(workers.share(cfg), workers)
    start, env = all_tensors(whole), ReachingEnv(cfg)
    for _ in range(NUM_UPDATES):
        roll_out(whole, env)
        give_half(whole, half, workers.rank)
        expected, found = (each.named(each.update(0.0).tolist()) for each in (whole, half))
        for name, value in expected.items():
            torch.testing.assert_close(found[name], value, rtol=10 * rtol, atol=atol)
    expected, found = all_tensors(whole), all_tensors(half)
    for name in expected:
        assert not torch.equal(start[name], found[name]), name
        torch.testing.assert_close(found[name], expected[name], rtol=rtol, atol=atol)
    half.drop_recordings()


def check_networks_stay_the_same(workers: Workers) -> None:
    """With episodes and exploration of their own, the processes hold the same numbers, to the last bit."""
    share = workers.share(SMALL)
    mappo, env = make_mappo(share, workers), ReachingEnv(share)
    workers.diverge(SMALL.seed, 0)
    for _ in range(NUM_UPDATES):
        roll_out(mappo, env)
        actions = mappo.rollout["arm"].actions.sum()
        assert workers.max(actions.clone()) > -workers.max(-actions)
        mappo.update(0.0)
    for name, tensor in all_tensors(mappo).items():
        assert torch.equal(workers.max(tensor.clone()), -workers.max(-tensor)), name
    mappo.drop_recordings()


class CountingEnv(ReachingEnv):
    """Goes wrong in the second process, in the second rollout; writes down the episodes of the first."""

    def __init__(self, cfg: TrainCfg, physics_hz: float | None, folder: Path) -> None:
        is_second = cfg.seed != SMALL.seed
        task = ReachingCfg(bad_step=20 if is_second else -1, bad_quantity="hand/reward")
        super().__init__(cfg, physics_hz, task)
        self.file, self.num_ended = folder / f"seed{cfg.seed}.json", 0
        self.counted: dict[str, float] = {"num_envs": cfg.num_envs}

    def step(self, actions: dict[str, torch.Tensor]) -> Any:
        step = super().step(actions)
        self.num_ended += int((step.terminated | step.truncated).sum())
        if self.num_steps == SMALL.rollout_steps:
            self.counted |= {"episodes": self.num_ended, "noise": torch.rand(()).item()}
        return step

    def close(self) -> None:
        self.file.write_text(json.dumps(self.counted))


def fail_in_the_second(folder: Path, device: str) -> None:
    cfg = replace(SMALL, device=device)
    train(cfg, partial(CountingEnv, folder=folder), CONTRACT, folder / "run")


def train_endlessly(folder: Path, device: str) -> None:
    cfg = replace(SMALL, device=device, transitions=10**9, report_seconds=0.0)
    result = train(cfg, ReachingEnv, CONTRACT, folder / "run")
    (folder / f"{os.environ['RANK']}.json").write_text(json.dumps([result.status, result.transitions]))


def update(folder: Path, device: str) -> None:
    shuffled, algorithm.shuffled = algorithm.shuffled, ordered
    with start_workers(device) as workers:
        check_halves_learn_as_the_whole(workers)
        check_networks_stay_the_same(workers)
    algorithm.shuffled = shuffled
    # A thread of the group that outlives it may end the process with "terminate called".
    threads = [(task / "comm").read_text().strip() for task in Path("/proc/self/task").iterdir()]
    assert not [name for name in threads if "gloo" in name], threads
    (folder / f"checked{workers.rank}").touch()


WHAT = {"update": update, "fail": fail_in_the_second, "endless": train_endlessly}

if __name__ == "__main__":
    for what in sys.argv[1].split():
        WHAT[what](Path(sys.argv[2]), sys.argv[3])
        os.environ["MASTER_PORT"] = os.environ.get("NEXT_PORT", "")  # the old one's group may still end
