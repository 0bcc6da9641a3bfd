"""The work of `stress` and `reproduce`: cells of a grid, progress on standard error, and the report."""

import shutil
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path

from pixel2catch.api.calls import run
from pixel2catch.cli.console import progress_bar, say
from pixel2catch.cli.evaluate import Evaluate
from pixel2catch.cli.reproduce import EVALUATION, OWN, TRAINING, Reproduce
from pixel2catch.evaluation.comparison import GROUPS, ComparisonFolder, Plan, Training, write_comparison
from pixel2catch.evaluation.grid import (
    ONE_THREAD,
    ClusterJob,
    Slot,
    Status,
    StudyCell,
    StudyGrid,
    Worker,
    cluster_executor,
    held,
)
from pixel2catch.evaluation.loading import PHYSICS_HZ
from pixel2catch.evaluation.policy_cells import find_policies, policy_cells
from pixel2catch.evaluation.policy_report import result_rows
from pixel2catch.evaluation.protocol import EvaluationCfg
from pixel2catch.evaluation.report import Row, write_report
from pixel2catch.evaluation.stress import Setting
from pixel2catch.learning.experiment import Experiment
from pixel2catch.methods import find_method
from pixel2catch.reports import Section, as_markdown, circumstances, markdown
from pixel2catch.sim.factory import require_cuda
from pixel2catch.workcells import find_workcell

JOBS_ON_CLUSTER = 100  #: Largest number of jobs, waiting or running, on a cluster at once. Source: ours.
JOBS_ON_CUDA = 3  #: Trainings that share a GPU. Source: ours; one does not fill it.
NEUTRAL = ("checkpoint_seconds", "report_seconds", "fuse")  #: Fields of a training that change no result.


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


def compare_methods(study: Reproduce, experiment: Experiment) -> None:
    """Train and evaluate what is missing of a comparison, and write the report.

    Raises:
        StudyError: If a cell failed; the report has all others.
    """
    folder, plan = ComparisonFolder(study.out), _plan(study, experiment)
    grid = StudyGrid([cell for each in plan.runs() for cell in _cells(study, folder, each, experiment)])
    for device in {place for cell in grid.missing for place in study.places[cell.kind]}:
        if device != "cpu" and not study.slurm:  # jobs of a cluster look for themselves
            require_cuda(device)
    folder.path.mkdir(parents=True, exist_ok=True)
    with held(folder.path):
        slots = [slot for kind in study.places for slot in _slots(study, kind)]
        folder.open(replace(plan, sessions=(circumstances(),)) if grid.missing else plan)
        run_grid(grid, slots, "reproduce", folder.path / "logs")
    rates = write_comparison(folder)
    print(markdown(rates) if rates else "Nothing is finished yet.\n", end="")
    say(f"wrote the report: {folder.path / 'report'}: table.md")
    grid.require_whole()


def _slots(study: Reproduce, kind: str) -> list[Slot]:
    """Return slots of trainings or evaluations; on a CPU one evaluation has all cores."""
    devices, number = study.places[kind], study.jobs_per_device
    is_cpu = devices[0] == "cpu"
    if not study.slurm:
        number = 1 if is_cpu and kind == EVALUATION else number or (1 if is_cpu else JOBS_ON_CUDA)
    is_reused = kind == EVALUATION
    options = {"kind": kind, "has_one_thread": not is_cpu, "is_reused": is_reused}
    return make_slots(devices, number, study.slurm, study.out, **options)


def _plan(study: Reproduce, experiment: Experiment) -> Plan:
    """Return methods and seeds, with everything that changes results."""
    train, env = experiment.train, experiment.env
    given = [option.partition("=") for option in study.training]
    options = {name: value.split(",") for name, _, value in given if name.startswith("env.")}
    options |= {name: value for name, value in asdict(train).items() if name not in (*OWN, *NEUTRAL)}
    options |= {
        "physics_stages": train.physics_stages or (env.scene.physics_hz,),
        "task": env.name,
        "env.scene.cone": env.scene.cone,
        "env.scene.multiccd": env.scene.multiccd,
        "env.sensing.latency_steps": env.sensing.latency_steps,
    }
    evaluation = {
        "num_envs": study.num_envs,
        "trials": study.trials,
        "device": " ".join(sorted({device.split(":")[0] for device in study.evaluation_device})),
        "physics_hz": PHYSICS_HZ,
    }
    return Plan(
        methods=tuple(dict.fromkeys(find_method(name).name for name in study.methods)),
        seeds=study.seeds,
        configuration={f"training {name}": value for name, value in options.items() if value is not None}
        | {f"evaluation {name}": value for name, value in evaluation.items()},
    )


def _cells(
    study: Reproduce, folder: ComparisonFolder, run: Training, experiment: Experiment
) -> Iterator[StudyCell]:
    """Yield the training of a run, and the evaluations of its policy."""
    experiment = replace(experiment, train=replace(experiment.train, seed=run.seed))
    evaluate = Evaluate(policy=folder.run(run), num_envs=study.num_envs, trials=study.trials, seed=run.seed)
    yield StudyCell(
        name=run.name,
        kind=TRAINING,
        work=partial(train_run, experiment, run.method, folder.run(run), study.starting_preset),
        is_done=lambda: folder.summary(run) is not None,
    )
    for group in GROUPS:
        of_group = replace(evaluate, objects=(group,), out=folder.evaluation(run, group))
        yield StudyCell(
            name=f"{run.name}-{group}",
            kind=EVALUATION,
            work=partial(evaluate_run, of_group),
            is_done=lambda group=group: folder.result(run, group) is not None,
            after=(run.name,),
        )


def evaluate_run(evaluate: Evaluate, device: str) -> None:
    """Evaluate the policy of a run on a device."""
    replace(evaluate, device=device).run()


def train_run(experiment: Experiment, name: str, folder: Path, preset: str, device: str) -> None:
    """Train a method on a device, from the checkpoint in its folder if there is one."""
    has_checkpoint = (folder / "checkpoint.pt").exists()
    if not has_checkpoint:
        shutil.rmtree(folder, ignore_errors=True)
    experiment = replace(experiment, train=replace(experiment.train, device=device))
    method = find_method(name, find_workcell(experiment.env.scene.workcell))
    run(experiment, method, folder, resume=has_checkpoint, preset=preset)
