"""What twin and rehearsals are told, as the command line takes it; nothing here needs the simulator."""

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

from pixel2catch.checks import AtMostFull, Count, Domain, DynamicsPath, NewFolder, NotNegative, Seed

if TYPE_CHECKING:
    from pixel2catch.envs.cfg import CatchEnvCfg
    from pixel2catch.policy import LoadedPolicy


@dataclass(frozen=True, kw_only=True)
class TaskArgs:
    """What is thrown at which robot."""

    dynamics: DynamicsPath | None = (
        None  #: Dynamics file of the robot that the twin is. Default: the nominal robot.
    )
    #: What is thrown: seen, unseen, real, sizes, names of objects, or several of them.
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
    clock: AtMostFull = 1.0  #: Seconds of the twin in a real one, at most 1; `deploy` must have the same.
    seed: Seed = 0  #: Seed of the room and of all noise; a throw has a seed of its own.


@dataclass(frozen=True, kw_only=True)
class RehearsalCfg:
    """What is rehearsed, and in what time."""

    throws: Count = 10  #: How many throws.
    task: TaskArgs = field(default_factory=TaskArgs)  #: What is thrown at which robot.
    seed: Seed = 0  #: Of the first throw; the next has the next.
    clock: AtMostFull = 1.0  #: Seconds of twin and deployment in a real second, at most 1.
    domain: Domain = 77  #: DDS domain (ROS_DOMAIN_ID), one that nobody else uses.
    lockstep: bool = False  #: One process whose time goes on when it has nothing to do, instead of real time.
    perception_ms: NotNegative = 10.0  #: With --lockstep: least time that perception takes for an image.
    perception_jitter_ms: NotNegative = (
        0.0  #: With --lockstep: how much longer it may take, drawn for each image.
    )
    #: With --lockstep: how much older images are by their stamps than they are; negative: younger.
    clock_error_ms: float = 0.0
    held_seconds: NotNegative = 0.0  #: How long an object is held before a throw, the policy in its run.
    #: With --lockstep: images that show nothing but the object's box; they need no OpenGL.
    plain: bool = False
    #: New folder for a rosbag2 (MCAP) of all that `deploy` saw, decided and commanded.
    record: NewFolder | None = None
