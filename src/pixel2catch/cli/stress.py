"""`pixel2catch stress`: evaluate policies under disturbances that the paper's training lacks."""

from dataclasses import dataclass, field
from pathlib import Path

from tyro.conf import Positional

from pixel2catch.checks import Count, Device, ResultsFolder, Seed
from pixel2catch.cli.console import prepare
from pixel2catch.cli.fields import TaskOptions
from pixel2catch.errors import InvalidValueError
from pixel2catch.shipped import PolicyPath


@dataclass(frozen=True, kw_only=True)
class Stress:
    """Evaluate policies under disturbances, the same throws for all. The same command continues."""

    #: Folders of policies or training runs, ONNX files, or names of shipped policies. Default: all shipped.
    policies: Positional[tuple[PolicyPath, ...]] = ()
    #: Kinds of disturbances, such as nominal camera_position latency together. Default: all.
    axes: tuple[str, ...] = ()
    #: What is thrown: seen, unseen, real, sizes, names of objects, or several of them.
    objects: tuple[str, ...] = ("seen",)
    num_envs: Count = 100  #: Throws in a round.
    trials: Count = 2  #: Rounds.
    seed: Seed = 0  #: Seed of everything that is drawn.
    device: Device = "cpu"  #: Where to simulate: cpu, cuda, cuda:1, ...
    jobs: Count = 1  #: Cells that are computed at once on the CPU, each in a process with one thread.
    #: Compute on a SLURM cluster: what each job asks for, as NAME=VALUE with submitit's names, such as
    #: timeout_min=60 cpus_per_task=1 slurm_partition=cpu.
    slurm: tuple[str, ...] = ()
    task: TaskOptions = field(default_factory=TaskOptions)  #: Changes of the task before it is disturbed.
    out: ResultsFolder = Path("stress")  #: Folder of the results; other objects need another one.

    def run(self) -> None:
        """Compute what is missing, write the report and print it."""
        from pixel2catch.cli.studies import cpu_slots, evaluate_policies
        from pixel2catch.evaluation.policy_report import stress_sections
        from pixel2catch.evaluation.protocol import EvaluationCfg
        from pixel2catch.evaluation.stress import select_settings
        from pixel2catch.scene.objects import select_objects

        if self.jobs > 1 and self.device != "cpu":
            raise InvalidValueError(f"jobs is {self.jobs} on '{self.device}'; give --jobs 1 or --device cpu")
        device = prepare(self.device, is_here=not self.slurm)
        slots = cpu_slots(self.jobs, device, self.slurm, self.out)
        settings = tuple(self.task.beneath(each, "stress") for each in select_settings(self.axes))
        cfg = EvaluationCfg(
            objects=select_objects(self.objects),
            num_envs=self.num_envs,
            trials=self.trials,
            seed=self.seed,
            device=device,
        )
        evaluate_policies(
            "Stress suite",
            self.policies,
            settings,
            cfg,
            slots,
            self.out,
            lambda _: "nominal",
            stress_sections,
        )
