"""`pixel2catch transfer`: policies in the physics of engines that they were not trained in."""

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional

from pixel2catch.checks import NOT_EMPTY, Count, ResultsFolder, Seed, Within
from pixel2catch.cli.fields import TaskOptions
from pixel2catch.errors import InvalidValueError
from pixel2catch.shipped import PolicyPath, policy_folder

if TYPE_CHECKING:
    from pixel2catch.evaluation.stress import Setting

THROWS_AT_ONCE = 20
"""Throws of a round. Source: ours; other engines step them one after the other, so more gain nothing."""
Share = Annotated[float, Within(0.0, 1.0)]


@dataclass(frozen=True, kw_only=True)
class Transfer:
    """Evaluate policies in several physics engines, the same throws in all. The same command continues."""

    #: Folders of policies or training runs, ONNX files, or names of shipped policies. Default:
    #: catch_alone+fit.
    policies: Positional[tuple[PolicyPath, ...]] = ()
    #: Engines: mujoco, physx, drake; the others are compared with the first, the home.
    engines: Annotated[tuple[str, ...], NOT_EMPTY] = ("mujoco", "physx")
    #: Restitutions of the objects; drake has 0 alone. Default: drawn for every throw, from 0 to 0.5, as in
    #: training.
    restitution: tuple[Share, ...] = ()
    throws: Count = 200  #: Throws in each cell: up to 20, or a multiple of 20.
    #: What is thrown: seen, unseen, real, sizes, names of objects, or several of them.
    objects: tuple[str, ...] = ("seen",)
    seed: Seed = 0  #: Seed of everything that is drawn.
    jobs: Count = 1  #: Cells that are computed at once, each in a process with one thread.
    task: TaskOptions = field(default_factory=TaskOptions)  #: Changes of the task.
    out: ResultsFolder = Path("transfer")  #: Folder of the results; other throws need another one.

    def run(self) -> None:
        """Compute what is missing, write the report and print it."""
        from pixel2catch.cli.studies import cpu_slots, evaluate_policies
        from pixel2catch.evaluation.policy_cells import transfer_settings
        from pixel2catch.evaluation.policy_report import transfer_sections
        from pixel2catch.evaluation.protocol import EvaluationCfg
        from pixel2catch.scene.objects import select_objects
        from pixel2catch.sim.factory import require_engine

        for engine in self.engines:
            require_engine(engine)
        at_once = min(self.throws, THROWS_AT_ONCE)
        if self.throws % at_once:
            raise InvalidValueError(
                f"throws is {self.throws}; it must be at most {THROWS_AT_ONCE}, or a multiple of that"
            )
        cfg = EvaluationCfg(
            objects=select_objects(self.objects),
            num_envs=at_once,
            trials=self.throws // at_once,
            seed=self.seed,
        )
        restitutions = tuple(dict.fromkeys(self.restitution))
        settings = transfer_settings(tuple(dict.fromkeys(self.engines)), restitutions)
        settings = tuple(self.task.beneath(each, "transfer") for each in settings)
        policies, slots = self.policies or (policy_folder(None),), cpu_slots(self.jobs, "cpu", (), self.out)

        def home_of(setting: "Setting") -> str:
            return replace(setting, axis=settings[0].axis).name

        evaluate_policies("Transfer", policies, settings, cfg, slots, self.out, home_of, transfer_sections)
