"""`pixel2catch reproduce`: the paper's table and curves, from nothing."""

import shutil
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, fields, replace
from functools import partial
from operator import itemgetter
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from pixel2catch.checks import Count, Device, ResultsFolder, Within
from pixel2catch.cli.console import say
from pixel2catch.cli.evaluate import Evaluate
from pixel2catch.errors import InvalidValueError, UnknownNameError
from pixel2catch.reports import circumstances, markdown

if TYPE_CHECKING:
    from pixel2catch.evaluation.comparison import ComparisonFolder, Plan, Training
    from pixel2catch.evaluation.grid import Slot, StudyCell
    from pixel2catch.learning.experiment import Experiment

METHODS = ("without_pf", "only_wh", "only_center", "single_agent", "proposed", "object_position")
"""Methods that are compared, in the order of the paper's table; the last is ours, an oracle."""

OWN = ("device", "seed")  #: Fields of `TrainCfg` that a study sets for each training.

NEUTRAL = ("checkpoint_seconds", "report_seconds", "fuse")  #: Fields of a training that change no result.
JOBS_ON_CUDA = 3  #: Trainings that share a GPU. Source: ours; one does not fill it.

TRAINING, EVALUATION = "training", "evaluation"


@dataclass(frozen=True, kw_only=True)
class Reproduce:
    """Train and evaluate all methods with several seeds, and write a report: tables, curves, pictures.

    Finished parts are not computed again, and interrupted trainings continue: give the same command. Methods
    and seeds may be added later.
    """

    methods: tuple[str, ...] = METHODS  #: Methods to compare.
    seeds: Annotated[int, Within(1, 1000)] = 3  #: Trainings of each method.
    #: Settings of the trainings: fast, large, cpu or paper. Default: fast on CUDA, else cpu.
    preset: Literal["fast", "large", "cpu", "paper"] | None = None
    #: Other options of `pixel2catch train`, as NAME=VALUE, such as transitions=50_000_000 num_envs=4096 or
    #: env.sensing.latency_steps=1,3.
    training: tuple[str, ...] = ()
    #: Where to train: cpu, or one or several CUDA devices. Default: cuda where there is one.
    device: tuple[Device, ...] = ()
    #: Trainings and evaluations side by side on a GPU, which is faster where NVIDIA's Multi-Process Service
    #: runs (nvidia-cuda-mps-control -d). Default: 3; trainings on a CPU: 1; on a cluster, where each is a
    #: job: 100.
    jobs_per_device: Count | None = None
    #: Compute on a SLURM cluster: what each job asks for, as NAME=VALUE with submitit's names, such as
    #: timeout_min=240 cpus_per_task=4 gpus_per_node=1 slurm_partition=gpu.
    slurm: tuple[str, ...] = ()
    num_envs: Count = 100  #: Throws in a round of an evaluation.
    trials: Count = 10  #: Rounds of an evaluation.
    #: Where to evaluate: cpu, or one or several CUDA devices.
    evaluation_device: tuple[Device, ...] = ("cpu",)
    out: ResultsFolder = Path("results")  #: Folder of the study.

    def run(self) -> None:
        """Compute what is missing, and write the report."""
        from pixel2catch.cli.studies import run_grid
        from pixel2catch.evaluation.comparison import ComparisonFolder, write_comparison
        from pixel2catch.evaluation.grid import StudyGrid, held
        from pixel2catch.sim.factory import require_cuda

        folder, experiment = ComparisonFolder(self.out), self._experiment()
        plan = self._plan(experiment)
        grid = StudyGrid([cell for run in plan.runs() for cell in self._cells(folder, run, experiment)])
        for device in {place for cell in grid.missing for place in self._places[cell.kind]}:
            if device != "cpu" and not self.slurm:  # jobs of a cluster look for themselves
                require_cuda(device)
        folder.path.mkdir(parents=True, exist_ok=True)
        with held(folder.path):
            slots = self._slots()
            folder.open(replace(plan, sessions=(circumstances(),)) if grid.missing else plan)
            logs = {run.name: folder.metrics(run) for run in plan.runs()}
            detail = partial(_progress, logs, experiment.train.transitions)
            run_grid(grid, slots, "reproduce", folder.path / "logs", detail)
        rates = write_comparison(folder)
        print(markdown(rates) if rates else "Nothing is finished yet.\n", end="")
        say(f"wrote the report: {folder.path / 'report'}: table.md")
        grid.require_whole()

    @property
    def _places(self) -> dict[str, tuple[str, ...]]:
        """Where to train and where to evaluate."""
        import torch

        default = "cuda" if torch.cuda.is_available() else "cpu"
        return {TRAINING: self.device or (default,), EVALUATION: self.evaluation_device}

    def _slots(self) -> "list[Slot]":
        """Return slots of trainings and evaluations, on all devices in turn."""
        from pixel2catch.cli.studies import JOBS_ON_CLUSTER
        from pixel2catch.evaluation.grid import ClusterJob, Worker, cluster_executor

        executor, order = cluster_executor(self.slurm, self.out), list[tuple[int, str, str]]()
        for kind, devices in self._places.items():
            for device in devices:
                number = self.jobs_per_device or (JOBS_ON_CUDA if device != "cpu" else 1)
                if executor:
                    number = self.jobs_per_device or JOBS_ON_CLUSTER
                elif device == "cpu" and kind == EVALUATION:
                    number = 1
                order += [(turn, kind, device) for turn in range(number)]
        order.sort(key=itemgetter(0))
        if executor:
            return [ClusterJob(kind, device, executor) for _, kind, device in order]
        on_cuda = {"OMP_NUM_THREADS": "1"}
        return [
            Worker(kind, device, {} if device == "cpu" else on_cuda, is_reused=kind == EVALUATION)
            for _, kind, device in order
        ]

    def _experiment(self) -> "Experiment":
        """Return the configuration of all trainings; seed and device are replaced in each."""
        from pixel2catch.cli.main import parse_options
        from pixel2catch.learning.config import TrainCfg
        from pixel2catch.learning.experiment import Experiment

        free = {field.name for field in fields(TrainCfg)} - {*OWN}
        args = ["--device", "cpu", "--preset", self._preset]
        for option in self.training:
            name, _, value = option.partition("=")
            if name not in free and name != "task" and not name.startswith("env."):
                raise UnknownNameError("option in --training", name, [*sorted(free), "task", "env.FIELD"])
            args += [f"--{name.replace('_', '-')}", *value.split(",")]
        train = parse_options("train", args, hidden=())
        return Experiment(env=train.env, train=train.train)

    @property
    def _preset(self) -> str:
        """The preset; without one the device decides, which may be a cluster's."""
        return self.preset or ("fast" if self._places[TRAINING][0].startswith("cuda") else "cpu")

    def _plan(self, experiment: "Experiment") -> "Plan":
        """Return methods and seeds, with everything that changes results."""
        from pixel2catch.evaluation.comparison import Plan
        from pixel2catch.evaluation.loading import PHYSICS_HZ
        from pixel2catch.methods import find_method

        train, env = experiment.train, experiment.env
        given = [option.partition("=") for option in self.training]
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
            "num_envs": self.num_envs,
            "trials": self.trials,
            "device": " ".join(sorted({device.split(":")[0] for device in self.evaluation_device})),
            "physics_hz": PHYSICS_HZ,
        }
        return Plan(
            methods=tuple(dict.fromkeys(find_method(name).name for name in self.methods)),
            seeds=self.seeds,
            configuration={f"training {name}": value for name, value in options.items() if value is not None}
            | {f"evaluation {name}": value for name, value in evaluation.items()},
        )

    def _cells(
        self, folder: "ComparisonFolder", run: "Training", experiment: "Experiment"
    ) -> "list[StudyCell]":
        """Return the training of a run, and the evaluations of its policy."""
        from pixel2catch.evaluation.comparison import GROUPS
        from pixel2catch.evaluation.grid import StudyCell

        experiment = replace(experiment, train=replace(experiment.train, seed=run.seed))
        evaluate = Evaluate(policy=folder.run(run), num_envs=self.num_envs, trials=self.trials, seed=run.seed)
        return [
            StudyCell(
                name=run.name,
                kind=TRAINING,
                work=partial(train_run, experiment, run.method, folder.run(run), self._preset),
                is_done=lambda: folder.summary(run) is not None,
            ),
            *(
                StudyCell(
                    name=f"{run.name}-{group}",
                    kind=EVALUATION,
                    work=partial(
                        evaluate_run, replace(evaluate, objects=(group,), out=folder.evaluation(run, group))
                    ),
                    is_done=lambda group=group: folder.result(run, group) is not None,
                    after=(run.name,),
                )
                for group in GROUPS
            ),
        ]


def evaluate_run(evaluate: Evaluate, device: str) -> None:
    """Evaluate the policy of a run on a device."""
    replace(evaluate, device=device).run()


def train_run(experiment: "Experiment", name: str, folder: Path, preset: str, device: str) -> None:
    """Train a method on a device, from the checkpoint in its folder if there is one."""
    from pixel2catch.api.calls import run
    from pixel2catch.methods import find_method
    from pixel2catch.workcells import find_workcell

    has_checkpoint = (folder / "checkpoint.pt").exists()
    if not has_checkpoint:
        shutil.rmtree(folder, ignore_errors=True)
    experiment = replace(experiment, train=replace(experiment.train, device=device))
    method = find_method(name, find_workcell(experiment.env.scene.workcell))
    run(experiment, method, folder, resume=has_checkpoint, preset=preset)


def _progress(logs: Mapping[str, Path], total: int, running: list[str]) -> tuple[float, str]:
    """Return how much of the running trainings is done, in all and in words."""
    from pixel2catch.evaluation.comparison import read_metrics

    share, texts = 0.0, list[str]()
    for name in running:
        with suppress(InvalidValueError, IndexError, KeyError):  # no log yet, or its last line is incomplete
            columns = read_metrics(logs[name], ("transitions", "success_rate"))
            done = float(columns["transitions"][-1]) / total
            name = f"{name} {100 * done:.0f} %, S.R. {100 * columns['success_rate'][-1]:.1f} %"
            share += done
        texts.append(name)
    return share, " · ".join(texts)
