"""Replay of a recorded deployment: recorded images, joint positions and operator, new decisions."""

from collections.abc import Sequence
from contextlib import AbstractContextManager, ExitStack, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, final

import numpy as np

from pixel2catch.deployment.control_loop import ControlLoop, StepClock, SteppedServo, perception_times
from pixel2catch.deployment.policy_pipeline import PolicyPipeline
from pixel2catch.deployment.recorder import SERVO, TARGETS, BagRecorder, DeploymentRecorder
from pixel2catch.deployment.statistics import RunStatistics
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

LONGEST = 3600 * 10**9  #: Longest recording that is replayed [ns]. Source: ours.


@final
class BagPlayer(AbstractContextManager["BagPlayer"]):
    """Publishes some topics of a rosbag2; JPEG images become raw ones. Use it as a context manager."""

    def __init__(self, path: Path, node: Transport, topics: set[Topic]) -> None:
        """Open a recording (a bag's folder, .mcap or .db3 file), and announce its topics.

        Raises:
            PerceptionError: It cannot be read.
        """
        self._publishers = {(topic.name, topic.type): node.publisher(topic) for topic in topics}
        self._bag = ExitStack()
        reader = self._bag.enter_context(opened_bag(path))
        if reader.end_time - reader.start_time > LONGEST:
            raise PerceptionError(f"{path}: lasts longer than an hour; cut it, or correct its times.")
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
        """Publish the messages up to a time since the epoch [s].

        Raises:
            PerceptionError: The rest of the recording cannot be read.
        """
        while self._next is not None and self._next[0] <= until:
            _, name, kind, data = self._next
            with suppress(DeploymentError):  # a damaged message is skipped
                if kind == COMPRESSED_IMAGE:
                    name, kind, data = name.removesuffix(SUFFIX), messages.IMAGE, uncompress(data)
                if (name, kind) in self._publishers:
                    self._publishers[name, kind].publish(data)
            self._next = self._read()

    def _read(self) -> tuple[float, str, str, bytes] | None:
        try:
            message = next(self._messages, None)
        except Exception as error:  # the library raises any error for a damaged bag
            raise PerceptionError(f"the rest of the recording cannot be read ({error}).") from error
        if message is None:
            return None
        connection, time, data = message
        return 1e-9 * time, connection.topic, connection.msgtype, bytes(data)


def replay(
    recording: Path, out: Path, profile: Profile, camera: CameraSpec, pipeline: PolicyPipeline
) -> RunStatistics:
    """Decide again on a recording, and return what happened.

    Args:
        recording: A recording of a deployment, with images.
        out: New folder for the recording of this replay, without images.
        profile: Profile of the recorded deployment.
        camera: Camera of the recorded deployment.
        pipeline: Perception and policy.

    Raises:
        PerceptionError: The recording cannot be read.
        DeploymentError: It has no images of the profile's camera, or `out` exists.
    """
    _require_images(recording, profile)
    with ExitStack() as stack:
        clock, broker = StepClock(lambda moment: run_until(moment)), Broker()
        player = stack.enter_context(BagPlayer(recording, broker.node(clock), played_topics(profile)))
        clock.time = player.start
        node = broker.node(clock)
        recorder = DeploymentRecorder(
            stack.enter_context(BagRecorder(out)), node, profile, clock, images="none"
        )
        limits = ServoLimits.of(find_workcell(profile.workcell))
        setup = ServoSetup(profile=profile, limits=limits, is_dry_run=True)
        servo = SteppedServo(setup, (node, node), clock, recorder)
        stack.callback(servo.close)
        times = perception_times(PERCEPTION_TIME)
        loop = ControlLoop(pipeline, camera, servo.connection, profile, perception_time=times)

        def run_until(moment: float) -> None:
            while clock.time < moment:
                clock.time += limits.dt
                player.play(clock.time)
                servo.tick()
                loop.poll()

        while not player.is_over:
            run_until(clock.time + CONTROL_DT)
        return loop.statistics


PERCEPTION_TIME = 0.01  #: Time that perception takes for an image in a replay [s]. Source: ours.


def played_topics(profile: Profile) -> set[Topic]:
    """Return the topics that a deployment subscribes to."""
    operator, camera = profile.operator, profile.camera
    topics = {operator.arm, operator.dead_man, operator.stop, operator.prompt, camera.image, camera.info}
    return profile.driver_topics | {topic for topic in topics if topic}


def _require_images(recording: Path, profile: Profile) -> None:
    name = profile.camera.image.name
    with opened_bag(recording) as reader:
        topics = sorted({connection.topic for connection in reader.connections})
    if not any(topic.startswith(name) for topic in topics):
        raise DeploymentError(
            f"{recording} has no images on {name}; its topics are {', '.join(topics) or 'none'}: use a "
            "recording of 'deploy --record', and the profile of that deployment."
        )


def recorded_targets(recording: Path) -> list[JointTargets]:
    """Return the first targets for every image of a recording; `image_stamp` is since the epoch [s].

    Raises:
        PerceptionError: It cannot be read.
    """
    first: dict[float, JointTargets] = {}
    offset = 0.0
    with opened_bag(recording) as reader:
        wanted = [each for each in reader.connections if each.topic in (TARGETS.name, SERVO.name)]
        for connection, time, data in reader.messages(wanted):
            row = messages.read_float_array(data)
            if connection.topic == SERVO.name:
                offset = 1e-9 * time - Command.of(row).time
            else:
                targets = JointTargets.of(row)
                stamp = targets.image_stamp
                first.setdefault(stamp, replace(targets, image_stamp=stamp + offset))
    return list(first.values())


def compare(
    then: Sequence[JointTargets], now: Sequence[JointTargets], workcell: WorkcellSpec
) -> dict[str, Any]:
    """Compare the targets of a deployment with those of its replay.

    Returns:
        Numbers of images with targets in the deployment, in the replay and in both; for every joint group,
        such as arm and hand, median and maximum of the difference of its worst joint [rad].
    """
    report: dict[str, Any] = {"num_then": len(then), "num_now": len(now), "num_both": 0}
    if not (then and now):
        return report
    stamps_then, stamps_now = (np.array([each.image_stamp for each in given]) for given in (then, now))
    nearest = np.abs(stamps_now[:, None] - stamps_then).argmin(axis=1)
    is_same = np.abs(stamps_now - stamps_then[nearest]) < 0.25 * CONTROL_DT
    report["num_both"] = int(is_same.sum())
    targets_then, targets_now = (
        np.array([each.joint_pos_target for each in targets]) for targets in (then, now)
    )
    difference = np.abs(targets_now - targets_then[nearest])[is_same]
    for group in workcell.groups if len(difference) else ():
        worst = difference[:, workcell.columns(group.name)].max(axis=1)
        report[group.name] = {"median": float(np.median(worst)), "max": float(worst.max())}
    return report
