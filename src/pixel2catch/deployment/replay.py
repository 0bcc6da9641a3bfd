"""Replay of a recorded deployment: recorded images, joint positions and operator, new decisions."""

from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from pixel2catch.deployment.control_loop import ControlLoop, StepClock, SteppedServo
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
from pixel2catch.ros2.transport import Topic
from pixel2catch.scene.constants import CONTROL_DT, CameraSpec
from pixel2catch.servo.limits import ServoLimits
from pixel2catch.servo.link import Command, JointTargets
from pixel2catch.servo.process import ServoSetup
from pixel2catch.workcells import find_workcell

LONGEST = 3600 * 10**9  #: Longest recording that is replayed [ns]. Source: ours.
PERCEPTION_TIME = 0.01  #: Time that perception takes for an image in a replay [s]. Source: ours.


def played(recording: Path, topics: set[Topic]) -> Iterator[tuple[float, Topic, bytes]]:
    """Yield time since the epoch [s], topic and content of the messages of some topics of a rosbag2.

    JPEG images become raw ones. Damaged ones are left out. Raises as `opened_bag`.
    """
    known = {(topic.name, topic.type): topic for topic in topics}
    with opened_bag(recording) as reader:
        for connection, time, data in reader.messages():
            name, kind, content = connection.topic, connection.msgtype, bytes(data)
            if kind == COMPRESSED_IMAGE:
                name, kind = name.removesuffix(SUFFIX), messages.IMAGE
                try:
                    content = uncompress(content)
                except DeploymentError:
                    continue
            if topic := known.get((name, kind)):
                yield 1e-9 * time, topic, content


def replay(
    recording: Path, out: Path, profile: Profile, camera: CameraSpec, pipeline: PolicyPipeline
) -> RunStatistics:
    """Decide again on a recording of a deployment with this profile and camera; return what happened.

    The decisions are recorded into the new folder `out`, without images. Raises PerceptionError for a
    recording that cannot be read, DeploymentError for one without images of the profile's camera.
    """
    clock, broker = StepClock(lambda _: None), Broker()
    clock.time = _begin(recording, profile)
    node, topics = broker.node(clock), played_topics(profile)
    limits = ServoLimits.of(find_workcell(profile.workcell))
    publishers = {topic: broker.node(clock).publisher(topic) for topic in topics}
    with ExitStack() as stack:
        recorder = DeploymentRecorder(
            stack.enter_context(BagRecorder(out)), node, profile, clock, images="none"
        )
        setup = ServoSetup(profile=profile, limits=limits, is_dry_run=True)
        servo = SteppedServo(setup, (node, node), clock, recorder)
        stack.callback(servo.close)
        loop = ControlLoop(
            pipeline, camera, servo.connection, profile, perception_time=lambda: PERCEPTION_TIME
        )

        def run_until(moment: float) -> None:
            while clock.time < moment:
                servo.tick()
                loop.poll()
                clock.time += limits.dt

        for time, topic, content in played(recording, topics):
            run_until(time)
            publishers[topic].publish(content)
        run_until(clock.time + CONTROL_DT)
        return loop.statistics


def played_topics(profile: Profile) -> set[Topic]:
    """Return the topics that a deployment subscribes to."""
    operator, camera = profile.operator, profile.camera
    topics = {operator.arm, operator.dead_man, operator.stop, operator.prompt, camera.image, camera.info}
    return profile.driver_topics | {topic for topic in topics if topic}


def _begin(recording: Path, profile: Profile) -> float:
    """Return the time of the first message since the epoch [s], of a recording that can be replayed."""
    name = profile.camera.image.name
    with opened_bag(recording) as reader:
        topics, begin, end = {each.topic for each in reader.connections}, reader.start_time, reader.end_time
    if end - begin > LONGEST:
        raise PerceptionError(f"{recording}: lasts longer than an hour; cut it, or correct its times.")
    if not any(topic.startswith(name) for topic in topics):
        raise DeploymentError(
            f"{recording} has no images on {name}; its topics are {', '.join(sorted(topics)) or 'none'}: use "
            "a recording of 'deploy --record', and the profile of that deployment."
        )
    return 1e-9 * begin


def recorded_targets(recording: Path) -> list[JointTargets]:
    """Return the first targets for every image of a recording; `image_stamp` is since the epoch [s]."""
    first, offset = dict[float, JointTargets](), 0.0
    for time, topic, content in played(recording, {TARGETS, SERVO}):
        row = messages.read_float_array(content)
        if topic == SERVO:
            offset = time - Command.of(row).time
        else:
            targets = JointTargets.of(row)
            stamp = targets.image_stamp
            first.setdefault(stamp, replace(targets, image_stamp=stamp + offset))
    return list(first.values())


def compare(
    then: Sequence[JointTargets], now: Sequence[JointTargets], workcell: WorkcellSpec
) -> dict[str, Any]:
    """Return the numbers of images with targets in a deployment, in its replay and in both.

    And, for every joint group, median and maximum of the difference of its worst joint [rad].
    """
    differences = list[np.ndarray]()
    for targets in now if then else ():
        before = min(then, key=lambda each: abs(each.image_stamp - targets.image_stamp))
        if abs(before.image_stamp - targets.image_stamp) < 0.25 * CONTROL_DT:
            differences.append(np.abs(before.joint_pos_target - targets.joint_pos_target))
    report: dict[str, Any] = {"num_then": len(then), "num_now": len(now), "num_both": len(differences)}
    for group in workcell.groups if differences else ():
        worst = np.array(differences)[:, workcell.columns(group.name)].max(axis=1)
        report[group.name] = {"median": float(np.median(worst)), "max": float(worst.max())}
    return report
