"""`pixel2catch reproduce`: the paper's table and curves, from nothing."""

import shutil
from collections.abc import Iterator
from dataclasses import asdict, dataclass, fields, replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import UseAppendAction

from pixel2catch.checks import NOT_EMPTY, Count, Device, JobOptions, ResultsFolder, Within
from pixel2catch.cli.console import say
from pixel2catch.cli.evaluate import Evaluate
from pixel2catch.cli.train import METHOD, Train, train_on
from pixel2catch.errors import InvalidValueError, UnknownNameError
from pixel2catch.learning.config import PRESETS, PresetName, TrainCfg
from pixel2catch.reports import circumstances, markdown

if TYPE_CHECKING:
    from pixel2catch.evaluation.comparison import ComparisonFolder, Plan, Training
    from pixel2catch.evaluation.grid import Json, Slot, StudyCell

METHODS = ("without_pf", "only_wh", "only_center", "single_agent", "proposed", "object_position")
"""Methods that are compared, in the order of the paper's table; the last is ours, an oracle."""

OWN = ("device", "seed")  #: Fields of `TrainCfg` that a study sets for each training.
NEUTRAL = ("checkpoint_seconds", "report_seconds", "fuse")  #: Fields of a training that change no result.
JOBS_ON_CUDA = 3  #: Trainings that share a GPU. Source: ours; one does not fill it.
TRAINING, EVALUATION = "training", "evaluation"

Settings = tuple[str, ...]  #: Options of trainings, as NAME=VALUE.


@dataclass(frozen=True, kw_only=True)
class Reproduce:
    """Train and evaluate methods with several seeds; write a report.

    Finished parts are not computed again, and interrupted trainings continue: give the same command. Methods
    and seeds may be added later.
    """

    methods: Annotated[tuple[str, ...], NOT_EMPTY] = METHODS  #: Methods to compare.
    seeds: Annotated[int, Within(1, 1000)] = 3  #: Trainings of each method.
    #: Settings of the trainings: fast, large, cpu or paper. Default: fast on CUDA, else cpu.
    preset: PresetName | None = None
    #: Other options of `pixel2catch train`, as NAME=VALUE, such as transitions=50_000_000 num_envs=4096 or
    #: env.sensing.latency_steps=1,3.
    training: tuple[str, ...] = ()
    #: Values to compare of such an option, such as --sweep learning_rate 3e-4 1e-3. Given again, with
    #: another option: each method is trained with each combination, which has rows of its own.
    sweep: UseAppendAction[tuple[tuple[str, ...], ...]] = ()
    #: Where to train: cpu, or one or several CUDA devices. Default: cuda where there is one.
    device: tuple[Device, ...] = ()
    #: Trainings and evaluations side by side on a GPU, which is faster where NVIDIA's Multi-Process Service
    #: runs (nvidia-cuda-mps-control -d). Default: 3; trainings on a CPU: 1; on a cluster, where each is a
    #: job: 100.
    jobs_per_device: Count | None = None
    #: Compute on a SLURM cluster: what each job asks for, as NAME=VALUE with submitit's names, such as
    #: timeout_min=240 cpus_per_task=4 gpus_per_node=1 slurm_partition=gpu.
    slurm: JobOptions | None = None
    num_envs: Count = 100  #: Throws in a round of an evaluation.
    trials: Count = 10  #: Rounds of an evaluation.
    #: Where to evaluate: cpu, or one or several CUDA devices.
    evaluation_device: Annotated[tuple[Device, ...], NOT_EMPTY] = ("cpu",)
    out: ResultsFolder = Path("results")  #: Folder of the study.

    def run(self) -> None:
        from pixel2catch.cli.studies import run_grid
        from pixel2catch.evaluation.comparison import ComparisonFolder, write_comparison
        from pixel2catch.evaluation.grid import StudyGrid, held
        from pixel2catch.sim.factory import require_cuda

        folder, commands = ComparisonFolder(self.out), self._commands()
        plan = self._plan(commands)
        grid = StudyGrid([cell for each in plan.runs() for cell in self._cells(folder, each, commands)])
        for device in {place for cell in grid.missing for place in self._places[cell.kind]}:
            if device != "cpu" and not self.slurm:  # jobs of a cluster look for themselves
                require_cuda(device)
        slots = [slot for kind in self._places for slot in self._slots(kind)]
        folder.path.mkdir(parents=True, exist_ok=True)
        with held(folder.path):
            folder.open(replace(plan, sessions=(circumstances(),)) if grid.missing else plan)
            run_grid(grid, slots, "reproduce", folder.path / "logs")
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

    def _slots(self, kind: str) -> "list[Slot]":
        """Return slots of trainings or evaluations; on a CPU one evaluation has all cores."""
        from pixel2catch.cli.studies import make_slots

        devices, number, is_evaluation = self._places[kind], self.jobs_per_device, kind == EVALUATION
        is_cpu = devices[0] == "cpu"
        if not self.slurm:
            number = 1 if is_cpu and is_evaluation else number or (1 if is_cpu else JOBS_ON_CUDA)
        options = {"kind": kind, "has_one_thread": not is_cpu, "is_reused": is_evaluation}
        return make_slots(devices, number, self.slurm, self.out, **options)

    def _commands(self) -> dict[Settings, Train]:
        """Return the command of the trainings of each combination of the sweeps."""
        if any(len(each) < 3 for each in self.sweep):
            raise InvalidValueError("--sweep needs a name and two values: --sweep learning_rate 3e-4 1e-3.")
        options = [[f"{_field(n)}={','.join(v.split())}" for v in values] for n, *values in self.sweep]
        settings = [*product(*options)]
        commands = [self._train(each) for each in settings]
        if twice := [each for n, each in enumerate(settings) if commands[n] in commands[:n]]:
            raise InvalidValueError(f"--sweep has {' '.join(twice[0])} twice; leave one out.")
        return dict(zip(settings, commands, strict=True))

    def _train(self, settings: Settings) -> Train:
        """Return the command of trainings; the device decides on the preset if none is given."""
        from pixel2catch.cli.main import parse_options
        from pixel2catch.learning.experiment import preset_for

        free = {field.name for field in fields(TrainCfg)} - {*OWN}
        preset, flags = self.preset or preset_for(self._places[TRAINING][0]), dict[str, bool]()
        args = [METHOD, "--device", "cpu", "--preset", preset]
        for option in (*self.training, *settings):
            name, _, value = option.partition("=")
            name = _field(name)
            if name not in free and name != "task" and not name.startswith("env."):
                raise UnknownNameError("option of the trainings", name, [*sorted(free), "task", "env.FIELD"])
            if (flag := f"--{name.replace('_', '-')}") in args or name in flags:
                raise InvalidValueError(f"'{name}' is given twice; leave out one of them.")
            if not isinstance(getattr(PRESETS[preset], name, None), bool):
                args += [flag, *value.split(",")]
            elif value in ("True", "False"):
                flags[name] = value == "True"
            else:
                raise InvalidValueError(f"{name} is '{value}'; it must be True or False.")
        command = parse_options("train", args)
        return replace(command, train=replace(command.train, **flags))

    def _configuration(self, command: Train) -> "Json":
        """Return everything of trainings that changes results, by name."""
        train, env = command.train, command.env
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
        return {f"training {name}": value for name, value in options.items() if value is not None}

    def _plan(self, commands: dict[Settings, Train]) -> "Plan":
        """Return methods and seeds, with everything that changes results and is the same for all."""
        from pixel2catch.evaluation.comparison import EVALUATION_SEED, Plan
        from pixel2catch.evaluation.loading import PHYSICS_HZ
        from pixel2catch.methods import find_method

        first, *others = map(self._configuration, commands.values())
        methods = dict.fromkeys(find_method(name).name for name in self.methods)
        for method, command in product(methods, commands.values()):
            replace(command, method=method).prepared()
        evaluation = {
            "num_envs": self.num_envs,
            "trials": self.trials,
            "seed": EVALUATION_SEED,
            "device": " ".join(sorted({device.split(":")[0] for device in self.evaluation_device})),
            "physics_hz": PHYSICS_HZ,
        }
        return Plan(
            methods=tuple(" ".join((method, *settings)) for method in methods for settings in commands),
            seeds=self.seeds,
            configuration={n: v for n, v in first.items() if all(each.get(n) == v for each in others)}
            | {f"evaluation {name}": value for name, value in evaluation.items()},
        )

    def _cells(
        self, folder: "ComparisonFolder", run: "Training", commands: dict[Settings, Train]
    ) -> "Iterator[StudyCell]":
        """Yield the training of a run, and the evaluations of its policy."""
        from pixel2catch.evaluation.comparison import EVALUATION_SEED, GROUPS
        from pixel2catch.evaluation.grid import StudyCell

        method, *settings = run.method.split()
        command = commands[tuple(settings)]
        cfg = replace(command.train, seed=run.seed)
        train = replace(command, method=method, out=folder.run(run), train=cfg)
        yield StudyCell(
            name=run.name,
            kind=TRAINING,
            work=partial(train_run, train, folder.run(run)),
            is_done=lambda: folder.is_trained(run),
        )
        evaluate = Evaluate(policy=folder.run(run), num_envs=self.num_envs, trials=self.trials)
        evaluate = replace(evaluate, seed=EVALUATION_SEED + run.seed)
        for group in GROUPS:
            of_group = replace(evaluate, objects=(group,), out=folder.evaluation(run, group))
            yield StudyCell(
                name=f"{run.name}-{group}",
                kind=EVALUATION,
                work=partial(evaluate_run, of_group),
                is_done=lambda group=group: folder.result(run, group) is not None,
                after=(run.name,),
            )


def _field(option: str) -> str:
    return option.removeprefix("train.").replace("-", "_")


def evaluate_run(evaluate: Evaluate, device: str) -> None:
    """Evaluate the policy of a run on a device."""
    replace(evaluate, device=device).run()


def train_run(train: Train, folder: Path, device: str) -> None:
    """Train on a device, from the checkpoint in the folder of the run if there is one."""
    has_checkpoint = (folder / "checkpoint.pt").exists()
    if not has_checkpoint:
        shutil.rmtree(folder, ignore_errors=True)
    train_on(replace(train, resume=has_checkpoint, resumed=folder if has_checkpoint else None), device)
