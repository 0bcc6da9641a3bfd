"""`pixel2catch record`: let a robot follow a trajectory, and record its joints."""

from contextlib import ExitStack
from dataclasses import dataclass, field
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import Positional

from pixel2catch.checks import DynamicsPath, InputFile, OutputFolder, require_used
from pixel2catch.cli.console import prepare, progress_bar, saying_changes
from pixel2catch.cli.link import Link
from pixel2catch.errors import DeploymentError
from pixel2catch.installation import needs_extra
from pixel2catch.interruption import StopRequest

if TYPE_CHECKING:
    from pixel2catch.deployment.control_loop import Connection
    from pixel2catch.deployment.paths import Motion
    from pixel2catch.identification.recording import Trajectory
    from pixel2catch.ros2.profile import Profile, RobotPart

PATIENCE = 10.0  #: Time for arming a twin in this process, on top of the trajectory [s]. Source: ours.


@dataclass(frozen=True, kw_only=True)
class Record:
    """Let a robot, or its twin, follow a trajectory, and record it.

    As with `deploy`, an operator arms and holds the dead-man's switch, and the same servo guards the robot.
    Put the robot near the start pose first; it moves there within the first second. The exit status is 0 if
    the trajectory was followed to its end and the recording is complete; else the last line says what ended
    it.
    """

    trajectory: Positional[Annotated[Path, InputFile()]]  #: File of the trajectory.
    #: New folder for the rosbag2 (MCAP): joint states and commands as they were on the network.
    out: Annotated[Path, OutputFolder(is_empty=True)]
    link: Link = field(default_factory=Link)  #: The network of the robot, and the limits of its motion.
    #: Dynamics file of a twin in this process that follows instead of a robot: without network, operator,
    #: graphics and real time.
    lockstep: DynamicsPath | None = None

    def run(self) -> None:
        from pixel2catch.identification.recording import Trajectory, parts

        with needs_extra("deployment"):
            from pixel2catch.deployment.follower import follow
            from pixel2catch.servo.status_words import sentence
        require_used(self.link, ("robot", "network", "clock"), self.lockstep is None, "with --lockstep")
        prepare("cpu")
        trajectory = Trajectory.load(self.trajectory)
        profile = self.link.robot.load()
        if self.lockstep:
            with needs_extra("twin"):
                from pixel2catch.twin.lab_node import twin_profile
            profile = twin_profile(trajectory.workcell)
        profile.require(trajectory.joints)
        hear, motion, topic = saying_changes(), whole_robot(trajectory), profile.operator.status
        with ExitStack() as stack:
            connection = self._connect(trajectory, profile, stack)
            clock = connection.clock
            limit = clock.now() + motion.duration + PATIENCE if self.lockstep else inf
            stop, bar = stack.enter_context(StopRequest()), stack.enter_context(progress_bar("trajectory"))

            def report(status: dict[str, Any]) -> None:
                hear(sentence(status))
                if status["done"]:
                    bar.show(status["done"])

            is_done = follow(
                lambda _: motion,
                "trajectory",
                connection,
                topic,
                lambda: stop.is_set or clock.now() > limit,
                report,
            )
        if connection.recording:
            connection.recording.require_whole()
        if not is_done:
            by = stop.by or "a limit of time"
            raise DeploymentError(f"{self.out} ends before {self.trajectory} does, by {by}: record again.")
        print(f"{self.trajectory}: followed to its end; wrote {self.out}. Identify several such recordings:")
        for part in profile.robots:
            if {*part.joints} & {*trajectory.joints}:
                named = parts(trajectory.workcell).items()
                name = next(name for name, joints in named if {*joints} == {*part.joints})
                print(self._next_command(profile, part, name))

    def _connect(self, trajectory: "Trajectory", profile: "Profile", stack: ExitStack) -> "Connection":
        limits = self.link.limits(profile)
        if self.lockstep is None:
            return self.link.connect(profile, limits, stack, self.out)
        from pixel2catch.twin.stepped import recorded_in_step

        return stack.enter_context(recorded_in_step(trajectory.workcell, self.lockstep, limits, self.out))

    def _next_command(self, profile: "Profile", part: "RobotPart", name: str) -> str:
        source = f"--profile {self.link.robot.profile if self.lockstep is None else profile.name}"
        if self.lockstep and profile.name.startswith("twin_of"):  # a profile without a file
            source = f"--workcell {profile.workcell} --command-topic {part.command_topic.name}"
        return f"pixel2catch identify {self.out} ... --robot {name} {source} --out identified-{name}"


def whole_robot(trajectory: "Trajectory") -> "Motion":
    """Return the motion of all joints; those without a trajectory hold the start pose."""
    import numpy as np

    from pixel2catch.deployment.paths import Motion

    joints = trajectory.workcell.joints
    columns = [[joint.name for joint in joints].index(name) for name in trajectory.joints]

    def at(time: float) -> np.ndarray:
        target = np.array([joint.home for joint in joints])
        target[columns] = trajectory.at(np.array([time]))[0]
        return target

    return Motion(at=at, duration=trajectory.duration)
