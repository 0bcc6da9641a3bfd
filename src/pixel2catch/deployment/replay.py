"""A deployment on a recording: what it would have decided of what was seen and measured then.

Nothing moves: the images and joint positions are those of then, whatever is decided now.
"""

from contextlib import AbstractContextManager, ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, final

import numpy as np
from jaxtyping import Float

from pixel2catch.deployment.policy_pipeline import PolicyPipeline
from pixel2catch.deployment.recorder import ORDERS, SERVO, BagRecorder, DeploymentRecorder
from pixel2catch.deployment.statistics import RunStatistics
from pixel2catch.deployment.stepped import StepClock, SteppedLoop, SteppedServo, perception_times
from pixel2catch.errors import DeploymentError, PerceptionError
from pixel2catch.robots.workcell import WorkcellSpec
from pixel2catch.ros2 import messages
from pixel2catch.ros2.bags import opened_bag
from pixel2catch.ros2.memory import Broker
from pixel2catch.ros2.messages import COMPRESSED_IMAGE, SUFFIX, uncompress
from pixel2catch.ros2.profile import Profile
from pixel2catch.ros2.transport import Topic, Transport
from pixel2catch.scene.constants import CONTROL_DT, CameraSpec
from pixel2catch.servo.limits import ServoLimits
from pixel2catch.servo.link import Command, JointTargets
from pixel2catch.servo.process import ServoSetup
from pixel2catch.workcells import find_workcell

LONGEST = 3600 * 10**9  #: Of a recording that is replayed [ns]; each control step is gone through.


@final
class BagPlayer(AbstractContextManager["BagPlayer"]):
    """Publishes a rosbag2 on a network; use it as a context manager. JPEG images go out raw, as they were."""

    def __init__(self, path: Path, node: Transport, topics: set[Topic]) -> None:
        """Announce what is played, and open a recording: the bag's folder, or its .mcap or .db3 file.

        The rest of the recording is passed over.

        Raises:
            PerceptionError: It cannot be read.
        """
        self._publishers = {(topic.name, topic.type): node.publisher(topic) for topic in topics}
        self._bag = ExitStack()
        reader = self._bag.enter_context(opened_bag(path))
        if reader.end_time - reader.start_time > LONGEST:
            raise PerceptionError(f"{path}: lasts longer than an hour; cut it, or mend its times.")
        self.start = 1e-9 * reader.start_time  #: Time of the first message, since the epoch [s].
        self._messages = reader.messages()
        self._next = self._read()

    def __exit__(self, *exception: object) -> None:
        """Close the recording."""
        self._bag.close()

    @property
    def is_over(self) -> bool:
        """Whether all messages have been published."""
        return self._next is None

    def play(self, until: float) -> None:
        """Publish what was recorded up to a time since the epoch [s].

        Raises:
            PerceptionError: The recording cannot be read further.
        """
        while self._next is not None and self._next[0] <= until:
            _, name, kind, data = self._next
            with suppress(DeploymentError):  # one that is damaged is as lost as on a network
                if kind == COMPRESSED_IMAGE:
                    name, kind, data = name.removesuffix(SUFFIX), messages.IMAGE, uncompress(data)
                if (name, kind) in self._publishers:
                    self._publishers[name, kind].publish(data)
            self._next = self._read()

    def _read(self) -> tuple[float, str, str, bytes] | None:
        """Time [s], topic, type and CDR of the next message."""
        try:
            message = next(self._messages, None)
        except Exception as error:  # a damaged bag makes the library raise whatever it likes
            raise PerceptionError(f"the recording cannot be read further ({error}).") from error
        if message is None:
            return None
        connection, time, data = message
        return 1e-9 * time, connection.topic, connection.msgtype, bytes(data)


def replay(
    recording: Path,
    out: Path,
    profile: Profile,
    camera: CameraSpec,
    pipeline: PolicyPipeline,
    perception_time: float = 0.01,
) -> RunStatistics:
    """Replay the recording of a deployment, and return what happened.

    It must have images; out is a new folder for a recording of this deployment, without them. Profile and
    camera are those of then; perception takes so long for an image [s].

    Raises:
        PerceptionError: The recording cannot be read.
        DeploymentError: It has no images of the robot's camera, or there is something at `out`.
    """
    _require_images(recording, profile)
    with ExitStack() as stack:
        clock, broker = StepClock(lambda moment: run_until(moment)), Broker()
        player = stack.enter_context(BagPlayer(recording, broker.node(clock), played_topics(profile)))
        clock.time = player.start
        node = broker.node(clock)
        recorder = stack.enter_context(BagRecorder(out))
        new = DeploymentRecorder(recorder, node, profile, clock, "none")
        limits = ServoLimits.of(find_workcell(profile.workcell))
        setup = ServoSetup(profile=profile, limits=limits, is_dry_run=True)
        servo = SteppedServo(setup, (node, node), clock, new)
        stack.callback(servo.close)
        loop = SteppedLoop(servo, camera, pipeline, perception_times(perception_time))

        def run_until(moment: float) -> None:
            while clock.time < moment:
                clock.time += limits.dt
                player.play(clock.time)
                servo.tick()
                loop.look()

        while not player.is_over:
            run_until(clock.time + CONTROL_DT)
        return loop.statistics


def played_topics(profile: Profile) -> set[Topic]:
    """What a deployment listens to: nobody else commands the robot, and its status is said anew."""
    operator, camera = profile.operator, profile.camera
    topics = {operator.arm, operator.dead_man, operator.stop, operator.prompt, camera.image, camera.info}
    return profile.told | {topic for topic in topics if topic}


def _require_images(recording: Path, profile: Profile) -> None:
    name = profile.camera.image.name
    with opened_bag(recording) as reader:
        topics = sorted({connection.topic for connection in reader.connections})
    if not any(topic.startswith(name) for topic in topics):
        raise DeploymentError(
            f"{recording} has no images on {name}, but {', '.join(topics) or 'nothing'}: record with "
            "--record-images jpeg or raw, and replay with the profile of then."
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class RecordedTargets:
    """The policy's targets of a recording."""

    #: When the images were taken that were decided on, since the epoch [s].
    time: Float[np.ndarray, " num_commands"]
    target: Float[np.ndarray, "num_commands num_joints"]  #: Targets in joint order [rad].


def recorded_targets(recording: Path) -> RecordedTargets:
    """Read what was decided on every image, at first, from a recording of a deployment.

    Raises:
        PerceptionError: It cannot be read.
    """
    targets: dict[float, tuple[float, np.ndarray]] = {}
    offset = 0.0
    with opened_bag(recording) as reader:
        wanted = [each for each in reader.connections if each.topic in (ORDERS.name, SERVO.name)]
        for connection, time, data in reader.messages(wanted):
            row = messages.read_float_array(data)
            if connection.topic == SERVO.name:
                offset = 1e-9 * time - Command.of(row).time
            else:
                order = JointTargets.of(row)
                taken = order.image_stamp
                targets.setdefault(taken, (taken + offset, order.joint_pos_target))
        times, rows = [time for time, _ in targets.values()], [target for _, target in targets.values()]
        return RecordedTargets(time=np.array(times), target=np.array(rows).reshape(len(rows), -1))


def compare(then: RecordedTargets, now: RecordedTargets, workcell: WorkcellSpec) -> dict[str, Any]:
    """How alike a deployment and its replay are.

    Numbers of images that were decided on then, now, and both times; median and largest difference of the
    targets of every joint group, such as arm and hand [rad], if there are any of both.
    """
    report: dict[str, Any] = {"num_then": len(then.time), "num_now": len(now.time), "num_both": 0}
    if not (len(then.time) and len(now.time)):
        return report
    nearest = np.abs(now.time[:, None] - then.time).argmin(axis=1)
    is_same = np.abs(now.time - then.time[nearest]) < 0.25 * CONTROL_DT
    report["num_both"] = int(is_same.sum())
    difference = np.abs(now.target - then.target[nearest])[is_same]
    for group in workcell.groups if len(difference) else ():
        worst = difference[:, workcell.columns(group.name)].max(axis=1)
        report[group.name] = {"median": float(np.median(worst)), "max": float(worst.max())}
    return report
