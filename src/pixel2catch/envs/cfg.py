"""The definition of the task."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from math import ceil
from pathlib import Path
from typing import Annotated, Any

from pixel2catch.camera.camera_file import CameraFile
from pixel2catch.checks import NotEmpty, Share
from pixel2catch.errors import InvalidValueError
from pixel2catch.mdp.dynamics_file import DynamicsFile
from pixel2catch.mdp.randomization import RandomizationCfg
from pixel2catch.mdp.sensing import SensingCfg
from pixel2catch.mdp.shaking import ShakeCfg
from pixel2catch.mdp.terminations import EpisodeCfg
from pixel2catch.mdp.throws import ThrowCfg
from pixel2catch.robots.joint_dynamics import JointDynamics
from pixel2catch.robots.workcell import WorkcellSpec
from pixel2catch.scene.objects import SEEN
from pixel2catch.scene.scene import SceneCfg
from pixel2catch.workcells import find_workcell

COMMON_SENSING = ("corner_noise", "edge_noise", "box_scale", "least_visible", "joint_noise", "camera")
"""What of the sensors is not drawn for an episode."""

COMMON_RANDOMIZATION = ("action_noise",)  #: What of the randomization is not drawn for an episode, either.


@dataclass(frozen=True, kw_only=True)
class TaskVariant:
    """Other ranges that hold in a share of the episodes."""

    share: Share  #: The share.
    throws: ThrowCfg  #: Where from and where to.
    randomization: RandomizationCfg  #: What differs from episode to episode.
    #: Noise and delay of the sensors; of these only what is drawn for an episode may differ.
    sensing: SensingCfg

    def of(self, task: "CatchEnvCfg") -> "CatchEnvCfg":
        """The task with these ranges."""
        return replace(task, throws=self.throws, randomization=self.randomization, sensing=self.sensing)


@dataclass(frozen=True, kw_only=True)
class CatchEnvCfg:
    """Everything that defines the task."""

    name: str = "nominal"  #: Name of the task, which its policies keep.
    scene: SceneCfg = field(default_factory=SceneCfg)  #: What the model is made from.
    #: Dynamics of the joints; those that are not in it are nominal, and all if there is none.
    dynamics: JointDynamics | None = None
    objects: Annotated[tuple[str, ...], NotEmpty()] = SEEN  #: Names of the objects that are thrown.
    throws: ThrowCfg = field(default_factory=ThrowCfg)  #: Where from and where to.
    #: What differs from episode to episode.
    randomization: RandomizationCfg = field(default_factory=RandomizationCfg)
    #: The camera; noise and delay of camera and encoders.
    sensing: SensingCfg = field(default_factory=SensingCfg)
    shake: ShakeCfg = field(default_factory=ShakeCfg)  #: How the table shakes.
    episode: EpisodeCfg = field(default_factory=EpisodeCfg)  #: When an episode ends.
    #: Ranges that differ in a share of the episodes each; in the rest the others hold.
    variants: tuple[TaskVariant, ...] = ()
    value_sees_parameters: bool = (
        False  #: Whether value networks also observe what was drawn for the episode.
    )

    def __post_init__(self) -> None:
        """Refuse shares whose sum exceeds 1, and variants of what is not drawn for an episode."""
        if sum(variant.share for variant in self.variants) > 1.0 + 1e-6:
            raise InvalidValueError(
                f"the shares of the variants are {[variant.share for variant in self.variants]}; their sum "
                "must not exceed 1"
            )
        for variant in self.variants:
            for part, names in (("sensing", COMMON_SENSING), ("randomization", COMMON_RANDOMIZATION)):
                for name in names:
                    if getattr(getattr(variant, part), name) != getattr(getattr(self, part), name):
                        raise InvalidValueError(f"{part}.{name} differs in a variant; it must be the task's")

    @property
    def all_variants(self) -> tuple["CatchEnvCfg", ...]:
        """The task itself, and as it is in each of its variants."""
        return (self, *(variant.of(self) for variant in self.variants))

    @property
    def longest_latency(self) -> int:
        """Most whole control steps between image and delivered box."""
        return max(int(each.sensing.latency_steps[1]) for each in self.all_variants)

    @property
    def longest_command_delay(self) -> int:
        """Control steps between a command and its effect at the most, rounded up."""
        return max(ceil(each.randomization.command_delay[1]) for each in self.all_variants)

    def with_dynamics(self, file: DynamicsFile) -> "CatchEnvCfg":
        """The task with the joint dynamics of a file, and its ranges for their gains."""
        task = self._with("randomization", lambda each: replace(each, gains=file.gains))
        return replace(task, dynamics=file.dynamics)

    def for_workcell(self, workcell: WorkcellSpec) -> "CatchEnvCfg":
        """The task with a range of gains for each joint of a work cell.

        Raises:
            InvalidValueError: If it has ranges for another number of joints.
        """
        return self._with("randomization", lambda each: replace(each, gains=each.gains.of(workcell)))

    def _with(self, part: str, change: Callable[[Any], Any]) -> "CatchEnvCfg":
        """The task with another `randomization` or `sensing` in all episodes."""
        variants = tuple(replace(each, **{part: change(getattr(each, part))}) for each in self.variants)
        return replace(self, **{part: change(getattr(self, part))}, variants=variants)

    def with_workcell(self, workcell: WorkcellSpec) -> "CatchEnvCfg":
        """The task of other robots."""
        return replace(self, scene=replace(self.scene, workcell=workcell.name))

    def with_camera(self, file: CameraFile) -> "CatchEnvCfg":
        """The task seen by the camera of a file: in every episode another one, as it may be.

        Raises:
            InvalidValueError: If its images have another size than those of policies.
        """
        return replace(self.with_sensing(camera=file), scene=replace(self.scene, camera=file.camera))

    def with_sensing(self, **changes: Any) -> "CatchEnvCfg":
        """The task with other sensors in all episodes: fields of `SensingCfg`."""
        return self._with("sensing", lambda each: replace(each, **changes))

    def with_longer_hovering(self, steps: int) -> "CatchEnvCfg":
        """The same with objects that hover up to this many control steps longer before they fly."""

        def longer(throws: ThrowCfg) -> ThrowCfg:
            first, last = throws.hover_steps
            return replace(throws, hover_steps=(first, last + steps))

        variants = tuple(replace(variant, throws=longer(variant.throws)) for variant in self.variants)
        return replace(self, throws=longer(self.throws), variants=variants)

    def with_files(self, dynamics: Path | None, camera: Path | None) -> "CatchEnvCfg":
        """Return the task with the robot of a dynamics file and the camera of a camera file.

        Raises:
            InvalidValueError: A file cannot be read, or the camera's images have another size.
        """
        workcell = find_workcell(self.scene.workcell)
        task = self if dynamics is None else self.with_dynamics(DynamicsFile.load(dynamics, workcell))
        return task if camera is None else task.with_camera(CameraFile.load(camera))


def current_fields(task: dict[str, Any]) -> dict[str, Any]:
    """Return the fields of a task that an earlier revision wrote as JSON, as this one names them."""
    if "name" in task:
        return task
    renamed = {name: value for name, value in task.items() if name != "is_value_told"}
    return renamed | {"name": "nominal", "value_sees_parameters": task.get("is_value_told", False)}
