"""Progress of a study on standard error: a bar on a terminal, and a line for every cell that ends."""

import time
from collections.abc import Callable, Sequence
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
from pixel2catch.evaluation.policy_cells import find_policies, policy_cells
from pixel2catch.evaluation.policy_report import result_rows
from pixel2catch.evaluation.protocol import EvaluationCfg
from pixel2catch.evaluation.report import Row, write_report
from pixel2catch.evaluation.stress import Setting
from pixel2catch.reports import Section, as_markdown, circumstances

JOBS_ON_CLUSTER = 100  #: Largest number of jobs, waiting or running, on a cluster at once. Source: ours.
REFRESH_SECONDS = 2.0  #: Time between two looks at what running cells have done [s].


def run_grid(
    grid: StudyGrid,
    slots: Sequence[Slot],
    name: str,
    logs: Path | None = None,
    detail: Callable[[list[str]], tuple[float, str]] = lambda running: (0.0, ", ".join(running)),
) -> None:
    """Compute the missing cells of a grid, with progress.

    Args:
        grid: The cells.
        slots: Where they are computed.
        name: Name of the study.
        logs: Folder for what cells print in other processes.
        detail: Returns of the running cells, by name, the sum of the shares that are done, and a text.

    Raises:
        KeyboardInterrupt: If the user stopped it.
    """
    shown, next_look = dict(grid.status), 0.0

    def watch() -> None:
        nonlocal next_look
        changes = {cell: now for cell, now in grid.status.items() if now is not shown[cell]}
        shown.update(changes)
        done = sum(now is Status.DONE for now in shown.values())
        for cell, now in changes.items():
            if now not in (Status.WAITING, Status.RUNNING):
                say(f"{done} of {len(shown)}: {cell} {now.value}")
        if changes or time.monotonic() >= next_look:
            next_look = time.monotonic() + REFRESH_SECONDS
            share, text = detail([cell for cell, now in shown.items() if now is Status.RUNNING])
            ended = sum(now in (Status.DONE, Status.FAILED) for now in shown.values())
            bar.show((ended + share) / len(shown), text)

    if grid.missing:
        with progress_bar(name) as bar:
            watch()
            grid.run(slots, watch, logs)


def cpu_slots(jobs: int, device: str, slurm: tuple[str, ...], out: Path) -> Sequence[Slot]:
    """Return slots for cells of one kind: jobs of a cluster, or workers, several with one thread each."""
    executor = cluster_executor(slurm, out)
    if executor:
        return [ClusterJob("", device, executor) for _ in range(JOBS_ON_CLUSTER)]
    return [Worker("", device, ONE_THREAD if jobs > 1 else {}) for _ in range(jobs)]


def evaluate_policies(
    title: str,
    folders: Sequence[Path],
    settings: Sequence[Setting],
    cfg: EvaluationCfg,
    slots: Sequence[Slot],
    out: Path,
    home_of: Callable[[Setting], str],
    sections_of: Callable[[Sequence[Row]], list[Section]],
) -> None:
    """Evaluate policies under settings, the same throws for all; print and write the report.

    Args:
        title: Title of the study.
        folders: Folders of the policies; all shipped ones if there are none.
        settings: The settings.
        cfg: The throws.
        slots: Where cells are computed.
        out: Folder of the results.
        home_of: Returns the name of the setting that another one is compared with.
        sections_of: Returns what people read.

    Raises:
        StudyError: If a cell failed; the report has all others.
    """
    policies = find_policies(folders)
    grid = StudyGrid(policy_cells(policies, settings, out, cfg, is_alone=len(slots) == 1))
    run_grid(grid, slots, title.split()[0].lower())
    if rows := result_rows(policies, settings, out, home_of):
        sections = sections_of(rows)
        print(as_markdown(title, sections), end="", flush=True)
        data = {"results": rows, "circumstances": circumstances()}
        say(f"wrote {out}: {write_report(out, title, sections, data)}")
    grid.require_whole()
