"""The definition of the task."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from math import ceil
from operator import attrgetter
from pathlib import Path
from typing import Annotated, Any

from pixel2catch.camera.camera_file import CameraFile
from pixel2catch.checks import NOT_EMPTY, Share, require, require_used
from pixel2catch.errors import InvalidValueError
from pixel2catch.mdp.dynamics_file import DynamicsFile
from pixel2catch.mdp.randomization import RandomizationCfg
from pixel2catch.mdp.sensing import SensingCfg
from pixel2catch.mdp.terminations import EpisodeCfg
from pixel2catch.mdp.throws import ThrowCfg
from pixel2catch.robots.joint_dynamics import JointDynamics
from pixel2catch.robots.workcell import WorkcellSpec
from pixel2catch.scene.objects import SEEN
from pixel2catch.scene.scene import SceneCfg
from pixel2catch.workcells import find_workcell

COMMON = (
    *("sensing.corner_noise", "sensing.edge_noise", "sensing.box_scale", "sensing.least_visible"),
    *("sensing.joint_noise", "sensing.camera", "randomization.action_noise"),
)
"""Fields that are not drawn per episode: they are the same in all variants."""


@dataclass(frozen=True, kw_only=True)
class TaskVariant:
    """Ranges that replace those of the task in a share of the episodes."""

    share: Share  #: Share of the episodes.
    throws: ThrowCfg  #: Ranges from which throws are drawn.
    randomization: RandomizationCfg  #: What is drawn for each episode.
    sensing: SensingCfg  #: Noise and delay of the sensors.

    def of(self, task: "CatchEnvCfg") -> "CatchEnvCfg":
        """Return the task with these ranges."""
        own = {"throws": self.throws, "randomization": self.randomization, "sensing": self.sensing}
        return replace(task, **own, variants=())


@dataclass(frozen=True, kw_only=True)
class CatchEnvCfg:
    """Everything that defines the task."""

    name: str = "nominal"  #: Name of the task, which is written into its policies.
    scene: SceneCfg = field(default_factory=SceneCfg)  #: Robots, physics and camera of the model.
    dynamics: JointDynamics | None = None  #: Identified dynamics of joints; others are nominal.
    objects: Annotated[tuple[str, ...], NOT_EMPTY] = SEEN  #: Names of the objects that are thrown.
    throws: ThrowCfg = field(default_factory=ThrowCfg)  #: Ranges from which throws are drawn.
    #: What is drawn for each episode.
    randomization: RandomizationCfg = field(default_factory=RandomizationCfg)
    sensing: SensingCfg = field(default_factory=SensingCfg)  #: Noise and delay of camera and encoders.
    episode: EpisodeCfg = field(default_factory=EpisodeCfg)  #: When an episode ends.
    variants: tuple[TaskVariant, ...] = ()  #: Other ranges, each in a share of the episodes.
    value_sees_parameters: bool = False  #: Whether value networks also observe the drawn parameters.

    def __post_init__(self) -> None:
        require(tuple[TaskVariant, ...], "variants", self.variants)
        require_used(
            self.scene, ("object_friction", "object_restitution"), False, "in a task, which draws it"
        )
        shares = [variant.share for variant in self.variants]
        if sum(shares) > 1.0 + 1e-6:
            raise InvalidValueError(f"the shares of the variants are {shares}; their sum must not exceed 1")
        for variant in self.variants:
            for name in COMMON:
                if attrgetter(name)(variant) != attrgetter(name)(self):
                    raise InvalidValueError(f"{name} differs in a variant; use the task's value")

    @property
    def all_variants(self) -> tuple["CatchEnvCfg", ...]:
        """The task itself, and the task with the ranges of each variant."""
        return (self, *(variant.of(self) for variant in self.variants))

    @property
    def longest_latency(self) -> int:
        """Largest latency between image and delivered box [whole control steps]."""
        return max(int(each.sensing.latency_steps[1]) for each in self.all_variants)

    @property
    def longest_command_delay(self) -> int:
        """Largest delay between a command and its effect, rounded up [control steps]."""
        return max(ceil(each.randomization.command_delay[1]) for each in self.all_variants)

    def with_dynamics(self, file: DynamicsFile) -> "CatchEnvCfg":
        """Return the task with the joint dynamics and the ranges of gains of a file."""
        task = self._with("randomization", lambda each: replace(each, gains=file.gains))
        return replace(task, dynamics=file.dynamics)

    def for_workcell(self, workcell: WorkcellSpec) -> "CatchEnvCfg":
        """Return the task with a range of gains for each joint of a work cell; raise for another number."""
        return self._with("randomization", lambda each: replace(each, gains=each.gains.of(workcell)))

    def _with(self, part: str, change: Callable[[Any], Any]) -> "CatchEnvCfg":
        variants = tuple(replace(each, **{part: change(getattr(each, part))}) for each in self.variants)
        return replace(self, **{part: change(getattr(self, part))}, variants=variants)

    @property
    def trial_steps(self) -> int:
        """Return the control steps in which a throw is decided: 3.0 s, longer if objects hover longer."""
        longest = max(each.throws.hover_steps[1] for each in self.all_variants)
        return EpisodeCfg().max_steps + max(0, longest - ThrowCfg().hover_steps[1])

    def with_workcell(self, workcell: WorkcellSpec) -> "CatchEnvCfg":
        """Return the task with other robots."""
        return replace(self, scene=replace(self.scene, workcell=workcell.name))

    def with_camera(self, file: CameraFile) -> "CatchEnvCfg":
        """Return the task with a calibrated camera; each episode draws it within its uncertainty."""
        task = self.with_sensing(camera=file, any_camera=False)
        return replace(task, scene=replace(self.scene, camera=file.camera))

    def with_sensing(self, **changes: Any) -> "CatchEnvCfg":
        """Return the task with other fields of `SensingCfg` in all variants."""
        return self._with("sensing", lambda each: replace(each, **changes))

    def with_longer_hovering(self, steps: int) -> "CatchEnvCfg":
        """Return the task with objects that hover up to this many control steps longer."""
        return self._with(
            "throws",
            lambda each: replace(each, hover_steps=(each.hover_steps[0], each.hover_steps[1] + steps)),
        )

    def with_files(self, dynamics: Path | None, camera: Path | None) -> "CatchEnvCfg":
        """Return the task with the robot of a dynamics file and the camera of a camera file."""
        workcell = find_workcell(self.scene.workcell)
        task = self if dynamics is None else self.with_dynamics(DynamicsFile.load(dynamics, workcell))
        return task if camera is None else task.with_camera(CameraFile.load(camera))
