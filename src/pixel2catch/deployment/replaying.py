"""A deployment on a recording: what it would have decided of what was seen and measured then.

Nothing moves: the images and joint positions are those of then, whatever is decided now.
"""

from contextlib import ExitStack, closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from pixel2catch.deployment import messages
from pixel2catch.deployment.bag import ReplayTransport
from pixel2catch.deployment.brain import Brain
from pixel2catch.deployment.profile import Profile
from pixel2catch.deployment.recorder import Recorder
from pixel2catch.deployment.report import Diary
from pixel2catch.deployment.servo_link import Decision, Orders
from pixel2catch.deployment.servo_process import ServoSetup
from pixel2catch.deployment.stepwise import Nodes, PerceptionTime, StepClock, Stepwise
from pixel2catch.deployment.tape import ORDERS, SERVO, Tape
from pixel2catch.errors import DeploymentError
from pixel2catch.perception.rosbag_images import opened_bag
from pixel2catch.robot.constants import ARM_JOINTS, CONTROL_DT, JOINTS, CameraSpec


@dataclass(frozen=True, kw_only=True)
class ReplayCfg:
    """What is replayed.

    Attributes:
        tape: The recording of a deployment, with images.
        out: New folder for the recording of this one, without images.
        profile: The robot of then.
        camera: Its camera.
        perception_time: Time that perception takes for an image [s].
    """

    tape: Path
    out: Path
    profile: Profile
    camera: CameraSpec
    perception_time: float = 0.01


def replay(cfg: ReplayCfg, brain: Brain) -> Diary:
    """Replay, and return what happened.

    Args:
        cfg: What is replayed.
        brain: Perception and policy.

    Raises:
        PerceptionError: The recording cannot be read.
        DeploymentError: It has no images of the robot's camera, or there is something at `out`.
    """
    _require_images(cfg)
    with ExitStack() as stack:
        clock = StepClock(lambda moment: run_until(moment))
        node = stack.enter_context(closing(ReplayTransport(cfg.tape, clock)))
        clock.time = node.start
        recorder = stack.enter_context(Recorder(cfg.out))
        tape = Tape(recorder, node, cfg.profile, clock, "none")
        nodes = Nodes(servo=node, brain=node, clock=clock, tape=tape)
        setup = ServoSetup(profile=cfg.profile, is_dry_run=True)
        robot = Stepwise(setup, cfg.camera, nodes, brain, PerceptionTime(cfg.perception_time))
        stack.callback(robot.close)

        def run_until(moment: float) -> None:
            while clock.time < moment:
                clock.time += setup.limits.dt
                robot.tick()
                robot.look()

        while not node.is_over:
            run_until(clock.time + CONTROL_DT)
        return robot.deployment.diary


def _require_images(cfg: ReplayCfg) -> None:
    """Refuse a recording without images."""
    name = cfg.profile.camera.image.name
    with opened_bag(cfg.tape) as reader:
        topics = sorted({connection.topic for connection in reader.connections})
    if not any(topic.startswith(name) for topic in topics):
        raise DeploymentError(
            f"{cfg.tape} has no images on {name}, but {', '.join(topics) or 'nothing'}: record with "
            "--record-images jpeg or raw, and replay with the profile of then."
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class Decided:
    """The policy's targets of a recording.

    Attributes:
        time: When the images were taken that were decided on, since the epoch [s].
        target: Targets in joint order [rad].
    """

    time: Float[np.ndarray, " num_orders"]
    target: Float[np.ndarray, "num_orders num_joints"]


def decided(tape: Path) -> Decided:
    """Read what was decided on every image, at first.

    Args:
        tape: A recording of a deployment.

    Raises:
        PerceptionError: It cannot be read.
    """
    orders: dict[float, np.ndarray] = {}
    offset = 0.0
    with opened_bag(tape) as reader:
        wanted = [each for each in reader.connections if each.topic in (ORDERS.name, SERVO.name)]
        for connection, time, data in reader.messages(wanted):
            row = messages.read_float_array(data)
            if connection.topic == SERVO.name:
                offset = 1e-9 * time - Decision.of(row).time
            else:
                order = Orders.of(row)
                orders.setdefault(order.image_stamp, np.array([offset, *order.joint_pos_target]))
    rows = np.array(list(orders.values())).reshape(-1, 1 + len(JOINTS))
    return Decided(time=np.array(list(orders)) + rows[:, 0], target=rows[:, 1:])


def compare(then: Decided, now: Decided) -> dict[str, Any]:
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
