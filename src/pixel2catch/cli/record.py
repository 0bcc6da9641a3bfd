"""`pixel2catch record`: let a robot follow a trajectory, and record what its joints do."""

from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import Positional

from pixel2catch.checks import InputFile, OutputFolder
from pixel2catch.cli.link import Link

if TYPE_CHECKING:
    from pixel2catch.deployment.follower import TrajectoryFollower
    from pixel2catch.identification.recording import Trajectory
    from pixel2catch.ros2.profile import Profile, RobotPart


@dataclass(frozen=True, kw_only=True)
class Record:
    """Let a robot, or its twin, follow a trajectory that `excite` wrote; the recording is for `identify`.

    As with `deploy`, an operator arms and holds the dead-man's switch, and the same servo guards the robot.
    Put the robot near the start pose before; it goes there within the first second.
    """

    trajectory: Positional[Annotated[Path, InputFile()]]  #: File of the trajectory.
    out: Annotated[
        Path, OutputFolder(is_empty=True)
    ]  #: New folder for the rosbag2 (MCAP): joint states and commands as they were on the network.
    link: Link = field(default_factory=Link)  #: How the robot is reached, and how fast it may be.

    def run(self) -> None:
        """Wait for the operator, follow, record."""
        from pixel2catch.cli.console import say
        from pixel2catch.cli.device import prepare
        from pixel2catch.cli.extras import needs_extra
        from pixel2catch.identification.recording import Trajectory

        with needs_extra("deployment"):
            from pixel2catch.deployment.follower import TrajectoryFollower
            from pixel2catch.servo.limits import ServoLimits
        prepare("cpu")
        trajectory, profile = Trajectory.load(self.trajectory), self.link.robot.load()
        profile.require(trajectory.joints)
        with ExitStack() as stack:
            connection = self.link.connect(profile, self.out, "none", stack)
            targets = whole_robot(trajectory)
            follower = TrajectoryFollower(targets, trajectory.duration, ServoLimits.ramp_time, connection)
            say(f"{trajectory.duration:.0f} s of motion; waiting to be armed")
            self._follow(follower)
        if connection.recording:
            connection.recording.require_whole()
        done = "followed to its end" if follower.is_done else "not followed to its end"
        print(f"{self.trajectory}: {done}; wrote {self.out}; several of them are identified with")
        for part in profile.robots:
            options = " ".join(identify_options(profile, part))
            print(f"pixel2catch identify {self.out} ... --out identified-{part.name} {options}")

    def _follow(self, follower: "TrajectoryFollower") -> None:
        """Follow until the end or Ctrl-C, and say when something changes."""
        from pixel2catch.cli.console import say
        from pixel2catch.deployment.status_words import sentence
        from pixel2catch.interruption import StopRequest

        said = ""

        def report(status: dict[str, Any]) -> None:
            nonlocal said
            if (line := sentence(status)) != said:
                said = line
                say(line)

        with StopRequest() as stop:
            follower.run(lambda: stop.is_set, report)


def identify_options(profile: "Profile", part: "RobotPart") -> list[str]:
    """What `identify` must be told of the topics and names of a part of a robot."""
    names = {place: f"{part.name}_{place}" for place in part.held}
    names |= {theirs.index_in_command: theirs.name_in_state for theirs in part.joints.values()}
    order = ",".join(names[place] for place in sorted(names))
    theirs = {ours: joint.name_in_state for ours, joint in part.joints.items()}
    renames = [f"{ours}={name}" for ours, name in theirs.items() if ours != name]
    robot = ["--workcell", profile.workcell, "--robot", part.name]
    topics = ["--joint-states-topic", part.state_topic.name]
    topics += ["--command-topic", f"{part.command_topic.name}={order}"]
    return [*robot, *topics, *(["--rename", *renames] if renames else [])]


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
