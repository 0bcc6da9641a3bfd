"""What twin and rehearsals are told, as the command line takes it; nothing here needs the simulator."""

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pixel2catch.envs.cfg import CatchEnvCfg
    from pixel2catch.policy import LoadedPolicy


@dataclass(frozen=True, kw_only=True)
class TaskArgs:
    """What is thrown at which robot."""

    dynamics: Path | None = None  #: Dynamics file of the robot that the twin is. Default: the nominal robot.
    #: What is thrown: seen, unseen, real, names of objects, or several of them.
    objects: tuple[str, ...] = ("seen",)

    def make(self, policy: "LoadedPolicy") -> "CatchEnvCfg":
        """The task in which a policy is to catch."""
        from pixel2catch.evaluation.loading import task_of
        from pixel2catch.scene.objects import select_objects

        return replace(task_of(policy, dynamics=self.dynamics), objects=select_objects(self.objects))


@dataclass(frozen=True, kw_only=True)
class TwinCfg:
    """How the twin runs."""

    task: TaskArgs = field(default_factory=TaskArgs)  #: What is thrown at which robot.
    clock: float = 1.0  #: Seconds of the twin in a real second, at most 1; `deploy` must be given the same.
    seed: int = 0  #: Seed of the room and of all noise; a throw has a seed of its own.


@dataclass(frozen=True, kw_only=True)
class RehearsalCfg:
    """What is rehearsed, and in what time."""

    throws: int = 10  #: How many throws.
    task: TaskArgs = field(default_factory=TaskArgs)  #: What is thrown at which robot.
    seed: int = 0  #: Of the first throw; the next has the next.
    clock: float = 1.0  #: Seconds of twin and deployment in a real second, at most 1.
    domain: int = 77  #: DDS domain (ROS_DOMAIN_ID), one that nobody else uses.
    lockstep: bool = False  #: One process whose time goes on when it has nothing to do, instead of real time.
    perception_ms: float = 10.0  #: With --lockstep: least time that perception takes for an image.
    perception_jitter_ms: float = 0.0  #: With --lockstep: how much longer it may take, drawn for each image.
    #: With --lockstep: how much older images are by their stamps than they are; negative: younger.
    clock_error_ms: float = 0.0
    #: With --lockstep: images that show nothing but the object's box; they need no OpenGL.
    plain: bool = False
    #: New folder for a rosbag2 (MCAP) of all that `deploy` saw, decided and commanded.
    record: Path | None = None
