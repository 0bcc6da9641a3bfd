"""`pixel2catch train`: learn a policy."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tyro.conf import Fixed, Positional, Suppress

from pixel2catch.checks import CameraPath, DynamicsPath, JobOptions, ResultsFolder, require_valid
from pixel2catch.cli.console import say, suggest
from pixel2catch.cli.fields import TaskFields, given_options
from pixel2catch.errors import InvalidValueError
from pixel2catch.interruption import Terminated
from pixel2catch.learning.config import PRESETS, PresetName, TrainCfg
from pixel2catch.own_files import import_files

if TYPE_CHECKING:
    from pixel2catch.api.calls import Prepared

DRAWN = ("env.throws.", "env.randomization.", "env.sensing.")  #: Options that variants of a task have, too.
METHOD = "proposed"  #: What is trained where no method is named.


@dataclass(frozen=True, kw_only=True)
class Train:
    """Train a policy.

    Options that are not given are those of the preset, or of the run that goes on. The defaults below are
    those of the preset fast; add --preset NAME to see those of another one. --help-all has all options.
    """

    #: What to train, named first: proposed, without_pf, only_wh, only_center, single_agent,
    #: proposed_local_critic, single_agent_local_critic, object_position, object_extent, shared_reward,
    #: agent_per_robot, journal, catch, catch_alone, catch_teacher, or one of your own, with --import FILE.py;
    #: with a memory METHOD+age, +boxes, +boxes5 (1 to 99), +fit or +anycamera.
    method: Positional[str] = METHOD
    #: Starting values: fast (a GPU), large (one with much memory, or several), cpu or paper. Default: fast on
    #: CUDA, large on several GPUs by torchrun, else cpu.
    preset: PresetName | None = None
    #: What is thrown, and what disturbs the robot: nominal, the paper's task; wide, with the disturbances of
    #: laboratories; wide_sharp, the same with boxes to 2 px; people, throws of people before any camera of a
    #: region; or sizes, balls and boxes of 6 to 28 cm. Default: nominal.
    task: str | None = None
    #: The robots: ur5e_allegro, ur5e_leap, fr3_allegro, two_ur5e_allegro, ..., or those of a file of yours
    #: (`--import FILE.py`). Default: ur5e_allegro.
    workcell: str | None = None
    #: Dynamics file of the robot that is simulated, as `identify` writes it; the run keeps its
    #: values. Evaluations take it by their own --dynamics only. Default: the nominal robot.
    dynamics: DynamicsPath | None = None
    #: Camera file of the camera that is simulated, as `calibrate` writes it; the run keeps its values. Every
    #: episode draws pose and focal length within what the file leaves open. Its images must be rectified. A
    #: task that draws cameras has this one instead. Default: the release's camera, known exactly.
    camera: CameraPath | None = None
    out: ResultsFolder | None = None  #: Folder of the run. Default: runs/METHOD-seedSEED.
    #: Train in a job of a SLURM cluster, and wait for its end: what the job asks for, as NAME=VALUE with
    #: submitit's names, such as timeout_min=240 gpus_per_node=1 slurm_partition=gpu; and give --device cuda.
    slurm: JobOptions | None = None
    resume: bool = False  #: Go on from the last checkpoint in that folder, with its configuration.
    train: TrainCfg = field(default_factory=TrainCfg)  #: How the policy learns.
    #: Any field of the task, such as --env.sensing.latency-steps 1 3. All fields: train --env.help.
    env: TaskFields = None
    resumed: Suppress[Fixed[Path | None]] = None  #: Folder of the run whose values are the defaults.

    @classmethod
    def default_for(cls, args: Sequence[str]) -> "Train":
        """Return the command with the values that hold where options are not given."""
        given = {name[2:]: next(iter(values), None) for name, values in given_options(args)}
        if {"--help", "-h", "--help-all"} & {*args}:  # at once, without the task
            return cls(train=PRESETS.get(given.get("preset") or "", TrainCfg()))
        import torch

        from pixel2catch.learning.experiment import preset, preset_for, require_run

        import_files()
        given_files = ((name, given.get(name)) for name in ("dynamics", "camera"))
        files: dict[str, Any] = {name: Path(file) for name, file in given_files if file}
        require_valid(cls(**files))
        method = args[0] if args and not args[0].startswith("-") else None
        name: Any
        folder = Path(given.get("out") or _folder(method or METHOD, given.get("seed") or 0))
        if "resume" in given:
            names: Any = {name: given.get(name) for name in ("preset", "task", "workcell")}
            run = require_run(folder, **files, method=method, **names)
            experiment, method, name = run.experiment, run.method, run.preset
        else:
            device = given.get("device") or ("cuda" if torch.cuda.is_available() else "cpu")
            name = given.get("preset") or preset_for(device)
            start = {"start": Path(file)} if (file := given.get("start")) else {}
            task, cell = given.get("task"), given.get("workcell")
            task = "nominal" if task is None else task
            experiment = preset(name, task, workcell=cell, device=device, **start, **files)
        for one, other in (("workcell", "env.scene.workcell"), ("physics-stages", "env.scene.physics-hz")):
            if {one, other} <= given.keys():
                raise InvalidValueError(f"give --{one} or --{other}, not both.")
        for option in (each for each in given if each.startswith(DRAWN)):
            others = (f"env.variants.{i}{option[3:]}" for i in range(len(experiment.env.variants)))
            if left := [each for each in others if each not in given]:
                say(f"--{option} leaves out {len(left)} variants of the task; for all, add --{left[0]} ...")
        if "env.scene.physics-hz" in given:  # one rate throughout
            experiment = replace(experiment, train=replace(experiment.train, physics_stages=()))
        resumed = folder if "resume" in given else None
        method, train, env = method or METHOD, experiment.train, experiment.env
        return cls(method=method, preset=name, train=train, env=env, resumed=resumed)

    def prepared(self) -> "Prepared":
        """Return what the training needs; raise what is wrong with the options."""
        from pixel2catch.api.calls import prepared
        from pixel2catch.learning.experiment import Experiment

        return prepared(Experiment(env=self.env, train=self.train), self.method, resume=self.resume)

    def run(self) -> None:
        from pixel2catch.api.calls import run
        from pixel2catch.sim.factory import require_cuda

        folder = self.out or _folder(self.method, self.train.seed)
        if self.resume and folder != self.resumed:
            raise InvalidValueError("the run to resume is not clear; name its folder by --out.")
        if self.train.device.startswith("cuda") and not self.slurm:  # a job looks for itself
            require_cuda(self.train.device)
        training = self.prepared()
        if self.slurm:
            self._submit(folder)
            return
        result = run(training, folder, resume=self.resume, preset=self.preset)
        if result.status == "interrupted":
            raise KeyboardInterrupt if result.stopped_by == "SIGINT" else Terminated
        suggest("evaluate", folder)

    def _submit(self, folder: Path) -> None:
        """Train in a job of a cluster, and wait for its end."""
        from pixel2catch.cli.studies import make_slots, run_grid
        from pixel2catch.errors import StudyError
        from pixel2catch.evaluation.grid import StudyCell, StudyGrid, read_row
        from pixel2catch.learning.checkpoint import RunFolder

        slots = make_slots((self.train.device,), 1, self.slurm, folder)
        with RunFolder(folder).open(resume=self.resume):
            pass  # it can be used
        summary, log = folder / "summary.json", folder / "logs" / f"{folder.name}.log"
        work, before = partial(train_on, replace(self, slurm=None)), read_row(summary)

        def is_done() -> bool:
            row = read_row(summary) or {}
            return row != before and row.get("status") == "finished"

        grid = StudyGrid([StudyCell(name=folder.name, work=work, is_done=is_done)])
        say(f"run folder: {folder}; log: {log}; if it is stopped, add --resume")
        run_grid(grid, slots, "train", log.parent)
        if grid.errors:
            raise StudyError(f"the job failed: {grid.errors[folder.name]} Log: '{log}'.")
        suggest("evaluate", folder)


def train_on(train: Train, device: str) -> None:
    """Train on a device; a training that is stopped in order raises nothing."""
    with suppress(KeyboardInterrupt):
        replace(train, train=replace(train.train, device=device)).run()


def _folder(method: str, seed: int | str) -> Path:
    return Path("runs") / f"{method}-seed{seed}"
