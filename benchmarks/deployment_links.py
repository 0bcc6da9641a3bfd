"""What each link between simulator and laboratory costs: rehearsals in step, each with one thing changed.

All settings throw the same throws at the shipped policy.

python benchmarks/deployment_links.py --throws 200 --jobs 16 --out links.json
"""

import argparse
import json
import multiprocessing
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import torch

from pixel2catch.evaluation.loading import fingerprint, load_policy, task_of
from pixel2catch.evaluation.metrics import wilson_interval
from pixel2catch.files import write_atomically
from pixel2catch.scene.objects import select_objects
from pixel2catch.servo.limits import ServoLimits
from pixel2catch.twin import RehearsalCfg
from pixel2catch.twin.stepped import rehearse_stepped
from pixel2catch.workcells import find_workcell

SHARD = 10
"""Throws that a process makes before it takes others."""

WIDE = {
    "speed": 19.0,
    "step": 0.038,
    "acceleration": 1e4,
    "jerk": 1e7,
    "deceleration": 1e6,
    "lead": 1e3,
    "tracking_error": 1e3,
}
"""Limits of all joints that hold nothing back of what the UR's driver takes."""


def settings(task: Any) -> dict[str, tuple[RehearsalCfg, ServoLimits]]:
    """What is compared, by name; a free servo holds back next to nothing but what leaves the workspace."""
    boxes = RehearsalCfg(throws=SHARD, plain=True)
    images = replace(boxes, plain=False)
    limits = ServoLimits.of(find_workcell(task.scene.workcell))
    wide = {name: np.full(limits.num_joints, value) for name, value in WIDE.items()}
    free = replace(limits, joints=replace(limits.joints, **wide))
    return {
        "boxes": (boxes, limits),
        "boxes, servo without limits": (boxes, free),
        "boxes, ramp of 0.1 s": (boxes, replace(limits, ramp_time=0.1)),
        "boxes, both": (boxes, replace(free, ramp_time=0.1)),
        "boxes, perception 0 ms": (replace(boxes, perception_ms=0.0), limits),
        "boxes, perception 20 ms": (replace(boxes, perception_ms=20.0), limits),
        "boxes, perception 30 ms": (replace(boxes, perception_ms=30.0), limits),
        "images": (images, limits),
        "images, servo without limits": (images, free),
        "images, perception 20 ms": (replace(images, perception_ms=20.0), limits),
    }


@dataclass(frozen=True, kw_only=True)
class Shard:
    """Some throws of a setting."""

    name: str
    policy: Path | None
    seed: int


def throw(shard: Shard) -> list[dict[str, Any]]:
    """Rehearse a shard; return what became of each throw."""
    torch.set_num_threads(1)
    policy, _ = load_policy(shard.policy)
    task = replace(task_of(policy), objects=select_objects(("seen",)))
    cfg, limits = settings(task)[shard.name]
    cfg = replace(cfg, seed=shard.seed)
    return rehearse_stepped(cfg, task, policy, lambda _: None, limits)["throws"]


def row(name: str, throws: list[dict[str, Any]]) -> dict[str, Any]:
    """What is said of a setting."""
    caught = [throw["is_success"] for throw in throws]
    return {
        "setting": name,
        "num_throws": len(throws),
        "success_rate": float(np.mean(caught)),
        "interval": wilson_interval(sum(caught), len(caught)),
        "tracking_rate": float(np.mean([throw["is_tracked"] for throw in throws])),
        "problems": sum(bool(throw["problem"] or throw["stops"]) for throw in throws),
        "caught": caught,
    }


def rows(names: list[str], args: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """Rehearse all settings; yield what is said of each as it is done."""
    numbers = range(0, args.throws, SHARD)
    shards = [Shard(name=name, policy=args.policy, seed=seed) for name, seed in product(names, numbers)]
    with ProcessPoolExecutor(args.jobs, multiprocessing.get_context("spawn")) as pool:
        results = pool.map(throw, shards)
        for name in names:
            yield row(name, [thrown for _ in numbers for thrown in next(results)])


def main() -> None:
    """Compare, print and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--policy", type=Path, help="shipped policy or folder. Default: proposed")
    parser.add_argument("--throws", type=int, default=200, help=f"throws of each setting, times {SHARD}")
    parser.add_argument("--jobs", type=int, default=2, help="processes")
    parser.add_argument("--settings", nargs="+", help="names. Default: all")
    parser.add_argument("--out", type=Path, required=True, help="report")
    args = parser.parse_args()
    policy, _ = load_policy(args.policy)
    names = args.settings or list(settings(task_of(policy)))
    report = []
    for result in rows(names, args):
        report.append(result)
        low, high = result["interval"]
        print(
            f"{result['setting']:32} S.R. {100 * result['success_rate']:5.1f} % "
            f"[{100 * low:.1f}, {100 * high:.1f}]  T.R. {100 * result['tracking_rate']:5.1f} %",
            flush=True,
        )
    header = {"policy": fingerprint(args.policy), "throws": args.throws}
    write_atomically({args.out: f"{json.dumps({**header, 'settings': report})}\n".encode()})


if __name__ == "__main__":
    main()
