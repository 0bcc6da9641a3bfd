"""What a training costs on this machine: transitions a second, time of rollout and update, memory.

It goes on from a trained policy, with the policy's throws. Rates are summed over the environments.
Microseconds are for a control step of one of them.

    python benchmarks/training_costs.py --device cpu cuda --num-envs 512 2048 8192 --out costs.json
"""

import argparse
import contextlib
import io
import itertools
import os
import resource
import tempfile
from dataclasses import replace
from pathlib import Path
from statistics import mean
from typing import Any

import torch
from rich.console import Console

import pixel2catch as p2c
from pixel2catch.cli.console import prepare
from pixel2catch.files import json_text
from pixel2catch.learning.log import METRICS_FILE, read_rows
from pixel2catch.learning.train import train
from pixel2catch.reports import circumstances, terminal_table

LOG_STD = -1.5  #: Noise of the actions, small enough to keep the policy's throws. Source: ours.
WARM_UPDATES = 2  #: Updates before the measurement, in which libraries initialise and graphs are recorded.


def measure(policy: p2c.Policy, experiment: p2c.Experiment, updates: int) -> dict[str, Any]:
    cfg, method = experiment.train, p2c.method_of(policy.contract)
    env = p2c.CatchEnv(experiment.env, method, num_envs=cfg.num_envs, device=cfg.device, is_fused=cfg.fuse)
    with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stdout(io.StringIO()):
        policy.save(start := Path(folder, "start"))
        transitions = (WARM_UPDATES + updates) * cfg.rollout_transitions
        cfg = replace(cfg, start=start, transitions=transitions)
        train(cfg, lambda *_: env, policy.contract, Path(folder, "run"))
        rows = read_rows(Path(folder, "run", METRICS_FILE))[-updates:]
    rollout, update = (
        mean(float(row[f"{name}_seconds"]) for row in rows) / cfg.rollout_steps
        for name in ("rollout", "update")
    )
    is_cuda = cfg.device.startswith("cuda")
    free, total = torch.cuda.mem_get_info(cfg.device) if is_cuda else (0, 0)
    return {
        "device": cfg.device,
        "num_envs": cfg.num_envs,
        "physics_hz": experiment.env.scene.physics_hz,
        "training_steps_per_second": cfg.num_envs / (rollout + update),
        "rollout_us": 1e6 * rollout / cfg.num_envs,
        "update_us": 1e6 * update / cfg.num_envs,
        "rss_bytes": 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss,
        "device_bytes": total - free,
    }


def main(words: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description="Measure what a training costs on this machine.")
    parser.add_argument("--device", nargs="+", default=["cpu"], help="cpu, cuda, cuda:1, ..., or several")
    parser.add_argument("--num-envs", nargs="+", type=int, default=[512], help="environments side by side")
    parser.add_argument("--updates", type=int, default=5, help="measured updates, after two others")
    parser.add_argument("--policy", default="proposed", help="policy that acts and goes on to learn")
    parser.add_argument("--fuse", action="store_true", help="torch.compile makes fewer kernels")
    parser.add_argument("--out", type=Path, help="file that gets all numbers")
    args = parser.parse_args(words)
    threads, load = torch.get_num_threads(), os.getloadavg()[0]
    devices = [*map(prepare, args.device)]
    torch.set_num_threads(threads)  # those of `train`
    rows: list[dict[str, Any]] = []
    for device, num_envs in itertools.product(devices, sorted(args.num_envs)):
        policy = p2c.load_policy(args.policy, device)
        experiment = p2c.preset(
            "fast" if device.startswith("cuda") else "cpu",
            policy.contract.task,
            workcell=policy.contract.workcell,
            device=device,
            num_envs=num_envs,
            fuse=args.fuse,
            physics_stages=(),
            hidden=policy.hidden,
            initial_log_std=LOG_STD,
        )
        rows.append(measure(policy, experiment, args.updates))
        result = circumstances() | {"load_average_before": load, "policy": args.policy, "results": rows}
        if args.out:  # at once: the next number may take too long
            args.out.write_text(json_text(result))
    shown = [
        {"device": row["device"], "environments": f"{row['num_envs']:,}"}
        | {"transitions/s": f"{row['training_steps_per_second']:,.0f}"}
        | {"rollout [µs]": f"{row['rollout_us']:.1f}", "update [µs]": f"{row['update_us']:.1f}"}
        | {"memory [GB]": f"{1e-9 * row['rss_bytes']:.2f}"}
        | {"memory of the device [GB]": f"{1e-9 * row['device_bytes']:.2f}"}
        for row in rows
    ]
    Console(width=120).print(terminal_table("costs of a training", shown))
    if load > 0.5 * len(os.sched_getaffinity(0)):
        print(f"this machine had other work (load average {load:.1f}): without it, it is faster")


if __name__ == "__main__":
    main()
