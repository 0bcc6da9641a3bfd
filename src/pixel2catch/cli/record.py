"""`pixel2catch record`: let a robot follow a trajectory, and record what its joints do."""

from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import Positional

from pixel2catch.checks import DynamicsPath, InputFile, OutputFolder
from pixel2catch.cli.console import say, saying_changes
from pixel2catch.cli.device import prepare
from pixel2catch.cli.link import Link
from pixel2catch.errors import DeploymentError
from pixel2catch.installation import needs_extra
from pixel2catch.interruption import StopRequest

if TYPE_CHECKING:
    from collections.abc import Callable

    from pixel2catch.deployment.follower import TrajectoryFollower
    from pixel2catch.deployment.recorder import Connection
    from pixel2catch.identification.recording import Trajectory
    from pixel2catch.ros2.profile import Profile, RobotPart


FOLLOWING = {
    "armed": "armed: goes to the start pose.",
    "ramp": "armed: goes to the start pose.",
    "run": "running: follows the trajectory.",
}
"""What is said of modes in which a deployment would speak of its policy."""

PATIENCE = 10.0  #: Time of a twin in this process, beside the motion, after which it was not armed [s].


@dataclass(frozen=True, kw_only=True)
class Record:
    """Let a robot, or its twin, follow a trajectory that `excite` wrote; the recording is for `identify`.

    As with `deploy`, an operator arms and holds the dead-man's switch, and the same servo guards the robot.
    Put the robot near the start pose before; it goes there within the first second. The exit status is 0 if
    the trajectory was followed to its end and the recording is whole; else the last line says what ended it.
    """

    trajectory: Positional[Annotated[Path, InputFile()]]  #: File of the trajectory.
    out: Annotated[
        Path, OutputFolder(is_empty=True)
    ]  #: New folder for the rosbag2 (MCAP): joint states and commands as they were on the network.
    link: Link = field(default_factory=Link)  #: How the robot is reached, and how fast it may be.
    #: Follow with a twin in this process that is the robot of this dynamics file: without a network, an
    #: operator, graphics or real time.
    lockstep: DynamicsPath | None = None

    def run(self) -> None:
        """Wait for the operator, follow, record."""
        from pixel2catch.identification.recording import Trajectory

        with needs_extra("deployment"):
            from pixel2catch.deployment.follower import TrajectoryFollower
            from pixel2catch.servo.limits import ServoLimits
        prepare("cpu")
        trajectory = Trajectory.load(self.trajectory)
        profile = self._profile(trajectory)
        profile.require(trajectory.joints)
        with ExitStack() as stack:
            connection = self._connection(trajectory, profile, stack)
            targets = whole_robot(trajectory)
            follower = TrajectoryFollower(targets, trajectory.duration, ServoLimits.ramp_time, connection)
            say(f"{trajectory.duration:.0f} s of motion; waiting to be armed")
            limit = connection.clock.now() + trajectory.duration + PATIENCE
            is_over = (lambda: connection.clock.now() > limit) if self.lockstep else (lambda: False)
            ended_by = self._follow(follower, is_over)
        if connection.recording:
            connection.recording.require_whole()
        if not follower.is_done:
            by = ended_by or "a limit of time"
            raise DeploymentError(f"{self.out} ends before {self.trajectory} does, by {by}: record anew.")
        print(f"{self.trajectory}: followed to its end; wrote {self.out}. Identify several such recordings:")
        for part in profile.robots:
            if {*part.joints} & {*trajectory.joints}:
                print(self._next_command(profile, part))

    def _next_command(self, profile: "Profile", part: "RobotPart") -> str:
        """How to identify a part of the robot; the twin of another work cell has no profile by a name."""
        words = ["pixel2catch identify", str(self.out), f"... --robot {part.name}"]
        if self.lockstep is None:
            words.append(f"--profile {self.link.robot.profile}")
        elif profile.name != f"twin_of_{profile.workcell}":
            words.append(f"--profile {profile.name}")
        else:
            words.append(
                f"--workcell {profile.workcell} --command-topic {part.command_topic.name}={part.name}"
            )
        return " ".join([*words, f"--out identified-{part.name}"])

    def _profile(self, trajectory: "Trajectory") -> "Profile":
        """The drivers of the robot, or of the twin in this process."""
        if self.lockstep is None:
            return self.link.robot.load()
        with needs_extra("twin"):
            from pixel2catch.twin.lab_node import twin_profile
        return twin_profile(trajectory.workcell)

    def _connection(self, trajectory: "Trajectory", profile: "Profile", stack: ExitStack) -> "Connection":
        """The robot, or the twin in this process, with the servo that guards it."""
        if self.lockstep is None:
            return self.link.connect(profile, self.out, "none", stack)
        from pixel2catch.twin.stepped import recorded_in_step

        limits = self.link.limits(profile)
        twin = recorded_in_step(trajectory.workcell, self.lockstep, limits, self.out)
        return stack.enter_context(twin)

    def _follow(self, follower: "TrajectoryFollower", is_over: "Callable[[], bool]") -> str:
        """Follow until the end, until it is over, or a signal, which is returned; say what changes."""
        hear = saying_changes()
        with StopRequest() as stop:
            follower.run(lambda: stop.is_set or is_over(), lambda status: hear(in_words(status)))
        return stop.by


def in_words(status: dict[str, Any]) -> str:
    """A status in a line, with what it says of the recording."""
    from pixel2catch.servo.status_words import sentence

    words = FOLLOWING.get(status["mode"])
    return " ".join(filter(None, (words, status["message"]))) if words else sentence(status)


def whole_robot(trajectory: "Trajectory"):
    """The targets of all joints by time [rad]; joints that the trajectory leaves out hold the start pose."""
    import numpy as np

    joints = trajectory.workcell.joints
    columns = [[joint.name for joint in joints].index(name) for name in trajectory.joints]
    home = np.array([joint.home for joint in joints])

    def at(time: float) -> np.ndarray:
        target = home.copy()
        target[columns] = trajectory.at(np.array([time]))[0]
        return target

    return at
