"""`pixel2catch reproduce`: the paper's table and curves, from nothing."""

import sys
from collections.abc import Mapping
from contextlib import nullcontext
from dataclasses import asdict, dataclass, field, fields
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pixel2catch.checks import Count, Device, PhysicsRate, ResultsFolder, Within
from pixel2catch.circumstances import circumstances
from pixel2catch.cli.console import say
from pixel2catch.errors import InvalidValueError, StudyError, UnknownNameError
from pixel2catch.evaluation.cluster import Cluster
from pixel2catch.interruption import StopRequest

if TYPE_CHECKING:
    from pixel2catch.evaluation.comparison.jobs import Job, Slot
    from pixel2catch.evaluation.comparison.plan import ComparisonFolder, Plan, Run

METHODS = ("without_pf", "only_wh", "only_center", "single_agent", "proposed", "object_position")
"""Methods that are compared, in the order of the paper's table; the last is ours, an oracle."""

PROGRAM = (sys.executable, "-m", "pixel2catch.cli.main")

OWN = ("device", "seed")
"""Fields of a training's configuration that a study sets for each training, or leaves as they are."""

NEUTRAL = ("checkpoint_seconds", "report_seconds", "fuse")  #: Fields of a training that change no result.
JOBS_ON_CUDA = 3  #: Trainings that share a GPU. Source: ours; one does not fill it, see `comparison.jobs`.
JOBS_ON_CLUSTER = 100  #: Trainings or evaluations that a cluster is given at once. Source: ours.

OF_STUDY = (
    *("methods", "seeds", "preset", "transitions", "physics_hz", "training"),
    *("num_envs", "trials", "evaluation_physics_hz"),
)
"""Options that say what a study is; the others say where."""

TRAINING, EVALUATION = "training", "evaluation"


@dataclass(frozen=True, kw_only=True)
class Reproduce:
    """Train and evaluate all methods with several seeds, and write a report: tables, curves, pictures.

    Parts that are finished are not done again, and half-finished trainings go on: to continue after an
    interruption, give the same command. Methods and seeds may be added later.
    """

    methods: tuple[str, ...] = METHODS  #: Methods to compare.
    seeds: Annotated[int, Within(1, 1000)] = 3  #: Trainings of each method.
    #: Settings of the trainings: fast, large, cpu or paper. Default: fast on CUDA, else cpu.
    preset: Literal["fast", "large", "cpu", "paper"] | None = None
    #: Length of a training: control steps, summed over the environments. Default: the preset's.
    transitions: Annotated[int, Within(1)] | None = None
    #: Physics steps in a second of the trainings, one or several. Default: the preset's.
    physics_hz: tuple[PhysicsRate, ...] | None = None
    #: Other options of `pixel2catch train`, as NAME=VALUE, such as num_envs=4096 or
    #: env.sensing.latency_steps=1,3.
    training: tuple[str, ...] = ()
    #: Where to train: cpu, or one or several CUDA devices. Default: cuda where there is one.
    device: tuple[Device, ...] = ()
    #: Trainings and evaluations side by side on a GPU. Default: 3; trainings on a CPU: 1; on a cluster, where
    #: each is a job: 100.
    jobs_per_device: Count | None = None
    cluster: Cluster = field(default_factory=Cluster)  #: Where they run.
    num_envs: Count = 100  #: Throws in a round of an evaluation.
    trials: Count = 10  #: Rounds of an evaluation.
    #: Where to evaluate: cpu, or one or several CUDA devices.
    evaluation_device: tuple[Device, ...] = ("cpu",)
    evaluation_physics_hz: PhysicsRate = 600.0  #: Physics steps in a second of the evaluations.
    out: ResultsFolder = Path("results")  #: Folder of the study.
    report_only: bool = False  #: Train and evaluate nothing; write the report of what is there.

    def run(self) -> None:
        """Do what is left to do, and write the report."""
        from pixel2catch.evaluation.comparison.plan import ComparisonFolder
        from pixel2catch.evaluation.comparison.report import write_report

        self._require_whole_study()
        folder = ComparisonFolder(self.out)
        failures = [] if self.report_only else self._work(folder)
        write_report(folder)
        print((folder.report / "table.md").read_text(encoding="utf-8"), end="")
        say(f"wrote the report: {folder.report / 'README.md'}")
        if failures:
            raise StudyError(
                "\n".join(failures) + "\nthe other parts were done; the same command tries these again."
            )

    def _require_whole_study(self) -> None:
        """Refuse settings that a report alone would ignore."""
        default = Reproduce()
        ignored = [name for name in OF_STUDY if getattr(self, name) != getattr(default, name)]
        if self.report_only and ignored:
            options = ", ".join(f"--{name.replace('_', '-')}" for name in ignored)
            raise InvalidValueError(
                f"--report-only writes the report of the whole study in '{self.out}'; leave out {options}."
            )

    def _work(self, folder: "ComparisonFolder") -> list[str]:
        """Train and evaluate; return what failed."""
        from pixel2catch.cli.comparison_console import ProgressTable
        from pixel2catch.evaluation.comparison.jobs import Runner, Status, last_lines, locked, shared_gpus

        executor = self.cluster.executor(self.out)
        devices = self._devices()
        training = self._training_options(devices[0])
        plan = self._plan(training)
        jobs = [job for run in plan.runs() for job in self._jobs(folder, run, training)]
        self._require_devices(devices, {job.kind for job in jobs if not job.is_done()})
        with locked(folder.path) as lock, nullcontext({}) if executor else shared_gpus() as shared:
            runner = Runner(jobs, self._slots(devices, shared), folder.logs, lock, executor)
            folder.open(plan, [circumstances()] if set(runner.status.values()) != {Status.DONE} else [])
            logs = {run.name: folder.metrics(run) for run in plan.runs()}
            with StopRequest() as stop, ProgressTable(logs, training["transitions"]) as table:
                runner.run(table.show, lambda: stop.is_set)
        if stop.is_set and set(runner.status.values()) != {Status.DONE}:
            raise KeyboardInterrupt
        failed = [name for name, status in runner.status.items() if status is Status.FAILED]
        return [f"{name} failed; {runner.log(name)} ends:\n{last_lines(runner.log(name))}" for name in failed]

    def _devices(self) -> tuple[str, ...]:
        """Where to train."""
        import torch

        return self.device or ("cuda" if torch.cuda.is_available() else "cpu",)

    def _require_devices(self, devices: tuple[str, ...], left: set[str]) -> None:
        """See that there are the CUDA devices that what is left to do needs.

        What a cluster has is seen by its jobs.
        """
        from pixel2catch.sim.factory import require_cuda

        for kind, places in ((TRAINING, devices), (EVALUATION, self.evaluation_device)):
            for device in places if kind in left and self.cluster.is_here else ():
                if device.startswith("cuda"):
                    require_cuda(device)

    def _slots(self, devices: tuple[str, ...], shared: Mapping[str, str]) -> "list[Slot]":
        """Slots of trainings and evaluations, in turn on every device; a CPU does one evaluation at a time.

        With the shared environment variables processes share a GPU.
        """
        from pixel2catch.evaluation.comparison.jobs import Slot

        given, slots = self.jobs_per_device, []
        on_cuda, on_cpu = given or JOBS_ON_CUDA, {TRAINING: given or 1, EVALUATION: 1}
        if not self.cluster.is_here:
            on_cuda = given or JOBS_ON_CLUSTER
            on_cpu = dict.fromkeys(on_cpu, on_cuda)
        for kind, places in ((TRAINING, devices), (EVALUATION, self.evaluation_device)):
            for turn in range(max(on_cuda, *on_cpu.values())):
                for device in places:
                    is_cuda = device.startswith("cuda")
                    if turn < (on_cuda if is_cuda else on_cpu[kind]):
                        environment = {"OMP_NUM_THREADS": "1", **shared} if is_cuda else {}
                        slots.append(Slot(kind=kind, device=device, environment=environment))
        return slots

    def _training_options(self, device: str) -> dict[str, Any]:
        """Return the resolved options of all trainings, except those that the study sets for each.

        The default preset is that for the device.
        """
        from pixel2catch.cli.main import parse
        from pixel2catch.learning.config import GONE, TrainCfg, require_known
        from pixel2catch.scene.scene import SceneCfg

        free = {field.name for field in fields(TrainCfg)} - {"transitions", *OWN}
        # The device decides on the preset alone: it may be a cluster's.
        kind = "fast" if device.startswith("cuda") else "cpu"
        given: dict[str, Any] = {"device": "cpu", "preset": self.preset or kind}
        given |= {"transitions": self.transitions, "physics_stages": self.physics_hz}
        for option in self.training:
            name, _, value = option.partition("=")
            if name not in free and name != "task" and not name.startswith("env."):
                require_known({name} & GONE.keys())
                raise UnknownNameError("option in --training", name, [*sorted(free), "task", "env.FIELD"])
            given[name] = value.split(",")
        given = {name: value for name, value in given.items() if value is not None}
        train = parse(["train", *_options(given)])
        SceneCfg(physics_hz=self.evaluation_physics_hz)
        options = {name: value for name, value in asdict(train.train).items() if name not in OWN}
        env = train.env
        options |= {
            "physics_stages": train.train.physics_stages or (env.scene.physics_hz,),
            "task": env.name,
            "env.scene.cone": env.scene.cone,
            "env.scene.multiccd": env.scene.multiccd,
            "env.sensing.latency_steps": env.sensing.latency_steps,
        }
        fields_of_task = {name: value for name, value in given.items() if name.startswith("env.")}
        return fields_of_task | options | {"env.scene.physics_hz": None}

    def _plan(self, training: dict[str, Any]) -> "Plan":
        """What is asked, with everything that changes results."""
        from pixel2catch.evaluation.comparison.plan import Plan
        from pixel2catch.methods import find_method

        evaluation = {
            "num_envs": self.num_envs,
            "trials": self.trials,
            "device": " ".join(sorted({device.split(":")[0] for device in self.evaluation_device})),
            "physics_hz": self.evaluation_physics_hz,
        }
        return Plan(
            methods=tuple(dict.fromkeys(find_method(name).name for name in self.methods)),
            seeds=self.seeds,
            configuration={
                f"training {n}": value
                for n, value in training.items()
                if n not in NEUTRAL and value is not None
            }
            | {f"evaluation {n}": value for n, value in evaluation.items()},
        )

    def _jobs(self, folder: "ComparisonFolder", run: "Run", training: dict[str, Any]) -> "list[Job]":
        """The training of a run, and the evaluations of its policy."""
        from pixel2catch.evaluation.comparison.jobs import Job
        from pixel2catch.evaluation.comparison.plan import GROUPS

        def train(device: str) -> list[str]:
            options = training | {"seed": run.seed, "device": device, "out": folder.run(run)}
            resume = ["--resume"] if folder.prepare(run) else []
            return [*PROGRAM, "train", run.method, *_options(options), *resume]

        def evaluate(group: str, device: str) -> list[str]:
            options = {"objects": group, "num_envs": self.num_envs, "trials": self.trials, "seed": run.seed}
            options |= {
                "physics_hz": self.evaluation_physics_hz,
                "device": device,
                "out": folder.evaluation(run, group),
            }
            return [*PROGRAM, "evaluate", str(folder.run(run)), *_options(options)]

        def is_evaluated(group: str) -> bool:
            return folder.result(run, group) is not None

        return [
            Job(name=run.name, kind=TRAINING, command=train, is_done=lambda: folder.is_trained(run)),
            *(
                Job(
                    name=f"{run.name}-{group}",
                    kind=EVALUATION,
                    command=partial(evaluate, group),
                    is_done=partial(is_evaluated, group),
                    after=(run.name,),
                )
                for group in GROUPS
            ),
        ]


def _options(options: Mapping[str, Any]) -> list[str]:
    args: list[str] = []
    for name, value in options.items():
        if value is None or value == {}:
            continue
        if isinstance(value, Mapping):
            value = [part for pair in value.items() for part in pair]
        flag = name.replace("_", "-")
        if isinstance(value, bool) and not name.startswith("env."):
            args.append(f"--{flag}" if value else f"--no-{flag}")
            continue
        values = value if isinstance(value, tuple | list) else [value]
        args += [f"--{flag}", *map(str, values)]
    return args
