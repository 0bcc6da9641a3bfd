"""`pixel2catch train`: learn a policy."""

import dataclasses
import os
import typing
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro
from tyro.conf import Positional

from pixel2catch.checks import ResultsFolder
from pixel2catch.cli.fields import FieldOptions, with_fields
from pixel2catch.installation import needs_extra
from pixel2catch.learning.config import CONFIG_FILE, PRESETS, TrainCfg, preset
from pixel2catch.shipped import policy_folder
from pixel2catch.viewer.config import PageCfg

if TYPE_CHECKING:
    TrainOptions = TrainCfg
else:
    # The fields of the configuration, each None unless it is given: then the preset or the run decides.
    OF_TRAIN = {name: Annotated[Any, tyro.conf.Suppress] for name in ("method", "env")}

    def _default(name: str) -> str:
        """What a field is without the option, in help: the preset's, where presets differ.

        The machine decides on the device, and what a factory makes is told otherwise, for it loads much.
        """
        default = TrainCfg.__dataclass_fields__[name].default
        if name == "device" or default in (None, dataclasses.MISSING):
            return ""
        others = {preset: values[name] for preset, values in PRESETS.items() if name in values}
        texts = [_text(default), *(f"{preset}: {_text(value)}" for preset, value in others.items())]
        return f"(default: {'; '.join(texts)})"

    def _text(value: Any) -> str:
        return " ".join(f"{entry:g}" for entry in value) if isinstance(value, tuple) else str(value)

    TrainOptions = dataclasses.make_dataclass(
        "TrainOptions",
        [
            (
                name,
                OF_TRAIN.get(name, Annotated[kind | None, tyro.conf.arg(help_behavior_hint=_default(name))]),
                None,
            )
            for name, kind in typing.get_type_hints(TrainCfg, include_extras=True).items()
        ],
        bases=(TrainCfg,),
        namespace={"__post_init__": lambda _: None},
        frozen=True,
        kw_only=True,
    )


@dataclasses.dataclass(frozen=True, kw_only=True)
class Train:
    """Train a policy. What is not given comes from the preset, or from the run that goes on."""

    #: What to train: proposed, without_pf, only_wh, only_center, single_agent, object_position,
    #: object_extent, shared_reward, agent_per_robot, journal, catch, catch_alone, catch_teacher, or
    #: FILE.py:NAME, a method of your own; with a memory METHOD+age, +boxes, +boxes5 (any number) or +fit.
    #: Default: proposed.
    method: Positional[str | None] = None
    #: The robots: ur5e_allegro, ur5e_leap, fr3_allegro, two_ur5e_allegro, ..., or a Python file that defines
    #: WORKCELLS; other commands know those of a file by `--import FILE.py`. Default: ur5e_allegro.
    workcell: str | None = None
    #: Starting values: fast (a GPU), large (one with much memory, or several), cpu or paper. Default: fast on
    #: CUDA, else cpu.
    preset: Literal["fast", "large", "cpu", "paper"] | None = None
    out: ResultsFolder | None = None  #: Folder of the run. Default: runs/METHOD-seedSEED.
    #: Go on from the last checkpoint in that folder, with its configuration and what is given here.
    resume: bool = False
    web: bool = False  #: Whether to serve a page with curves and with throws of the newest policy.
    page: PageCfg = dataclasses.field(default_factory=PageCfg)  #: Where that page is served.
    #: Any field of the task, also as --env.sensing.latency-steps 1 3. All fields: train --env.help.
    env: FieldOptions = ()
    options: Annotated[TrainOptions, tyro.conf.arg(name="")] = dataclasses.field(default_factory=TrainOptions)

    def run(self) -> None:
        """Train to the end."""
        from pixel2catch.api.training import run
        from pixel2catch.methods import find_method
        from pixel2catch.workcells import find_workcell

        cfg = self.with_task(self.resolve())
        method = find_method(cfg.method, find_workcell(cfg.env.scene.workcell))
        with self._page(cfg):
            result = run(cfg, method, self._folder, resume=self.resume)
        if result.status == "interrupted":
            raise KeyboardInterrupt

    def _page(self, cfg: TrainCfg) -> AbstractContextManager[None]:
        """The page of this training, if there is to be one; of several processes the first has it."""
        if not self.web or os.environ.get("RANK", "0") != "0":
            return nullcontext()

        with needs_extra("viewer"):
            from pixel2catch.viewer.process import page_process
            from pixel2catch.viewer.train import serve_training
        return page_process(serve_training, self.page, self._folder.resolve(), cfg.transitions)

    @property
    def _folder(self) -> Path:
        return self.out or Path("runs") / f"{self.method or TrainCfg.method}-seed{self.options.seed or 0}"

    def resolve(self) -> TrainCfg:
        """Return the preset, or the run's configuration, with what was given on the command line.

        Raises:
            CheckpointError: If the configuration of the run does not fit this code.
            DeviceUnavailableError: If CUDA was asked for and is absent.
            InvalidValueError: If no training is possible with the values.
            PolicyMismatchError: If there is no policy to start from, or to imitate.
        """
        given = {name: value for name, value in vars(self.options).items() if value is not None}
        if self.method:
            given["method"] = self.method
        for name in ("start", "teacher"):
            if name in given:
                given[name] = policy_folder(given[name])
        import torch

        from pixel2catch.sim.factory import require_cuda

        if self.resume and (self._folder / CONFIG_FILE).exists():
            named = PRESETS[self.preset] if self.preset else {}
            cfg = dataclasses.replace(TrainCfg.of_run(self._folder), **named | given)
        else:
            device = given.setdefault("device", "cuda" if torch.cuda.is_available() else "cpu")
            cfg = preset(self.preset or ("fast" if device.startswith("cuda") else "cpu"), **given)
        if cfg.device.startswith("cuda"):
            require_cuda(cfg.device)
        return cfg

    def with_task(self, cfg: TrainCfg) -> TrainCfg:
        """Return a configuration with its environments: the task's, or the run's, with what was given.

        Raises:
            InvalidValueError: If a value is out of range, or a file cannot be read.
            UnknownNameError: If there is no such task, work cell or object.
        """
        from pixel2catch.api.training import with_task

        return with_task(cfg, self.workcell, lambda env: with_fields(env, self.env))
