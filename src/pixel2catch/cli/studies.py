"""What studies share: where cells are computed, and progress on standard error."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path

from pixel2catch.cli.console import progress_bar, say
from pixel2catch.evaluation.grid import (
    ONE_THREAD,
    ClusterJob,
    Slot,
    Status,
    StudyGrid,
    Worker,
    cluster_executor,
)

JOBS_ON_CLUSTER = 100  #: Largest number of jobs, waiting or running, on a cluster at once. Source: ours.


def run_grid(grid: StudyGrid, slots: Sequence[Slot], name: str, logs: Path | None = None) -> None:
    """Compute the missing cells of a grid, with progress; `logs` gets what cells print elsewhere."""
    shown = dict(grid.status)

    def watch() -> None:
        changes = {cell: now for cell, now in grid.status.items() if now is not shown[cell]}
        shown.update(changes)
        done = sum(now is Status.DONE for now in shown.values())
        for cell, now in changes.items():
            if now is not Status.RUNNING:
                say(f"{done} of {len(shown)}: {cell} {now.value}")
        if changes:
            running = [cell for cell, now in shown.items() if now is Status.RUNNING]
            bar.show(done / len(shown), ", ".join(running))

    if grid.missing:
        with progress_bar(name) as bar:
            grid.run(slots, watch, logs)


def make_slots(
    devices: Sequence[str],
    number: int | None,
    slurm: tuple[str, ...] | None,
    out: Path,
    *,
    kind: str = "",
    has_one_thread: bool = False,
    is_reused: bool = True,
) -> list[Slot]:
    """Return slots for cells of a kind, on all devices in turn: jobs of a cluster, or workers."""
    if slurm:
        executor = cluster_executor(slurm, out)
        return [
            ClusterJob(kind, each, executor) for _ in range(number or JOBS_ON_CLUSTER) for each in devices
        ]
    variables = ONE_THREAD if has_one_thread else {}
    workers = partial(Worker, kind, environment=variables, is_reused=is_reused)
    return [workers(each) for _ in range(number or 1) for each in devices]
