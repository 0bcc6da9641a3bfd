"""The loop of a deployment: images and servo statuses come in, commands, a status and a recording go out.

Control steps are equally long, as in training, and nearly all images come in time.
"""

import json
from collections import deque
from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import replace
from math import floor, inf
from typing import Any

import numpy as np

from pixel2catch.camera.image import Box, Image
from pixel2catch.deployment.image_subscriber import ImageSubscriber
from pixel2catch.deployment.operator_requests import OperatorRequests
from pixel2catch.deployment.perception_thread import ConcurrentPerception, PerceptionResult
from pixel2catch.deployment.policy_pipeline import PolicyPipeline
from pixel2catch.deployment.recorder import ORDERS, Connection
from pixel2catch.deployment.statistics import ACTIVE, RunStatistics
from pixel2catch.errors import DeploymentError, NonFiniteError
from pixel2catch.ros2 import messages
from pixel2catch.ros2.profile import OperatorTopics
from pixel2catch.scene.constants import CONTROL_DT
from pixel2catch.servo.link import JointTargets, Mode

POLL = 0.002
"""Longest real time between two looks at servo and network [s]; an image ends it. Source: ours."""

BUSY_POLL = 0.005
"""The same while an image is looked at, in the same process; that look's end ends it [s].

Source: ours: as often as otherwise they would take a tenth of the time from perception."""

SILENCE = 1.0  #: Time after a good image from which it is said that there is none [s]. Source: ours.
QUANTILE = 0.9  #: Share of the images that are looked at in time. Source: ours.
NUM_LOOKS = 60  #: Looks that a timer learns from: two to four seconds. Source: ours.
SHIFT = 0.0005  #: How far a control step may be longer or shorter than it should be [s]. Source: ours.

GRACE = 0.15 * CONTROL_DT
"""How long a decision waits for a look that should be done [s]: without it the box is a control step older.
Source: ours."""


class DecisionTimer:
    """Says when to decide, once in every control step, whether there is a new image or not.

    Where images come as regularly, it decides as long after their exposure as nine of ten of the last looks
    took, or whole control steps later: perception may take longer than a step.
    """

    def __init__(self, begin: float) -> None:
        """Decide first at this time [s]."""
        self.due = begin  #: When to decide next [s].
        self._ages: deque[float] = deque(maxlen=NUM_LOOKS)
        self._age, self._moment = 0.0, begin

    def learn(self, stamp: float, end: float) -> None:
        """Learn from a look at an image that was taken at one time and had been looked at, at another [s]."""
        self._ages.append(end - stamp)
        self._age = float(np.quantile(self._ages, QUANTILE))
        self._moment = stamp + self._age

    def is_due(self, now: float, stamp: float | None) -> bool:
        """Whether to decide now [s], while an image that was taken at a time [s] is looked at, or none."""
        is_late = stamp is not None and stamp + self._age <= self.due + GRACE
        return now >= self.due + (GRACE if is_late else 0.0)

    def advance(self, now: float, *, is_even: bool) -> None:
        """A decision is made now [s]: set the time of the next one; it has to be even with others or not."""
        num_steps = max(floor((now - self.due) / CONTROL_DT), 0) + 1  # what is over is left out
        self.due += num_steps * CONTROL_DT
        error = (self._moment - self.due + 0.5 * CONTROL_DT) % CONTROL_DT - 0.5 * CONTROL_DT
        most = SHIFT if is_even else inf
        self.due += min(max(error, -most), most)


class ControlLoop:
    """Runs a control loop: images are looked at while the policy decides at even times."""

    def __init__(
        self,
        pipeline: PolicyPipeline,
        images: ImageSubscriber,
        connection: Connection,
        topics: OperatorTopics,
        executor: Executor,
    ) -> None:
        """Announce and listen; the executor looks at images, at one at a time."""
        self.statistics = RunStatistics()
        self._pipeline, self._images = pipeline, images
        self._connection, self._clock = connection, connection.clock
        self._recording = connection.recording
        self._requests = OperatorRequests(connection.transport, topics, self.statistics)
        self._status = connection.transport.publisher(topics.status)
        self._joint_pos = np.full(pipeline.num_joints, np.nan)
        self._mode = int(Mode.IDLE)
        self._perception = ConcurrentPerception(pipeline, executor, connection.clock)
        self._look: PerceptionResult | None = None
        self._box: Box | None = None
        self._sent: JointTargets | None = None
        self._timer = DecisionTimer(connection.clock.now())

    def run(self, is_over: Callable[[], bool], on_status: Callable[[dict[str, Any]], None]) -> None:
        """Go from control step to control step, with the status of each, until it is over.

        Raises:
            DeploymentError: The servo process is gone.
            PerceptionError: The first image has the wrong size.
        """
        while not is_over():
            status = self.poll()
            if status is not None:
                on_status(status)
            else:
                self._wait()

    def _wait(self) -> None:
        """Wait for an image or, while one is looked at, for what is seen, but not for long."""
        left = self._timer.due - self._clock.now()
        if not self._perception.is_free:
            self._perception.wait(min(BUSY_POLL, left) if left > 0.0 else POLL)
        elif left > 0.0:
            self._connection.transport.wait(min(POLL, left))

    def poll(self) -> dict[str, Any] | None:
        """Have images looked at, and decide when it is time, whether that is done or not.

        Returned is the status of a control step that was made; it raises what `run` does.
        """
        self._hear()
        image = self._images.newest()
        if self._recording:
            self._recording.record_images(self._images.received)
        if image:
            self._perception.offer(image)
            self._show_servo(image)
        if look := self._perception.go_on():
            self._look, self._box = look, look.box
            self._timer.learn(look.box.stamp, look.end)
        now = self._clock.now()
        if not self._timer.is_due(now, self._perception.stamp):
            return None
        look, self._look = self._look, None
        took = look.end - look.begin if look else 0.0
        joint_targets, complaint = self._decide()
        self._timer.advance(now, is_even=joint_targets is not None)
        return self._conclude(joint_targets, complaint, look, began=now - took)

    def _hear(self) -> None:
        """Take what servo and operator have said."""
        for command in self._connection.hear():
            self.statistics.note_command(command, self._connection.servo_dt)
            self._images.remember(command.time, command.joint_pos)
            self._joint_pos = command.joint_pos
            if command.mode == Mode.ARMED and self._mode != Mode.ARMED:
                self._perception.begin(None)
                self._requests.stopped_by = ""
            self._mode = command.mode
        for prompt in self._requests.take():
            self._perception.begin(prompt)

    def _show_servo(self, image: Image) -> None:
        """Tell the servo of an image at once: how old the newest one is does not depend on decisions."""
        if self._sent and self._mode in ACTIVE:
            newest, is_sound = min(image.stamp, self._clock.now()), not self._problem
            told = replace(self._sent, image_stamp=newest, is_perception_sound=is_sound)
            self._connection.servo.send(told)

    def _conclude(
        self,
        joint_targets: JointTargets | None,
        complaint: str,
        look: PerceptionResult | None,
        *,
        began: float,
    ) -> dict[str, Any]:
        """Send a command, and publish and record what happened in a control step that began at a time [s].

        There is a look if an image has been looked at since the last one.
        """
        if joint_targets and self._mode in ACTIVE:
            self._connection.servo.send(joint_targets)
            self._sent = joint_targets
        end = self._clock.now()
        box = self._box if end - self._images.stamp < SILENCE else None
        if self._mode in ACTIVE:
            self.statistics.count_step(took=end - began, is_missed=look is None)
        if self._mode in ACTIVE and joint_targets and look:
            times = {"received": look.received, "begun": look.begin, "looked": look.end, "decided": end}
            self.statistics.count_stages(look.box.stamp, times)
        trouble = self._recording.trouble if self._recording else ""
        of_image = self._images.message or (box.message if box else "")
        message = self._requests.complaint or self._problem or of_image or complaint
        sight = self._pipeline.sight
        message = self._images.take_notice() or message
        message = " ".join(filter(None, (self._requests.stopped_by, message, trouble)))
        status = self.statistics.status(box, message, sight.at(end), end - sight.box_stamp)
        self._status.publish(messages.text(json.dumps(status)))
        if self._recording:
            if joint_targets:
                self._recording.record_row(ORDERS, joint_targets.row, end)
            self._recording.record_messages()
        return status

    @property
    def _problem(self) -> str:
        """Why perception cannot be trusted; empty if it can."""
        return self._images.problem or self._pipeline.sight.problem

    def _decide(self) -> tuple[JointTargets | None, str]:
        """A command, if there can be one, and what is wrong; the servo is told of the newest image."""
        now = self._clock.now()
        try:
            joint_targets = self._pipeline.decide(self._joint_pos, now)
        except (NonFiniteError, DeploymentError) as error:
            return None, str(error)
        if joint_targets is None:
            return None, ""
        self.statistics.note_targets(joint_targets)
        newest, is_sound = min(self._images.stamp, now), not self._problem
        return replace(joint_targets, image_stamp=newest, is_perception_sound=is_sound), ""
