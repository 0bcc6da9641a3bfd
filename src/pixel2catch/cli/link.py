"""Options of the commands that communicate with a robot, or with its digital twin."""

import json
import os
import re
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from pixel2catch.checks import DynamicsPath, Fraction
from pixel2catch.cli.console import say
from pixel2catch.files import write_atomically
from pixel2catch.ros2.transport import ANY, LOOPBACK, ROS, NetworkName, RealClock, make_transport

if TYPE_CHECKING:
    from pixel2catch.deployment.control_loop import Connection
    from pixel2catch.deployment.recorder import ImageStorage
    from pixel2catch.ros2.profile import Profile
    from pixel2catch.ros2.transport import Clock, Transport
    from pixel2catch.servo.limits import ServoLimits

TWIN = "the digital twin on this machine; for a robot: --network INTERFACE"
REACH = {LOOPBACK: TWIN, ROS: "what ROS 2 reaches", ANY: "everything that DDS reaches"}
NODE = "pixel2catch"  #: Name of the node; the servo's ends in `_servo`.


@dataclass(frozen=True, kw_only=True)
class Robot:
    """The robot."""

    #: Topics and joints of the robot: a shipped profile (ur5e_allegro_v4, ur5e_allegro_v5,
    #: ur5e_allegro_classic, ur5e_leap, fr3_allegro, two_ur5e_allegro) or a .yaml file.
    profile: str = "ur5e_allegro_v4"

    def load(self) -> "Profile":
        """Read the profile."""
        from pixel2catch.ros2.profile import Profile

        return Profile.load(self.profile)

    def write_copy(self, path: Path) -> None:
        """Write a copy of the profile; keep its comments, and set its name to that of the new file."""
        from pixel2catch.ros2.profile import profile_file

        self.load()  # refuses a file that is no profile
        text = profile_file(self.profile).read_text(encoding="utf-8")
        text = re.sub(r"(?m)^name:.*$", lambda _: f"name: {json.dumps(path.stem)}", text, count=1)
        write_atomically({path: text})
        say(f"wrote {path}: change topics and joint names to yours, then run 'deploy --profile {path}'")


@dataclass(frozen=True, kw_only=True)
class Network:
    """The network of a robot and its deployment."""

    robot: Robot = field(default_factory=Robot)  #: The robot.
    #: Network of the robot: an interface of this machine, such as eth0; any for CYCLONEDDS_URI or the choice
    #: of DDS; or ros for the rclpy of a sourced ROS 2. lo is the digital twin on this machine.
    network: NetworkName = LOOPBACK
    clock: Fraction = 1.0  #: Clock seconds in a real second: 1, or the --clock of a digital twin.

    def in_words(self, profile: "Profile") -> str:
        """Return robot, profile, network and clock, as commands and pages begin."""
        reach = REACH.get(self.network, "everything on this interface")
        domain = os.environ.get("ROS_DOMAIN_ID") or 0
        return (
            f"robot {profile.workcell}, profile {profile.name}, network {self.network} ({reach}), "
            f"ROS_DOMAIN_ID {domain}, clock {self.clock:g}"
        )

    @contextmanager
    def join(self, node: str, words: str) -> Iterator[tuple["Transport", "Clock"]]:
        """Join the network as a node of this name; print the words of `in_words`."""
        clock = RealClock(self.clock)
        with make_transport(node, self.network, clock) as transport:
            say(words)
            yield transport, clock

    @property
    def is_twin(self) -> bool:
        """Whether only the digital twin can be reached: DDS on this machine reaches no driver."""
        return self.network == LOOPBACK


@dataclass(frozen=True, kw_only=True)
class Link(Network):
    """The network of a robot, and the limits of its motion."""

    speed: Fraction = 1.0  #: Share of the full speed, up to 1.
    #: Dynamics file of this robot, as `identify` writes it. Without one, commands to a robot are no faster
    #: than its joints, whatever their lag, and no policy catches at full speed; the twin needs none.
    dynamics: DynamicsPath | None = None

    def connect(
        self,
        profile: "Profile",
        limits: "ServoLimits",
        stack: ExitStack,
        record: Path | None = None,
        images: "ImageStorage" = "none",
        *,
        is_dry_run: bool = False,
    ) -> "Connection":
        """Join the network and start the servo process; record into a folder, if there is one.

        The stack ends first the servo, which stops the robot, then the rest.
        """
        from pixel2catch.deployment.control_loop import Connection
        from pixel2catch.deployment.recorder import BagRecorder, DeploymentRecorder
        from pixel2catch.servo.process import ServoSetup, start_servo

        speeds = (f"{part.name} {limits.joint_speed(part.ids):.3g} rad/s" for part in profile.robots)
        words = f"{self.in_words(profile)}; joints up to: {', '.join(speeds)}"
        setup = ServoSetup(profile=profile, limits=limits, is_dry_run=is_dry_run)
        join = partial(make_transport, f"{NODE}_servo", self.network)
        recorder = stack.enter_context(BagRecorder(record)) if record else None
        transport, clock = stack.enter_context(self.join(NODE, words))
        for part in profile.robots:
            say(f"{part.name}: {limits.in_words(part.ids)}")
            if part.notice:
                say(f"{part.name}: {part.notice}")
        recording = DeploymentRecorder(recorder, transport, profile, clock, images) if recorder else None
        servo = stack.enter_context(start_servo(setup, join, self.clock))
        return Connection(
            transport=transport,
            servo=servo,
            clock=clock,
            recording=recording,
            tick=limits.dt,
            robot_words=words,
        )

    def limits(self, profile: "Profile") -> "ServoLimits":
        """Return the servo's limits for this robot; print a note if its dynamics were not identified."""
        from pixel2catch.mdp.dynamics_file import DynamicsFile
        from pixel2catch.robots.joint_dynamics import JointDynamics
        from pixel2catch.servo.limits import JointLimits, ServoLimits
        from pixel2catch.workcells import find_workcell

        workcell = find_workcell(profile.workcell)
        known = DynamicsFile.load(self.dynamics, workcell).dynamics if self.dynamics else None
        if not (known or self.is_twin):
            say("no --dynamics: commands are no faster than the joints; identify the robot to catch")
        joints = JointLimits.of(
            workcell,
            self.speed,
            JointDynamics.of(workcell.joints, known),
            is_identified=self.is_twin or known is not None,
            parts=profile.robots,
        )
        return ServoLimits.of(workcell, joints, profile.robots)
