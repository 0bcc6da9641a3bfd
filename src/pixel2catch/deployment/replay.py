"""A deployment on a recording: what it would have decided of what was seen and measured then.

Nothing moves: the images and joint positions are those of then, whatever is decided now.
"""

import struct
from collections.abc import Callable
from contextlib import ExitStack, closing, suppress
from dataclasses import dataclass
from math import inf
from pathlib import Path
from typing import Any, final

import numpy as np
from jaxtyping import Float

from pixel2catch.deployment.policy_pipeline import PolicyPipeline
from pixel2catch.deployment.recorder import ORDERS, SERVO, BagRecorder, DeploymentRecorder
from pixel2catch.deployment.statistics import RunStatistics
from pixel2catch.deployment.stepped import Nodes, PerceptionTime, StepClock, SteppedDeployment
from pixel2catch.errors import DeploymentError, PerceptionError
from pixel2catch.ros2 import messages
from pixel2catch.ros2.bags import opened_bag
from pixel2catch.ros2.memory import MessageQueue, MessageQueues
from pixel2catch.ros2.messages import CAMERA_INFO, COMPRESSED_IMAGE, IMAGE, JOINT_STATE, SUFFIX, uncompress
from pixel2catch.ros2.profile import Profile
from pixel2catch.ros2.transport import Clock, Message, Publisher, Subscription, Topic, Transport
from pixel2catch.scene.constants import ARM_JOINTS, CONTROL_DT, JOINTS, CameraSpec
from pixel2catch.servo.link import PolicyCommand, ServoStatus
from pixel2catch.servo.process import ServoSetup

STAMPED = (CAMERA_INFO, IMAGE, JOINT_STATE)
"""Types that begin with a header."""


@final
class ReplayTransport(Transport):
    """Plays a rosbag2 in its own time, from the first look on; what is published goes nowhere.

    Headers get the stamps that they would have if all happened now. JPEG images come as the raw ones that
    they were.

    Attributes:
        start: Time of the first message, since the epoch [s].
    """

    def __init__(self, path: Path, clock: Clock) -> None:
        """Open a recording.

        Args:
            path: The bag's folder, or its .mcap or .db3 file.
            clock: Its time.

        Raises:
            PerceptionError: It cannot be read.
        """
        self._clock, self._queues = clock, MessageQueues(clock)
        self._listeners: dict[tuple[str, str], list[MessageQueue]] = {}
        self._bag = ExitStack()
        reader = self._bag.enter_context(opened_bag(path))
        self.start = 1e-9 * reader.start_time
        self._messages = reader.messages()
        self._begin, self._later = inf, 0.0
        self._next = self._read()

    @property
    def is_over(self) -> bool:
        """Whether all messages have come."""
        return self._next is None

    def publisher(self, topic: Topic) -> Publisher:
        """Announce a topic; nobody hears it."""
        del topic
        return _Silence()

    def subscription(self, topic: Topic, depth: int = 1) -> Subscription:
        """Begin to listen to a recorded topic."""
        queue = self._queues.add(depth)
        self._listeners.setdefault((topic.name, topic.type), []).append(queue)
        return _Replayed(queue, self._play)

    def num_other_publishers(self, topic: Topic) -> int:
        """None: the recorded commands are not sent."""
        del topic
        return 0

    def wait(self, seconds: float) -> bool:
        """Wait until a message can be taken, or for a time [s]; say which."""
        end = self._clock.now() + seconds
        self._play()
        while not (has_come := self._queues.wait(0.0)) and self._clock.now() < end:
            self._clock.sleep_until(min(end, self._due))
            self._play()
        return has_come

    def close(self) -> None:
        """Close the recording."""
        self._bag.close()

    @property
    def _due(self) -> float:
        """When the next message comes, `Clock.now` [s]."""
        return inf if self._next is None else self._begin + self._next.time - self.start

    def _play(self) -> None:
        """Let come what is due."""
        now = self._clock.now()
        if self._begin == inf:
            self._begin, self._later = now, self._clock.stamp() - self.start
        while self._next is not None and self._due <= now:
            with suppress(DeploymentError):  # one that is damaged is as lost as on a network
                self._deliver(self._next)
            self._next = self._read()

    def _deliver(self, recorded: "_Recorded") -> None:
        """Bring a message to all that listen."""
        name, kind, data = recorded.name, recorded.type, recorded.data
        if kind == COMPRESSED_IMAGE:
            name, kind = name.removesuffix(SUFFIX), IMAGE
        queues = self._listeners.get((name, kind), ())
        if not queues:
            return
        if recorded.type == COMPRESSED_IMAGE:
            data = uncompress(data)
        if kind in STAMPED:
            data = _shifted(data, self._later)
        for queue in queues:
            queue.put(data)

    def _read(self) -> "_Recorded | None":
        """The next message of the recording."""
        try:
            message = next(self._messages, None)
        except Exception as error:  # a damaged bag makes the library raise whatever it likes
            raise PerceptionError(f"the recording cannot be read further ({error}).") from error
        if message is None:
            return None
        connection, time, data = message
        return _Recorded(name=connection.topic, type=connection.msgtype, time=1e-9 * time, data=bytes(data))


@dataclass(frozen=True, kw_only=True)
class _Recorded:
    """A message of a recording, which came at a time since the epoch [s]."""

    name: str
    type: str
    time: float
    data: bytes


@final
class _Silence(Publisher):
    def publish(self, data: bytes) -> None:
        """Do nothing."""


@final
class _Replayed(Subscription):
    def __init__(self, queue: MessageQueue, play: Callable[[], None]) -> None:
        self._queue, self._play = queue, play

    def take(self) -> list[Message]:
        self._play()
        return self._queue.take()


def _shifted(data: bytes, seconds: float) -> bytes:
    """A message with another stamp in its header, which is the first that is in it."""
    form = "<iI" if data[1] else ">iI"
    sec, nanosec = struct.unpack_from(form, data, 4)
    stamp = sec * 10**9 + nanosec + round(seconds * 1e9)
    changed = bytearray(data)
    struct.pack_into(form, changed, 4, *divmod(stamp, 10**9))
    return bytes(changed)


@dataclass(frozen=True, kw_only=True)
class ReplayCfg:
    """What is replayed.

    Attributes:
        recording: The recording of a deployment, with images.
        out: New folder for the recording of this one, without images.
        profile: The robot of then.
        camera: Its camera.
        perception_time: Time that perception takes for an image [s].
    """

    recording: Path
    out: Path
    profile: Profile
    camera: CameraSpec
    perception_time: float = 0.01


def replay(cfg: ReplayCfg, pipeline: PolicyPipeline) -> RunStatistics:
    """Replay, and return what happened.

    Args:
        cfg: What is replayed.
        pipeline: Perception and policy.

    Raises:
        PerceptionError: The recording cannot be read.
        DeploymentError: It has no images of the robot's camera, or there is something at `out`.
    """
    _require_images(cfg)
    with ExitStack() as stack:
        clock = StepClock(lambda moment: run_until(moment))
        node = stack.enter_context(closing(ReplayTransport(cfg.recording, clock)))
        clock.time = node.start
        recorder = stack.enter_context(BagRecorder(cfg.out))
        recording = DeploymentRecorder(recorder, node, cfg.profile, clock, "none")
        nodes = Nodes(servo=node, loop=node, clock=clock, recording=recording)
        setup = ServoSetup(profile=cfg.profile, is_dry_run=True)
        robot = SteppedDeployment(setup, cfg.camera, nodes, pipeline, PerceptionTime(cfg.perception_time))
        stack.callback(robot.close)

        def run_until(moment: float) -> None:
            while clock.time < moment:
                clock.time += setup.limits.dt
                robot.tick()
                robot.look()

        while not node.is_over:
            run_until(clock.time + CONTROL_DT)
        return robot.control_loop.statistics


def _require_images(cfg: ReplayCfg) -> None:
    name = cfg.profile.camera.image.name
    with opened_bag(cfg.recording) as reader:
        topics = sorted({connection.topic for connection in reader.connections})
    if not any(topic.startswith(name) for topic in topics):
        raise DeploymentError(
            f"{cfg.recording} has no images on {name}, but {', '.join(topics) or 'nothing'}: record with "
            "--record-images jpeg or raw, and replay with the profile of then."
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class RecordedTargets:
    """The policy's targets of a recording.

    Attributes:
        time: When the images were taken that were decided on, since the epoch [s].
        target: Targets in joint order [rad].
    """

    time: Float[np.ndarray, " num_commands"]
    target: Float[np.ndarray, "num_commands num_joints"]


def recorded_targets(recording: Path) -> RecordedTargets:
    """Read what was decided on every image, at first.

    Args:
        recording: A recording of a deployment.

    Raises:
        PerceptionError: It cannot be read.
    """
    policy_command: dict[float, np.ndarray] = {}
    offset = 0.0
    with opened_bag(recording) as reader:
        wanted = [each for each in reader.connections if each.topic in (ORDERS.name, SERVO.name)]
        for connection, time, data in reader.messages(wanted):
            row = messages.read_float_array(data)
            if connection.topic == SERVO.name:
                offset = 1e-9 * time - ServoStatus.of(row).time
            else:
                order = PolicyCommand.of(row)
                policy_command.setdefault(order.image_stamp, np.array([offset, *order.joint_pos_target]))
    rows = np.array(list(policy_command.values())).reshape(-1, 1 + len(JOINTS))
    return RecordedTargets(time=np.array(list(policy_command)) + rows[:, 0], target=rows[:, 1:])


def compare(then: RecordedTargets, now: RecordedTargets) -> dict[str, Any]:
    """How alike two recordings of the same images are.

    Args:
        then: What was decided.
        now: What was decided in a replay.

    Returns:
        Numbers of images that were decided on then, now, and both times; median and largest difference of
        the targets of arm and hand [rad], if there are any of both.
    """
    report: dict[str, Any] = {"num_then": len(then.time), "num_now": len(now.time), "num_both": 0}
    if not (len(then.time) and len(now.time)):
        return report
    nearest = np.abs(now.time[:, None] - then.time).argmin(axis=1)
    is_same = np.abs(now.time - then.time[nearest]) < 0.25 * CONTROL_DT
    report["num_both"] = int(is_same.sum())
    difference = np.abs(now.target - then.target[nearest])[is_same]
    for name, joints in (("arm", slice(0, len(ARM_JOINTS))), ("hand", slice(len(ARM_JOINTS), None))):
        if len(difference):
            worst = difference[:, joints].max(axis=1)
            report[name] = {"median": float(np.median(worst)), "max": float(worst.max())}
    return report
