"""What studies share: where cells are computed, progress on standard error, and the report."""

from collections.abc import Callable, Sequence
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
from pixel2catch.evaluation.policy_cells import find_policies, policy_cells
from pixel2catch.evaluation.policy_report import result_rows
from pixel2catch.evaluation.protocol import EvaluationCfg
from pixel2catch.evaluation.report import Row, write_report
from pixel2catch.evaluation.stress import Setting
from pixel2catch.reports import Section, as_markdown, circumstances

JOBS_ON_CLUSTER = 100  #: Largest number of jobs, waiting or running, on a cluster at once. Source: ours.


def run_grid(grid: StudyGrid, slots: Sequence[Slot], name: str, logs: Path | None = None) -> None:
    """Compute the missing cells of a grid, with progress.

    Args:
        grid: The cells.
        slots: Where they are computed.
        name: Name of the study.
        logs: Folder for what cells print in other processes.

    Raises:
        KeyboardInterrupt: If the user stopped it.
    """
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
    slurm: tuple[str, ...],
    out: Path,
    *,
    kind: str = "",
    has_one_thread: bool = False,
    is_reused: bool = True,
) -> list[Slot]:
    """Return slots for cells of a kind, on all devices in turn: jobs of a cluster, or workers."""
    if executor := cluster_executor(slurm, out):
        return [
            ClusterJob(kind, each, executor) for _ in range(number or JOBS_ON_CLUSTER) for each in devices
        ]
    variables = ONE_THREAD if has_one_thread else {}
    workers = partial(Worker, kind, environment=variables, is_reused=is_reused)
    return [workers(each) for _ in range(number or 1) for each in devices]


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
