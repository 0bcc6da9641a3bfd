"""The loop of a deployment: images and decisions come in, orders, a status and a recording go out."""

import json
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from pixel2catch.deployment.image_subscriber import Eyes
from pixel2catch.deployment.perception_thread import CallerWorker, Look, Looking, Worker
from pixel2catch.deployment.policy_pipeline import BOX_AGE, Brain
from pixel2catch.deployment.recorder import ORDERS, SERVO, Connection
from pixel2catch.deployment.statistics import ACTIVE, Diary
from pixel2catch.deployment.timing import DecisionTimer, Pace
from pixel2catch.errors import DeploymentError, NonFiniteError
from pixel2catch.perception.extractor import Extraction
from pixel2catch.perception.finder import CameraFrame
from pixel2catch.perception.segmenter import BoxPrompt, Prompt
from pixel2catch.robot.constants import CONTROL_DT, JOINTS
from pixel2catch.ros2 import messages
from pixel2catch.ros2.profile import OperatorTopics
from pixel2catch.servo.link import Orders
from pixel2catch.servo.state import Mode

POLL = 0.002
"""Longest time between two looks at servo and network [s], in real time; an image ends it. Source: ours."""

LONGEST_AGE = BOX_AGE - 0.1 * CONTROL_DT
"""Age up to which an image waits for its decision [s]: the policy gets the box of before. Source: ours."""

PATIENCE = 1.5 * CONTROL_DT
"""Time after an image from which the next one is missing [s]. Source: ours."""


class Deployment:
    """Runs a brain.

    A policy that knows how old its boxes are decides at even times, while images are looked at. One that does
    not decides on each image when it has been looked at, and when the box is as old as in its training.

    Attributes:
        diary: What has happened.
    """

    def __init__(
        self,
        brain: Brain,
        eyes: Eyes,
        connection: Connection,
        topics: OperatorTopics,
        worker: Worker[Extraction] | None = None,
    ) -> None:
        """Announce and listen.

        Args:
            brain: Perception and policy.
            eyes: The camera.
            connection: Network, servo, clock and recording.
            topics: Topics of the operator.
            worker: Who looks at images; the caller itself if absent.
        """
        self.diary = Diary()
        self._brain, self._eyes = brain, eyes
        self._servo, self._clock, self._tape = connection.servo, connection.clock, connection.tape
        self._servo_dt = connection.servo_dt
        self._transport = connection.transport
        self._prompts = connection.transport.subscription(topics.prompt)
        self._status = connection.transport.publisher(topics.status)
        self._joint_pos = np.full(len(JOINTS), np.nan)
        self._mode = int(Mode.IDLE)
        self._worker = worker or CallerWorker(connection.clock)
        self._looking = Looking(brain, self._worker, connection.clock)
        self._frame: CameraFrame | None = None
        self._look: Look | None = None
        self._seen: Extraction | None = None
        self._due = connection.clock.now()
        self._message, self._pace, self._timer = "", Pace(LONGEST_AGE), DecisionTimer(self._due)

    def run(self, is_over: Callable[[], bool], on_status: Callable[[dict[str, Any]], None]) -> None:
        """Go from control step to control step.

        Args:
            is_over: Asked all the time whether to end.
            on_status: Gets the status of every control step.

        Raises:
            DeploymentError: The servo process is gone, or the camera is another one.
            PerceptionError: The first image has the wrong size.
        """
        while not is_over():
            status = self.poll()
            if status is not None:
                on_status(status)
            elif (left := self._due - self._clock.now()) > 0.0:
                self._transport.wait(min(POLL, left))

    def poll(self) -> dict[str, Any] | None:
        """Make a control step if it is time.

        Returns:
            Its status; none if there was nothing to do.

        Raises:
            DeploymentError: As `run` does.
            PerceptionError: As `run` does.
        """
        self._hear()
        frame = self._eyes.newest()
        if self._tape:
            self._tape.see(self._eyes.packets)
        if self._brain.knows_age:
            return self._poll_at_even_times(frame)
        if frame is None and self._clock.now() < self._due:
            return None
        return self._step(frame)

    def _hear(self) -> None:
        """Take what servo and operator have said."""
        for decision in self._servo.receive():
            self.diary.obey(decision, self._servo_dt)
            self._eyes.remember(decision.time, decision.joint_pos)
            self._joint_pos = decision.joint_pos
            if decision.mode == Mode.ARMED and self._mode != Mode.ARMED:
                self._looking.begin(None)
            self._mode = decision.mode
            if self._tape:
                self._tape.note(SERVO, decision.row, decision.time)
        if self._servo.is_closed:
            raise DeploymentError(
                "the servo process has ended, and nothing guards the robot: press its stop. What the process "
                "said of the reason is above."
            )
        for packet in self._prompts.take():
            self._point(packet.data)

    def _point(self, data: bytes) -> None:
        """Begin a throw where the operator points."""
        try:
            self._looking.begin(read_prompt(data))
            self._message = ""
        except DeploymentError as error:
            self._message = str(error)

    def _poll_at_even_times(self, frame: CameraFrame | None) -> dict[str, Any] | None:
        """Have images looked at, and decide when it is time, whether that is done or not."""
        if frame:
            self._looking.offer(frame)
        if look := self._looking.go_on():
            self._look, self._seen = look, look.seen
            self._timer.learn(look.frame.stamp, look.end)
        now = self._clock.now()
        if now < self._timer.due:
            return None
        took, is_missed = self._look.took if self._look else 0.0, self._look is None
        self._look = None
        orders, complaint = self._decide()
        if orders:
            self.diary.order(orders)
            orders = replace(orders, image_stamp=min(self._eyes.stamp, now))
        self._timer.advance(now, is_even=orders is not None)
        self._due = self._timer.due
        return self._conclude(orders, complaint, began=now - took, is_missed=is_missed)

    def _step(self, frame: CameraFrame | None) -> dict[str, Any]:
        """One control step; without a new image it is the last one's again."""
        is_missed = frame is None
        begin = self._clock.now()
        self._frame = frame or self._frame
        look = partial(self._brain.perceive, self._frame, begin)
        if frame:
            self._worker.start(look)
        self._seen = self._worker.finish() if frame else look()
        self._brain.remember(self._frame, self._seen)
        looked = self._clock.now()
        if frame:
            self._clock.sleep_until(self._pace.moment(frame.stamp, looked))
        waited = self._clock.now() - looked
        self._hear()
        orders, complaint = self._decide()
        self._due = self._due + CONTROL_DT if is_missed else begin + PATIENCE
        return self._conclude(orders, complaint, began=begin + waited, is_missed=is_missed)

    def _conclude(
        self, orders: Orders | None, complaint: str, *, began: float, is_missed: bool
    ) -> dict[str, Any]:
        """Send orders, and publish and record what happened in a control step that began at a time [s]."""
        if orders and self._mode in ACTIVE:
            self._servo.send(orders)
        end, seen = self._clock.now(), self._seen
        if self._mode in ACTIVE:
            self.diary.think(took=end - began, is_missed=is_missed)
        message = self._message or self._eyes.message or complaint or (seen.message if seen else "")
        status = self.diary.status(seen, self._eyes.take_notice() or message)
        self._status.publish(messages.text(json.dumps(status)))
        if self._tape:
            if orders:
                self._tape.note(ORDERS, orders.row, end)
            self._tape.roll()
        return status

    def _decide(self) -> tuple[Orders | None, str]:
        """Orders, if there can be any, and what is wrong."""
        try:
            return self._brain.decide(self._joint_pos, self._clock.now()), ""
        except (NonFiniteError, DeploymentError) as error:
            return None, str(error)


def read_prompt(data: bytes) -> Prompt:
    """Read where the operator points.

    Raises:
        DeploymentError: It is no box of an image.
    """
    try:
        xmin, ymin, xmax, ymax = map(float, json.loads(messages.read_text(data))["box"])
    except (ValueError, TypeError, KeyError) as error:
        raise DeploymentError(
            f'a prompt is not {{"box": [xmin, ymin, xmax, ymax]}} in pixels ({error}).'
        ) from error
    if not (xmin < xmax and ymin < ymax):
        raise DeploymentError(f"the prompt's box {xmin:g} {ymin:g} {xmax:g} {ymax:g} is empty.")
    return BoxPrompt(box=(xmin, ymin, xmax, ymax))
