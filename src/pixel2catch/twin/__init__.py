"""The digital twin of the laboratory: simulated robot, hand, camera and thrower on the topics of real ones.

`SimulatedLab` is physics, throws and scores; `LabNode` connects it and drivers to the topics of a profile.
A rehearsal runs a deployment on it: `rehearsal` as processes in real time, `stepped` in one process.
"""

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Annotated

from pixel2catch.checks import CameraPath, Count, DynamicsPath, Fraction, NewFolder, Seed, Within

if TYPE_CHECKING:
    from pixel2catch.envs.cfg import CatchEnvCfg
    from pixel2catch.policy import Policy


@dataclass(frozen=True, kw_only=True)
class TaskArgs:
    """What is thrown at which robot."""

    dynamics: DynamicsPath | None = None  #: Dynamics file of the simulated robot. Default: the nominal robot.
    #: Camera file of the camera, as `calibrate` writes it. The seed draws the simulated camera within its
    #: uncertainty. Default: the camera that the policy was trained for, known exactly.
    camera: CameraPath | None = None
    #: What is thrown: seen, unseen, real, sizes, names of objects, or several of them.
    objects: tuple[str, ...] = ("seen",)

    def make(self, policy: "Policy", seed: int) -> "CatchEnvCfg":
        """Return the task of a policy; its scene has the true camera, its sensing the calibrated one."""
        from pixel2catch.evaluation.loading import task_of
        from pixel2catch.scene.objects import select_objects

        task = task_of(policy, dynamics=self.dynamics, camera=self.camera)
        scene = replace(task.scene, camera=task.sensing.camera.drawn(seed))
        return replace(task, scene=scene, objects=select_objects(self.objects))


@dataclass(frozen=True, kw_only=True)
class RehearsalCfg:
    """What is rehearsed, and in what time."""

    throws: Count = 10  #: Number of throws.
    task: TaskArgs = field(default_factory=TaskArgs)  #: What is thrown at which robot.
    seed: Seed = 0  #: Seed of the room and of the first throw; the next throw has the next seed.
    clock: Fraction = 1.0  #: Seconds of twin and deployment in a real second, at most 1.
    lockstep: bool = False  #: One process with simulated time, instead of several in real time.
    #: With --lockstep: least time of perception for an image.
    perception_ms: Annotated[float, Within(0.0, 1000.0)] = 10.0
    #: With --lockstep: largest random time on top, for each image.
    perception_jitter_ms: Annotated[float, Within(0.0, 1000.0)] = 0.0
    #: With --lockstep: time by which the stamps of images are too early.
    clock_error_ms: Annotated[float, Within(-1000.0, 1000.0)] = 0.0
    #: Time for which the thrower holds the object while the policy runs [s].
    held_seconds: Annotated[float, Within(0.0, 600.0)] = 0.0
    #: Place of the profile over which the robot releases what it caught; it then returns and waits for the
    #: next throw, without a stop.
    after_catch: str | None = None
    plain: bool = False  #: With --lockstep: images of a red box instead of rendered ones; needs no OpenGL.
    #: New folder for a rosbag2 (MCAP) of what `deploy` received, decided and commanded.
    record: NewFolder | None = None
