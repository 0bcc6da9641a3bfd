"""The definition of the task."""

from dataclasses import dataclass, field, replace
from pathlib import Path

from pixel2catch.camera.camera_file import CameraFile
from pixel2catch.mdp.dynamics_file import DynamicsFile
from pixel2catch.mdp.randomization import RandomizationCfg
from pixel2catch.mdp.sensing import SensingCfg
from pixel2catch.mdp.shaking import ShakeCfg
from pixel2catch.mdp.terminations import EpisodeCfg
from pixel2catch.mdp.throws import ThrowCfg
from pixel2catch.robot.joint_dynamics import JointDynamics
from pixel2catch.robot.objects import SEEN
from pixel2catch.robot.scene import SceneCfg


@dataclass(frozen=True, kw_only=True)
class CatchEnvCfg:
    """Everything that defines the task.

    Attributes:
        scene: What the model is made from.
        dynamics: Dynamics of the joints; those that are not in it are nominal.
        objects: Names of the objects that are thrown.
        throws: Where from and where to.
        randomization: What differs from episode to episode.
        sensing: The camera; noise and delay of camera and encoders.
        shake: How the table shakes.
        episode: When an episode ends.
    """

    scene: SceneCfg = field(default_factory=SceneCfg)
    dynamics: JointDynamics = field(default_factory=JointDynamics.nominal)
    objects: tuple[str, ...] = SEEN
    throws: ThrowCfg = field(default_factory=ThrowCfg)
    randomization: RandomizationCfg = field(default_factory=RandomizationCfg)
    sensing: SensingCfg = field(default_factory=SensingCfg)
    shake: ShakeCfg = field(default_factory=ShakeCfg)
    episode: EpisodeCfg = field(default_factory=EpisodeCfg)

    def with_dynamics(self, file: DynamicsFile) -> "CatchEnvCfg":
        """The task with the joint dynamics of a file, and its ranges for their gains."""
        randomization = replace(self.randomization, gains=file.gains)
        return replace(self, dynamics=file.dynamics, randomization=randomization)

    def with_camera(self, file: CameraFile) -> "CatchEnvCfg":
        """The task seen by the camera of a file: in every episode another one, as it may be.

        Raises:
            InvalidValueError: If its images have another size than those of policies.
        """
        scene, sensing = replace(self.scene, camera=file.camera), replace(self.sensing, camera=file)
        return replace(self, scene=scene, sensing=sensing)

    def with_files(self, dynamics: Path | None, camera: Path | None) -> "CatchEnvCfg":
        """The task with the robot of a dynamics file and the camera of a camera file.

        Args:
            dynamics: The one; the nominal robot if absent.
            camera: The other; the task keeps its camera if absent.

        Raises:
            InvalidValueError: If a file cannot be read, or the camera's images have another size.
        """
        task = self.with_dynamics(DynamicsFile.load(dynamics))
        return task if camera is None else task.with_camera(CameraFile.load(camera))
