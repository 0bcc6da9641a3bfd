"""`pixel2catch train`: learn a policy."""

import dataclasses
import typing
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro
from tyro.conf import Positional

from pixel2catch.learning.config import TrainCfg

if TYPE_CHECKING:
    TrainOptions = TrainCfg
else:
    # The fields of the configuration, each None unless it is given: then the preset decides.
    TrainOptions = dataclasses.make_dataclass(
        "TrainOptions",
        [(name, kind | None, None) for name, kind in typing.get_type_hints(TrainCfg).items()],
        bases=(TrainCfg,),
        namespace={"__post_init__": lambda _: None},
        frozen=True,
        kw_only=True,
    )


@dataclasses.dataclass(frozen=True, kw_only=True)
class Train:
    """Train a policy. What is not given comes from the preset.

    Attributes:
        method: What to train: proposed, without_pf, only_wh, only_center, single_agent, object_position,
            shared_reward, journal, catch, catch_alone or catch_teacher; with a memory METHOD+age, +boxes
            or +fit.
        workcell: The robots: ur5e_allegro, ur5e_leap, fr3_allegro, two_ur5e_allegro, ..., or a Python file
            that defines WORKCELLS; other commands know those of a file by `--import FILE.py`.
        preset: Starting values: fast (a big GPU), cpu (two cores) or paper. Default: fast on CUDA, else cpu.
        out: Folder of the run. Default: runs/METHOD-seedSEED.
        resume: Go on from the last checkpoint in that folder.
        options: What is not as in the preset.
    """

    method: Positional[str] = "proposed"
    workcell: str = "ur5e_allegro"
    preset: Literal["fast", "cpu", "paper"] | None = None
    out: Path | None = None
    resume: bool = False
    options: Annotated[TrainOptions, tyro.conf.arg(name="")] = dataclasses.field(default_factory=TrainOptions)

    def run(self) -> None:
        """Train to the end."""
        from pixel2catch.envs.catch_env import CatchEnv
        from pixel2catch.envs.tasks import find_task
        from pixel2catch.evaluation.loading import load_policy
        from pixel2catch.learning.train import train
        from pixel2catch.methods import find_method
        from pixel2catch.policy import contract_of
        from pixel2catch.workcells import find_workcell

        workcell = find_workcell(self.workcell)
        method, cfg = find_method(self.method, workcell), self.resolve()
        task = find_task(cfg.task).with_workcell(workcell).with_files(cfg.dynamics, cfg.camera)
        scenes = {rate: dataclasses.replace(task.scene, physics_hz=rate) for rate in cfg.physics_hz}
        sensing = dataclasses.replace(task.sensing, latency_steps=cfg.latency_steps)
        contract = contract_of(method, workcell, sensing.camera.camera)
        contract = dataclasses.replace(contract, task=cfg.task)
        teacher = load_policy(cfg.teacher)[1] if cfg.teacher else None

        def make_env(cfg: TrainCfg) -> CatchEnv:
            stage = dataclasses.replace(task, scene=scenes[cfg.physics_hz[0]], sensing=sensing)
            return CatchEnv(
                stage, method, num_envs=cfg.num_envs, device=cfg.device, seed=cfg.seed, teacher=teacher
            )

        out = self.out or Path("runs") / f"{method.name}-seed{cfg.seed}"
        train(cfg, make_env, contract, out, resume=self.resume)

    def resolve(self) -> TrainCfg:
        """Return the preset with what was given on the command line.

        Raises:
            DeviceUnavailableError: If CUDA was asked for and is absent.
            InvalidValueError: If no training is possible with the values.
            PolicyMismatchError: If there is no policy to start from, or to imitate.
        """
        import torch

        from pixel2catch.evaluation.loading import policy_folder
        from pixel2catch.learning.config import preset
        from pixel2catch.sim.devices import require_cuda

        given = {name: value for name, value in vars(self.options).items() if value is not None}
        device = given.setdefault("device", "cuda" if torch.cuda.is_available() else "cpu")
        if device.startswith("cuda"):
            require_cuda(device)
        for name in ("start", "teacher"):
            if name in given:
                given[name] = policy_folder(given[name])
        return preset(self.preset or ("fast" if device.startswith("cuda") else "cpu"), **given)
