"""A deployment step by step, on one thread: its time goes on when it has nothing left to do.

For rehearsals and replays in which it does not matter how fast the machine is.
"""

from collections.abc import Callable
from dataclasses import dataclass
from random import Random
from typing import final

from pixel2catch.deployment.control_loop import ControlLoop
from pixel2catch.deployment.image_subscriber import ImageSubscriber
from pixel2catch.deployment.perception_thread import CallerExecutor
from pixel2catch.deployment.policy_pipeline import PolicyPipeline
from pixel2catch.deployment.recorder import Connection, DeploymentRecorder
from pixel2catch.errors import InvalidValueError
from pixel2catch.ros2.transport import Clock, Transport
from pixel2catch.scene.constants import CameraSpec
from pixel2catch.servo.link import link
from pixel2catch.servo.process import Servo, ServoSetup


@final
class StepClock(Clock):
    """Time that goes on only while somebody waits; time of day is the same."""

    def __init__(self, wait: Callable[[float], None]) -> None:
        """Begin at 0, with what lets happen what happens until a moment [s]."""
        self.time, self._wait = 0.0, wait

    def now(self) -> float:
        """See `Clock.now`."""
        return self.time

    def stamp(self) -> float:
        """See `Clock.stamp`."""
        return self.time

    def sleep_until(self, moment: float) -> None:
        """See `Clock.sleep_until`."""
        self._wait(moment)


def perception_times(least: float, jitter: float = 0.0, seed: int = 0) -> Callable[[], float]:
    """What draws how long perception takes for an image, evenly from the least time to so much more [s].

    Raises:
        InvalidValueError: A time is negative.
    """
    if least < 0.0 or jitter < 0.0:
        raise InvalidValueError(
            f"perception takes {1e3 * least:g} ms, and up to {1e3 * jitter:g} ms more; neither can be less "
            "than 0"
        )
    random = Random(seed)
    return lambda: least + jitter * random.random()


@dataclass(frozen=True, kw_only=True)
class Nodes:
    """How a deployment hears of its robot."""

    servo: Transport  #: The servo's node.
    loop: Transport  #: The control loop's node; it may be the same.
    clock: Clock  #: The clock of both.
    recording: DeploymentRecorder | None = None  #: The recording, if there is one.


class SteppedDeployment:
    """Servo and control loop, each of which does what it has to do when it is told to."""

    def __init__(
        self,
        setup: ServoSetup,
        camera: CameraSpec,
        nodes: Nodes,
        pipeline: PolicyPipeline,
        perception_time: Callable[[], float],
    ) -> None:
        """Put both in place; the perception takes so long [s] for an image."""
        loop_end, servo_end = link()
        self._ends, clock = (loop_end, servo_end), nodes.clock
        self._servo = Servo(servo_end, nodes.servo, setup, clock)
        connection = Connection(
            transport=nodes.loop,
            servo=loop_end,
            servo_dt=setup.limits.dt,
            clock=clock,
            recording=nodes.recording,
        )
        profile, executor = setup.profile, CallerExecutor(clock, perception_time)
        images = ImageSubscriber(nodes.loop, profile.camera, camera, clock, assumes_age=pipeline.knows_age)
        self.control_loop = ControlLoop(pipeline, images, connection, profile.operator, executor)
        self._is_thinking = False

    def tick(self) -> None:
        """A tick of the servo.

        Raises:
            Exception: What the servo did not foresee.
        """
        self._servo.tick()
        if self._servo.unforeseen:
            raise self._servo.unforeseen

    def look(self) -> None:
        """A look of the control loop, which may take its time; while it does, it does not look again."""
        if not self._is_thinking:
            self._is_thinking = True
            self.control_loop.poll()
            self._is_thinking = False

    def close(self) -> None:
        """Cut the link between the two."""
        for end in self._ends:
            end.close()
