"""The definition of the task."""

from dataclasses import dataclass, field, replace

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
        sensing: Noise and delay of camera and encoders.
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
