"""`pixel2catch stress`: policies under disturbances that the paper's training lacks, or in other engines."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from tyro.conf import Positional

from pixel2catch.checks import Count, Device, JobOptions, ResultsFolder, Seed, Share, require_used
from pixel2catch.cli.console import prepare, say
from pixel2catch.cli.fields import SimulatedTask
from pixel2catch.errors import InvalidValueError
from pixel2catch.reports import as_markdown, circumstances
from pixel2catch.shipped import PolicyPath

if TYPE_CHECKING:
    from pixel2catch.evaluation.stress import Setting


@dataclass(frozen=True, kw_only=True)
class Stress:
    """Evaluate policies under disturbances, or in several engines.

    All have the same throws. With --engines each physics engine is compared with the first one, without
    disturbances. The same command continues.
    """

    #: Folders of policies or training runs, ONNX files, or names of shipped policies. Default: all shipped.
    policies: Positional[tuple[PolicyPath, ...]] = ()
    #: Kinds of disturbances, such as nominal camera_position latency together. Default: all.
    axes: tuple[str, ...] = ()
    #: Engines: mujoco, physx, drake. The last two step one throw after the other: 20 throws in a round are
    #: enough.
    engines: tuple[str, ...] = ()
    #: With --engines: restitutions of the objects; drake has 0 alone. Default: drawn for every throw, from 0
    #: to 0.5, as in training.
    restitution: tuple[Share, ...] = ()
    #: What is thrown: seen, unseen, real, sizes, names of objects, or several of them.
    objects: tuple[str, ...] = ("seen",)
    num_envs: Count = 100  #: Throws in a round.
    trials: Count = 2  #: Rounds.
    seed: Seed = 0  #: Seed of everything that is drawn.
    device: Device = "cpu"  #: Where to simulate: cpu, cuda, cuda:1, ...
    jobs: Count = 1  #: Cells that are computed at once on the CPU, each in a process with one thread.
    #: Compute on a SLURM cluster: what each job asks for, as NAME=VALUE with submitit's names, such as
    #: timeout_min=60 cpus_per_task=1 slurm_partition=cpu.
    slurm: JobOptions | None = None
    task: SimulatedTask = field(default_factory=SimulatedTask)  #: What is simulated, before it is disturbed.
    out: ResultsFolder = Path("stress")  #: Folder of the results; other objects need another one.

    def run(self) -> None:
        from pixel2catch.cli.studies import make_slots, run_grid
        from pixel2catch.evaluation import policy_cells as cells
        from pixel2catch.evaluation.grid import StudyGrid
        from pixel2catch.evaluation.loading import load_policy
        from pixel2catch.evaluation.protocol import EvaluationCfg
        from pixel2catch.evaluation.report import write_report
        from pixel2catch.scene.objects import select_objects

        require_used(self, ("axes",), not self.engines, "with --engines")
        require_used(self, ("restitution",), bool(self.engines), "without --engines")
        require_used(self, ("jobs",), not self.slurm, "with --slurm")
        if self.jobs > 1 and self.device != "cpu":
            raise InvalidValueError(f"jobs is {self.jobs} on '{self.device}'; give --jobs 1 or --device cpu")
        device = prepare(self.device, is_here=not self.slurm)
        number = None if self.slurm else self.jobs
        slots = make_slots((device,), number, self.slurm, self.out, has_one_thread=self.jobs > 1)
        settings = self._settings()
        cfg = EvaluationCfg(
            objects=select_objects(self.objects),
            num_envs=self.num_envs,
            trials=self.trials,
            seed=self.seed,
            device=device,
        )
        policies = cells.find_policies(self.policies)
        for each in policies:
            self.task.make(load_policy(each.folder)[0], f"{each.name}: ")
        grid = StudyGrid(cells.policy_cells(policies, settings, self.out, cfg, is_alone=len(slots) == 1))
        run_grid(grid, slots, "transfer" if self.engines else "stress")

        home = settings[0].axis if self.engines else None
        if rows := cells.result_rows(policies, settings, self.out, home):
            sections = (cells.transfer_sections if self.engines else cells.stress_sections)(rows)
            title = "Transfer" if self.engines else "Stress suite"
            print(as_markdown(title, sections), end="", flush=True)
            data = {"results": rows, "circumstances": circumstances()}
            say(f"wrote {self.out}: {write_report(self.out, title, sections, data)}")
        grid.require_whole()

    def _settings(self) -> "tuple[Setting, ...]":
        from pixel2catch.evaluation.policy_cells import transfer_settings
        from pixel2catch.evaluation.stress import select_settings
        from pixel2catch.sim.factory import require_engine

        for engine in self.engines:
            require_engine(engine)
        settings = select_settings(self.axes)
        if self.engines:
            settings = transfer_settings([*dict.fromkeys(self.engines)], [*dict.fromkeys(self.restitution)])
        return tuple(self.task.beneath(each) for each in settings)
