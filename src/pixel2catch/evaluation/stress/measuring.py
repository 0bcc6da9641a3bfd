"""Measuring the cells of the stress suite: the same throws for all, in one process or in several.

A cell is written all at once. Cells that are there are not computed again; cells that were obtained otherwise
are refused before anything is computed, and never overwritten. No cell depends on the number of processes: it
has seeds of its own, and the physics is the same on any number of threads.
"""

import dataclasses
import json
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext

from pixel2catch.errors import InvalidValueError, StudyError
from pixel2catch.evaluation.loading import fingerprint, load_policy, task_of
from pixel2catch.evaluation.metrics import Metrics, metrics
from pixel2catch.evaluation.protocol import EvaluationCfg
from pixel2catch.evaluation.rounds import Actor, Trials, run_round
from pixel2catch.evaluation.stress.cells import Cell, Json, StressCfg
from pixel2catch.evaluation.stress.processes import in_processes
from pixel2catch.files import plain, write_atomically
from pixel2catch.methods import Method
from pixel2catch.policy import leaves
from pixel2catch.robot.objects import OBJECTS


def run_cells(
    cells: Sequence[Cell],
    cfg: StressCfg,
    on_cell: Callable[[int, Cell, Metrics], None] = lambda *_: None,
    jobs: int = 1,
) -> tuple[Json, ...]:
    """Compute the cells that are not there, and return all.

    Args:
        cells: The cells.
        cfg: How they are obtained.
        on_cell: Called with number, cell and metrics of every cell that was computed, as soon as it was.
        jobs: Cells that are computed at once, each in a process of its own; only on the CPU more than one.

    Raises:
        InvalidValueError: If there can not be so many.
        StudyError: If a cell was obtained otherwise, nothing was computed then; or if a process was ended.
    """
    if jobs < 1 or (jobs > 1 and cfg.device != "cpu"):
        raise InvalidValueError(
            f"{jobs} jobs were asked for on '{cfg.device}'; give --jobs 1, or more with --device cpu"
        )
    origins = [_origin(cell, cfg) for cell in cells]
    for cell, origin in zip(cells, origins, strict=True):
        _require_same(cell, origin)
    results = [cell.read() for cell in cells]
    missing = [number for number, result in enumerate(results) if result is None]
    for number, found in _measured([cells[number] for number in missing], cfg, jobs):
        number = missing[number]
        cell, result = cells[number], origins[number] | {"metrics": found}
        cell.file.parent.mkdir(parents=True, exist_ok=True)
        write_atomically({cell.file: (json.dumps(result, indent=2) + "\n").encode()})
        results[number] = result
        on_cell(number + 1, cell, found)
    return tuple(result for result in results if result is not None)


def throw_rounds(actor: Actor, method: Method, cfg: EvaluationCfg, *, is_alone: bool = True) -> Trials:
    """Evaluate a policy, each round with a seed of its own: then all policies get the same throws.

    Rounds end when every hold is decided, so that without this the throws of the second would depend on the
    policy. What a setting disturbs is drawn after the throws, so that they are those of the nominal setting.

    Args:
        actor: The policy.
        method: The method that it was trained with.
        cfg: What is thrown.
        is_alone: Whether it may use all processors; else it uses one.
    """
    with nullcontext() if is_alone else _one_processor():
        env = cfg.make_env(method)
    rounds = []
    try:
        for number in range(cfg.trials):
            env.seed(cfg.seed + number)
            rounds.append(run_round(env, actor))
    finally:
        env.close()
    return Trials.concatenate(rounds)


def _measured(cells: Sequence[Cell], cfg: StressCfg, jobs: int) -> Iterator[tuple[int, Metrics]]:
    """Numbers and metrics of cells as they come."""
    if jobs > 1 and len(cells) > 1:
        yield from in_processes(jobs, _measure, [(cell, cfg, False) for cell in cells])
    else:
        yield from ((number, _measure(cell, cfg)) for number, cell in enumerate(cells))


def _measure(cell: Cell, cfg: StressCfg, is_alone: bool = True) -> Metrics:
    """Metrics of a cell."""
    trials = throw_rounds(*_evaluation(cell, cfg, cfg.device), is_alone=is_alone)
    return metrics(trials, tuple(OBJECTS))


@contextmanager
def _one_processor() -> Iterator[None]:
    """Physics that is built here steps in the calling thread alone, on whatever processor is free later."""
    processors = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(processors)})
    try:
        yield
    finally:
        os.sched_setaffinity(0, processors)


def _evaluation(cell: Cell, cfg: StressCfg, device: str) -> tuple[Actor, Method, EvaluationCfg]:
    """The policy and what is thrown at it."""
    policy, method = load_policy(cell.contestant.folder, device)
    return (
        policy,
        method,
        EvaluationCfg(
            objects=cfg.objects,
            num_envs=cfg.num_envs,
            trials=cfg.trials,
            seed=cfg.seed,
            device=device,
            task=cell.setting.level.change(task_of(policy, cfg.physics_hz)),
        ),
    )


def _origin(cell: Cell, cfg: StressCfg) -> Json:
    """Everything that decides a cell's metrics, as JSON."""
    _, method, evaluation = _evaluation(cell, cfg, "cpu")
    evaluation = dataclasses.replace(evaluation, device=cfg.device)
    return {
        "policy": cell.contestant.name,
        "method": method.name,
        "policy_sha256": fingerprint(cell.contestant.folder),
        "setting": cell.setting.name,
        "evaluation": json.loads(json.dumps(dataclasses.asdict(evaluation), default=plain)),
    }


def _require_same(cell: Cell, origin: Json) -> None:
    """See that a cell that is there was obtained as it would be now.

    Raises:
        StudyError: With the fields that differ.
    """
    found = cell.read()
    if found is None:
        return
    before, now = dict(leaves(found | {"metrics": None})), dict(leaves(origin | {"metrics": None}))
    changes = [
        f"{name}: {before.get(name)} there, {now.get(name)} now"
        for name in sorted({*before, *now})
        if before.get(name) != now.get(name)
    ]
    if changes:
        raise StudyError(
            f"'{cell.file}' was obtained otherwise ({'; '.join(changes)}); give the values that it has, or "
            "name another folder with --out."
        )
