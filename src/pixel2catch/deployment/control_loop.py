"""The control loop of a deployment, between camera, servo and operator, in real or in stepped time."""

import json
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Executor
from contextlib import suppress
from dataclasses import dataclass, replace
from math import floor, inf
from typing import Any, final

import numpy as np

from pixel2catch.camera.image import Box
from pixel2catch.deployment.perception import INLINE, ImageSubscriber, PerceptionRunner
from pixel2catch.deployment.policy_pipeline import PolicyPipeline
from pixel2catch.deployment.recorder import SERVO, TARGETS, DeploymentRecorder
from pixel2catch.deployment.statistics import ACTIVE, RunStatistics
from pixel2catch.deployment.throw_cycle import ThrowCycle
from pixel2catch.errors import DeploymentError
from pixel2catch.perception.segmenter import BoxPrompt
from pixel2catch.ros2 import messages
from pixel2catch.ros2.profile import OperatorTopics, Profile
from pixel2catch.ros2.transport import Clock, Message, Transport
from pixel2catch.scene.constants import CONTROL_DT, CameraSpec
from pixel2catch.servo.limits import ServoLimits
from pixel2catch.servo.link import Command, JointTargets, LoopEnd, Mode, link
from pixel2catch.servo.process import Servo, ServoSetup

POLL = 0.002  #: Longest real time between two polls of servo and network [s]; an image ends it. Source: ours.
BUSY_POLL = 0.005  #: The same while an image is processed, which needs the time. Source: ours.
SILENCE = 1.0  #: Time after a good image from which its box is not reported [s]. Source: ours.
QUANTILE = 0.9  #: Share of the images that are processed before their decision. Source: ours.
NUM_AGES = 60  #: Processed images that the decision time is taken from: two to four seconds. Source: ours.
SHIFT = 0.0005  #: Largest change of a control step's length [s]. Source: ours.
GRACE = 0.15 * CONTROL_DT  #: Time by which a decision waits for a result that is due [s]. Source: ours.
DEPTH = 64  #: Requests of operators kept between two polls.
UNKNOWN_SENDER = "an unknown program"  #: A sender that has left, or that the network does not name.


@dataclass(frozen=True, kw_only=True)
class Connection:
    """Network, servo, clock and recording of a deployment."""

    transport: Transport  #: The node on the network.
    servo: LoopEnd  #: This end of the link to the servo process.
    clock: Clock
    recording: DeploymentRecorder | None
    tick: float = ServoLimits.dt  #: Time between two commands of the servo [s].
    robot_words: str = ""  #: Robot, network and speeds, for the operator's page.

    def receive(self) -> Iterator[Command]:
        """Yield and record the servo's new commands; raise DeploymentError if its process has ended."""
        for command in self.servo.receive():
            if self.recording:
                self.recording.record_row(SERVO, command.row, command.time)
            yield command
        if self.servo.is_closed:
            raise DeploymentError("the servo ended (error above), nothing guards the robot: press its stop.")

    def record(self, targets: JointTargets | None = None) -> str:
        """Record targets and the messages that have arrived; return why the recording is incomplete."""
        if self.recording is None:
            return ""
        if targets:
            self.recording.record_row(TARGETS, targets.row, self.clock.now())
        self.recording.record_messages()
        return self.recording.trouble


class DecisionTimer:
    """Sets the times of the decisions, one in every control step, with or without a new image.

    With regular images it decides when `QUANTILE` of the last ones were processed, counted from their
    exposure, or whole control steps later where perception takes longer than a step.
    """

    def __init__(self, begin: float) -> None:
        self.due = begin  #: Time of the next decision [s].
        self._ages: deque[float] = deque(maxlen=NUM_AGES)
        self._age, self._moment = 0.0, begin

    def learn(self, stamp: float, end: float) -> None:
        """Use an image that was exposed at one time and processed at another [s]."""
        self._ages.append(end - stamp)
        self._age = float(np.quantile(self._ages, QUANTILE))
        self._moment = stamp + self._age

    def is_due(self, now: float, stamp: float | None) -> bool:
        """Return whether to decide now [s]; the stamp is of the image that is being processed, if any [s]."""
        is_expected = stamp is not None and stamp + self._age <= self.due + GRACE
        return now >= self.due + (GRACE if is_expected else 0.0)

    def advance(self, now: float, *, is_even: bool) -> None:
        """Set the next decision after one at a time [s], in even steps if the policy has started."""
        num_steps = max(floor((now - self.due) / CONTROL_DT), 0) + 1
        self.due += num_steps * CONTROL_DT
        error = (self._moment - self.due + 0.5 * CONTROL_DT) % CONTROL_DT - 0.5 * CONTROL_DT
        most = SHIFT if is_even else inf
        self.due += min(max(error, -most), most)


class OperatorRequests:
    """Receives the prompts of one program, and counts who requests a stop.

    The first program that sends a prompt is the only one that may, as long as it is on the network. Where
    the network does not name senders, prompts are refused as soon as there are several publishers.
    """

    def __init__(self, transport: Transport, topics: OperatorTopics, statistics: RunStatistics) -> None:
        self._transport, self._topics, self._statistics = transport, topics, statistics
        self._prompts = transport.subscription(topics.prompt, DEPTH)
        self._stops = transport.subscription(topics.stop, DEPTH, only_watches=True)
        self._pointer = 0
        self.complaint = ""  #: Why the last prompt was refused; empty if it was not.
        self.stopped_by = ""  #: Sentence about the last stop request; empty without one.

    def take_prompts(self) -> Iterator[BoxPrompt]:
        """Yield the valid prompts since the last call; count the stop requests."""
        for message in self._stops.take():
            with suppress(DeploymentError):
                if messages.read_boolean(message.data):
                    others = self._transport.other_publishers(self._topics.stop)
                    who = others.get(message.sender, UNKNOWN_SENDER)
                    self.stopped_by = f"The stop was requested by {who}."
                    self._statistics.stop_requests[who] += 1
        for message in self._prompts.take():
            self.complaint = self._refusal(message)
            if not self.complaint:
                try:
                    yield read_prompt(message.data)
                except DeploymentError as error:
                    self.complaint = str(error)

    def _refusal(self, message: Message) -> str:
        known, sender = self._transport.other_publishers(self._topics.prompt), message.sender
        if sender and self._pointer not in known:
            self._pointer = sender
        if sender == self._pointer and (sender or len(known) < 2):
            return ""
        who = known.get(sender, UNKNOWN_SENDER) if sender else " or ".join(known.values())
        self._statistics.refused_prompts[who] += 1
        return (
            f"a prompt of {who} was refused: {known.get(self._pointer, 'only one program')} points at the "
            "object. End one of them; a program that was killed counts for 10 s."
        )


def read_prompt(data: bytes) -> BoxPrompt:
    """Read a prompt message; raise DeploymentError if it is not a box in an image."""
    with suppress(DeploymentError, ValueError, TypeError, KeyError, OverflowError):
        xmin, ymin, xmax, ymax = map(float, messages.read_json(data)["box"])
        if -inf < xmin < xmax < inf and -inf < ymin < ymax < inf:
            return BoxPrompt(box=(xmin, ymin, xmax, ymax))
    raise DeploymentError('a prompt is not {"box": [xmin, ymin, xmax, ymax]} [px], xmin < xmax, ymin < ymax.')


class ControlLoop:
    """Processes images, decides in even control steps, and sends joint targets to the servo."""

    def __init__(
        self,
        pipeline: PolicyPipeline,
        camera: CameraSpec,
        connection: Connection,
        profile: Profile,
        executor: Executor = INLINE,
        perception_time: Callable[[], float] = float,
        cycle: ThrowCycle | None = None,
    ) -> None:
        """Subscribe and announce; the policy was trained for this camera. The cycle moves between throws.

        The executor has one thread for perception. In stepped time `perception_time` draws how long
        perception takes for an image [s].
        """
        self.statistics = RunStatistics(tick=connection.tick)
        self._pipeline, self._connection = pipeline, connection
        self._clock, self._recording = connection.clock, connection.recording
        self._images = ImageSubscriber(
            connection.transport, profile.camera, camera, connection.clock, assumes_age=pipeline.knows_age
        )
        self._perception = PerceptionRunner(pipeline, connection.clock, executor, perception_time)
        self._requests = OperatorRequests(connection.transport, profile.operator, self.statistics)
        self._status = connection.transport.publisher(profile.operator.status)
        self._joint_pos, self._mode = np.full(pipeline.num_joints, np.nan), int(Mode.IDLE)
        self._times: dict[str, float] | None = None
        self._box: Box | None = None
        self._sent: JointTargets | None = None
        self._timer = DecisionTimer(connection.clock.now())
        self._cycle = cycle
        if cycle:
            cycle.begin_waiting = lambda: self._perception.begin_throw(None)

    def run(self, is_over: Callable[[], bool], on_status: Callable[[dict[str, Any]], None]) -> None:
        """Run until it is over, and report the status of every control step; raises what `poll` raises."""
        while not is_over():
            status, left = self.poll(), self._timer.due - self._clock.now()
            if status:
                on_status(status)
            elif self._perception.stamp is not None:
                self._perception.wait(min(BUSY_POLL, left) if left > 0.0 else POLL)
            elif left > 0.0:
                self._connection.transport.wait(min(POLL, left))

    def poll(self) -> dict[str, Any] | None:
        """Receive, process images and, when it is time, decide; return the status of a control step.

        Raises DeploymentError if the servo process has ended, PerceptionError for a wrong size of images.
        """
        self._receive()
        image = self._images.newest()
        if self._recording:
            self._recording.record_images(self._images.received)
        if image:
            self._perception.offer(image)
            if self._sent and self._mode in ACTIVE:  # at once: the age of an image depends on no decision
                self._connection.servo.send(self._with_image(self._sent, image.stamp))
        if box := self._perception.poll():
            self._box, self._times = box, self._perception.times
            self._timer.learn(box.stamp, self._times["perceived"])
        now = self._clock.now()
        if not self._timer.is_due(now, self._perception.stamp):
            return None
        targets, complaint = self._decide()
        self._timer.advance(now, is_even=targets is not None)
        return self._finish_step(targets, complaint, now)

    def _receive(self) -> None:
        for command in self._connection.receive():
            self.statistics.note_command(command)
            self._images.add_joints(command.time, command.joint_pos)
            self._joint_pos = command.joint_pos
            if command.mode == Mode.ARMED and self._mode != Mode.ARMED:
                self._perception.begin_throw(None)
                self._requests.stopped_by = ""
                if self._cycle:
                    self._cycle.arm(command.joint_pos, command.time + ServoLimits.ramp_time)
            self._mode = command.mode
        for prompt in self._requests.take_prompts():
            if self._cycle and self._cycle.phase == "move":
                self._requests.complaint = "a prompt was ignored: the robot moves. Point at the object later."
            else:
                self._perception.begin_throw(prompt)

    def _decide(self) -> tuple[JointTargets | None, str]:
        decider = self._cycle if self._cycle and self._mode in ACTIVE else self._pipeline
        try:
            targets = decider.decide(self._joint_pos, self._clock.now())
        except DeploymentError as error:
            return None, str(error)
        if targets:
            self.statistics.note_targets(targets)
            targets = self._with_image(targets, self._images.stamp)
        return targets, ""

    def _with_image(self, targets: JointTargets, stamp: float) -> JointTargets:
        """Return targets with the newest image's exposure time [s], and whether perception is sound."""
        if targets.is_planned:
            return targets
        stamp = min(stamp, self._clock.now())
        return replace(targets, image_stamp=stamp, is_perception_sound=not self._problem)

    @property
    def _problem(self) -> str:
        return self._images.problem or self._pipeline.sight.problem

    def _finish_step(self, targets: JointTargets | None, complaint: str, now: float) -> dict[str, Any]:
        if targets and self._mode in ACTIVE:
            self._connection.servo.send(targets)
            self._sent = targets
        end = self._clock.now()
        if self._mode in ACTIVE:
            self.statistics.count_step(now, end, self._times, is_decided=targets is not None)
        self._times = None
        status = self._make_status(complaint, self._connection.record(targets), end)
        self._status.publish(messages.text(json.dumps(status)))
        return status

    def _make_status(self, complaint: str, trouble: str, now: float) -> dict[str, Any]:
        box = self._box if now - self._images.stamp < SILENCE else None
        sight, cycle = self._pipeline.sight, self._cycle
        causes = self._requests.complaint, self._problem, self._images.message, box and box.message, complaint
        wrong = self._images.take_notice() or next(filter(None, causes), "")
        words = self._requests.stopped_by, cycle.message if cycle else "", wrong, trouble
        status = self.statistics.status(box, " ".join(filter(None, words)), sight.at(now))
        phase = {"cycle": cycle.phase} if cycle else {}
        return status | {"robot": self._connection.robot_words} | phase


@final
class StepClock(Clock):
    """Time that passes only while somebody waits; the time of day is the same."""

    def __init__(self, wait: Callable[[float], None]) -> None:
        """Start at 0; the function runs what happens until a time [s]."""
        self.time, self._wait = 0.0, wait

    def now(self) -> float:
        return self.time

    stamp = now

    def sleep_until(self, moment: float) -> None:
        self._wait(moment)


class SteppedServo:
    """A servo in this process that ticks on request, and the connection of a control loop to it."""

    def __init__(
        self,
        setup: ServoSetup,
        nodes: tuple[Transport, Transport],
        clock: Clock,
        recording: DeploymentRecorder | None,
    ) -> None:
        """Use the nodes of servo and control loop, which may be the same."""
        self._ends = loop_end, servo_end = link()
        node, loop_node = nodes
        self._servo = Servo(servo_end, node, setup, clock)
        self.connection = Connection(
            transport=loop_node, servo=loop_end, clock=clock, recording=recording, tick=setup.limits.dt
        )

    def tick(self) -> None:
        """Tick once; raise unexpected errors of the servo."""
        self._servo.tick()
        if self._servo.unforeseen:
            raise self._servo.unforeseen

    def close(self) -> None:
        for end in self._ends:
            end.close()
