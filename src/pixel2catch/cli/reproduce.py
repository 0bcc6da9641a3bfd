"""`pixel2catch reproduce`: the paper's table and curves, from nothing."""

from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from pixel2catch.checks import Count, Device, ResultsFolder, Within
from pixel2catch.errors import UnknownNameError
from pixel2catch.learning.config import PresetName, TrainCfg

if TYPE_CHECKING:
    from pixel2catch.learning.experiment import Experiment

METHODS = ("without_pf", "only_wh", "only_center", "single_agent", "proposed", "object_position")
"""Methods that are compared, in the order of the paper's table; the last is ours, an oracle."""

OWN = ("device", "seed")  #: Fields of `TrainCfg` that a study sets for each training.
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
    preset: PresetName | None = None
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
        from pixel2catch.cli.studies import compare_methods

        compare_methods(self, self._experiment())

    @property
    def places(self) -> dict[str, tuple[str, ...]]:
        """Where to train and where to evaluate."""
        import torch

        default = "cuda" if torch.cuda.is_available() else "cpu"
        return {TRAINING: self.device or (default,), EVALUATION: self.evaluation_device}

    @property
    def starting_preset(self) -> str:
        """The preset; without one the device decides, which may be a cluster's."""
        return self.preset or ("fast" if self.places[TRAINING][0].startswith("cuda") else "cpu")

    def _experiment(self) -> "Experiment":
        """Return the configuration of all trainings; seed and device are replaced in each."""
        from pixel2catch.cli.main import parse_options
        from pixel2catch.learning.experiment import Experiment

        free = {field.name for field in fields(TrainCfg)} - {*OWN}
        args = ["--device", "cpu", "--preset", self.starting_preset]
        for option in self.training:
            name, _, value = option.partition("=")
            if name not in free and name != "task" and not name.startswith("env."):
                raise UnknownNameError("option in --training", name, [*sorted(free), "task", "env.FIELD"])
            args += [f"--{name.replace('_', '-')}", *value.split(",")]
        train = parse_options("train", args)
        return Experiment(env=train.env, train=train.train)
