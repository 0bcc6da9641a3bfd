"""`pixel2catch stress`: every policy under what the real world does and the training does not."""

from dataclasses import dataclass, field
from pathlib import Path

from tyro.conf import Positional

from pixel2catch.checks import Count, Device, PhysicsRate, ResultsFolder, Seed
from pixel2catch.cli.console import progress_bar, say
from pixel2catch.cli.device import prepare
from pixel2catch.cli.fields import TaskOptions
from pixel2catch.evaluation.cluster import Cluster
from pixel2catch.files import json_text
from pixel2catch.shipped import PolicyPath


@dataclass(frozen=True, kw_only=True)
class Stress:
    """Evaluate policies under disturbances, the same throws for all. Goes on where it was interrupted."""

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
    #: Policies and settings that are tried at once, each in a process with one thread; on the CPU.
    jobs: Count = 1
    cluster: Cluster = field(default_factory=Cluster)  #: Where the results are computed.
    physics_hz: PhysicsRate = 600.0  #: Physics steps in a second, a multiple of 30.
    task: TaskOptions = field(
        default_factory=TaskOptions
    )  #: What is changed of the task, before it is disturbed.
    out: ResultsFolder = Path("stress")  #: Folder of the results; other objects need another one.
    json: bool = False  #: Print the table as one JSON object.

    def run(self) -> None:
        """Compute what is missing, write the report and print it."""
        from pixel2catch.envs.cfg import CatchEnvCfg
        from pixel2catch.evaluation.protocol import EvaluationCfg
        from pixel2catch.evaluation.stress.measuring import find_policies, measure, plan_results
        from pixel2catch.evaluation.stress.report import as_markdown, make_table, write_report
        from pixel2catch.evaluation.stress.suite import select_settings
        from pixel2catch.scene.objects import select_objects
        from pixel2catch.scene.scene import SceneCfg

        executor = self.cluster.executor(self.out)
        settings = tuple(self.task.beneath(each, "stress") for each in select_settings(self.axes))
        cfg = EvaluationCfg(
            objects=select_objects(self.objects),
            num_envs=self.num_envs,
            trials=self.trials,
            seed=self.seed,
            device=prepare(self.device, is_here=executor is None),
            task=CatchEnvCfg(scene=SceneCfg(physics_hz=self.physics_hz)),
        )
        results = plan_results(find_policies(self.policies), settings, self.out)

        with progress_bar("stress") as bar:
            contents = measure(results, cfg, say, self.jobs, bar.show, executor=executor)
        table = make_table(results, contents)
        print(json_text(table) if self.json else as_markdown(table), end="", flush=True)
        write_report(self.out, table)
        say(f"wrote {self.out}: table.md, table.tex, table.csv, table.json, heatmap.png")
