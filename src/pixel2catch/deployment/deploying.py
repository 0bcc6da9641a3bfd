"""The loop of a deployment: images and decisions come in, orders, a status and a recording go out."""

import json
from collections.abc import Callable
from typing import Any

import numpy as np

from pixel2catch.deployment import messages
from pixel2catch.deployment.brain import BOX_AGE, Brain
from pixel2catch.deployment.connection import Connection
from pixel2catch.deployment.eyes import Eyes
from pixel2catch.deployment.pace import Pace
from pixel2catch.deployment.profile import OperatorTopics
from pixel2catch.deployment.report import ACTIVE, Diary
from pixel2catch.deployment.servo_link import Orders
from pixel2catch.deployment.servo_state import Mode
from pixel2catch.deployment.tape import ORDERS, SERVO
from pixel2catch.errors import DeploymentError, NonFiniteError
from pixel2catch.perception.finder import CameraFrame
from pixel2catch.perception.segmenter import BoxPrompt, Prompt
from pixel2catch.robot.constants import CONTROL_DT, JOINTS

POLL = 0.002
"""Longest time between two looks at servo and network [s], in real time; an image ends it. Source: ours."""

LONGEST_AGE = BOX_AGE - 0.1 * CONTROL_DT
"""Age up to which an image waits for its decision [s]: the policy gets the box of before. Source: ours."""

PATIENCE = 1.5 * CONTROL_DT
"""Time after an image from which the next one is missing [s]. Source: ours."""


class Deployment:
    """Runs a brain.

    Attributes:
        diary: What has happened.
    """

    def __init__(self, brain: Brain, eyes: Eyes, connection: Connection, topics: OperatorTopics) -> None:
        """Announce and listen.

        Args:
            brain: Perception and policy.
            eyes: The camera.
            connection: Network, servo, clock and recording.
            topics: Topics of the operator.
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
        self._frame: CameraFrame | None = None
        self._due = connection.clock.now()
        self._message, self._pace = "", Pace(LONGEST_AGE)

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
            if status is None:
                self._transport.wait(POLL)
            else:
                on_status(status)

    def poll(self) -> dict[str, Any] | None:
        """Make a control step if there is a new image, or if one is overdue.

        Returns:
            Its status; none if there was nothing to do.

        Raises:
            DeploymentError: As `run` does.
            PerceptionError: As `run` does.
        """
        self._hear()
        frame = self._eyes.newest()
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
                self._brain.begin()
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
            self._brain.begin(read_prompt(data))
            self._message = ""
        except DeploymentError as error:
            self._message = str(error)

    def _step(self, frame: CameraFrame | None) -> dict[str, Any]:
        """One control step; without a new image it is the last one's again."""
        is_missed = frame is None
        begin = self._clock.now()
        self._frame = frame or self._frame
        seen = self._brain.see(self._frame, begin)
        looked = self._clock.now()
        if frame:
            self._clock.sleep_until(self._pace.moment(frame.stamp, looked))
        waited = self._clock.now() - looked
        self._hear()
        orders, complaint = self._decide()
        if orders and self._mode in ACTIVE:
            self._servo.send(orders)
        end = self._clock.now()
        if self._mode in ACTIVE:
            self.diary.think(took=end - begin - waited, is_missed=is_missed)
        self._due = self._due + CONTROL_DT if is_missed else begin + PATIENCE
        message = self._message or self._eyes.message or complaint or seen.message
        status = self.diary.status(seen, message)
        self._status.publish(messages.text(json.dumps(status)))
        self._record(orders, end)
        return status

    def _decide(self) -> tuple[Orders | None, str]:
        """Orders, if there can be any, and what is wrong."""
        try:
            return self._brain.decide(self._joint_pos, self._clock.now()), ""
        except NonFiniteError as error:
            return None, str(error)

    def _record(self, orders: Orders | None, now: float) -> None:
        if self._tape is None:
            return
        self._tape.see(self._eyes.packets)
        if orders:
            self._tape.note(ORDERS, orders.row, now)
        self._tape.roll()


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
