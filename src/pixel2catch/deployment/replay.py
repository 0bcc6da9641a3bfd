"""Recorded deployments: their replay, and what a robot measured in a throw.

A replay has recorded images, joint positions and operator, and new decisions.
"""

from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, suppress
from dataclasses import replace
from itertools import pairwise
from math import inf
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pixel2catch.camera.image import Pixels
from pixel2catch.deployment.control_loop import ControlLoop, StepClock, SteppedServo
from pixel2catch.deployment.policy_pipeline import PolicyPipeline
from pixel2catch.deployment.recorder import SERVO, TARGETS, BagRecorder, DeploymentRecorder
from pixel2catch.deployment.statistics import RunStatistics
from pixel2catch.deployment.throw_cycle import FLIGHT, HELD_DISTANCE, HELD_TIME, palm_distance
from pixel2catch.errors import DeploymentError, PerceptionError
from pixel2catch.robots.geometry import WorkcellGeometry
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

GRIP = 0.005
"""Mean distance of the fingers behind their commands [rad] from which the hand holds something.

Source: ours, from the twin: 0.000 in an empty hand, 0.009 or more with an object.
"""
GRIP_FROM, GRIP_TO = 0.5, 1.5  #: Time after the flight in which that is measured [s]. Source: ours.
LINGER, LINGER_TIME = 0.2, 0.08
"""Where a touched object is seen again: distance from the palm [m], time since the nearest [s].

Source: ours, from the twin.
"""
BEFORE = 0.3  #: Time for which a throw is shown before its flight is noticed [s]. Source: ours.
MOST_IMAGES = 90  #: Images that are kept of a throw, the newest.


def played(recording: Path, topics: set[Topic]) -> Iterator[tuple[float, Topic, bytes]]:
    """Yield time since the epoch [s], topic and content of the messages of some topics of a rosbag2.

    JPEG images become raw ones. Damaged ones are left out. Raises as `opened_bag`.
    """
    known = {(topic.name, topic.type): topic for topic in topics}
    with opened_bag(recording) as reader:
        for connection, time, data in reader.messages():
            name, kind = connection.topic, connection.msgtype
            if is_packed := kind == COMPRESSED_IMAGE:
                name, kind = name.removesuffix(SUFFIX), messages.IMAGE
            if topic := known.get((name, kind)):
                with suppress(DeploymentError):
                    yield 1e-9 * time, topic, uncompress(bytes(data)) if is_packed else bytes(data)


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


class _Step(NamedTuple):
    time: float
    status: dict[str, Any]
    command: Command

    @property
    def center(self) -> np.ndarray:
        return np.reshape(self.status["box"], (2, 2)).mean(axis=0)


def measure(
    recording: Path, profile: Profile, camera: CameraSpec
) -> tuple[dict[str, Any], list[tuple[Pixels, list[float] | None]]]:
    """Return what was measured in a recorded throw, and images of its flight with the object's boxes [px].

    Returns:
        `proposed`: caught, reached, dropped, or repeat where nothing flew. `nearest`: smallest distance of
        object and palm, across the line of sight [m]. `is_held`: whether the object stayed at the palm.
        `grip`: median distance of the fingers behind their commands after the flight [rad], which is their
        torque over the stiffness of their servos. `stopped_by`: faults that stopped the robot.
    """
    steps, images = list[_Step](), deque[tuple[float, bytes]](maxlen=MOST_IMAGES)
    command: Command | None = None
    for time, topic, content in played(recording, {profile.camera.image, profile.operator.status, SERVO}):
        if topic == SERVO:
            command = Command.of(messages.read_float_array(content))
        elif topic == profile.operator.status and command:
            steps.append(_Step(time, messages.read_json(content), command))
        elif steps and steps[-1].status.get("cycle") == "throw":
            images.append((time, content))
    throw = [each for each in steps if each.status.get("cycle") == "throw" and each.status["box"]]
    flight = [each for each in throw if np.abs(each.center - throw[0].center).max() > FLIGHT]
    stopped_by = steps[-1].status["stopped_by"] if steps else []
    if not flight:
        return {"proposed": "repeat", "stopped_by": stopped_by}, []
    begin, end, workcell = flight[0].time, flight[-1].time, find_workcell(profile.workcell)
    geometry, hand = WorkcellGeometry(workcell), np.r_[workcell.of_role("hand")]
    distances = np.array(
        [palm_distance(geometry, camera, each.command.joint_pos, each.center) for each in flight]
    )
    times, boxes = np.array([each.time for each in flight]), [each.status["box"] for each in flight]
    is_new = np.array([True, *(one != other for one, other in pairwise(boxes))])
    place = int(np.argmin(np.where(is_new, distances, inf)))
    lingers = is_new & (times > times[place] + LINGER_TIME) & (distances < LINGER)
    errors = [
        np.abs(each.command.joint_pos_command - each.command.joint_pos)[hand].mean()
        for each in steps
        if GRIP_FROM <= each.time - end < GRIP_TO
    ]
    found = {
        "nearest": float(distances[place]),
        "is_held": bool((distances[times > end - 0.75 * HELD_TIME] < HELD_DISTANCE).all()),
        "grip": float(np.median(errors)) if errors else 0.0,
        "stopped_by": stopped_by,
    }
    is_caught = found["is_held"] and found["grip"] > GRIP
    proposed = "caught" if is_caught else "reached" if lingers.any() else "dropped"
    proposed = proposed if found["nearest"] < HELD_DISTANCE else "dropped"
    return {"proposed": proposed, **found}, [
        (messages.read_image(content).pixels, next((s.status["box"] for s in throw if s.time >= time), None))
        for time, content in images
        if time > begin - BEFORE
    ]
