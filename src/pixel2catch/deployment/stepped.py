"""A deployment step by step, on one thread: its time goes on when it has nothing left to do.

For rehearsals and replays in which it does not matter how fast the machine is.
"""

from collections.abc import Callable
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


class SteppedServo:
    """A servo that ticks when it is told to, and how a control loop is connected to it."""

    def __init__(
        self,
        setup: ServoSetup,
        nodes: tuple[Transport, Transport],
        clock: Clock,
        recording: DeploymentRecorder | None,
    ) -> None:
        """Put it in place, with the nodes of servo and control loop, which may be the same."""
        self._ends, self.profile = link(), setup.profile
        (loop_end, servo_end), (node, loop_node) = self._ends, nodes
        self._servo = Servo(servo_end, node, setup, clock)
        self.connection = Connection(
            transport=loop_node, servo=loop_end, servo_dt=setup.limits.dt, clock=clock, recording=recording
        )

    def tick(self) -> None:
        """A tick.

        Raises:
            Exception: What the servo did not foresee.
        """
        self._servo.tick()
        if self._servo.unforeseen:
            raise self._servo.unforeseen

    def close(self) -> None:
        """Cut the link."""
        for end in self._ends:
            end.close()


class SteppedLoop:
    """A control loop on a servo's connection, which looks when it is told to."""

    def __init__(
        self,
        servo: SteppedServo,
        camera: CameraSpec,
        pipeline: PolicyPipeline,
        perception_time: Callable[[], float],
    ) -> None:
        """Put it in place; the perception takes so long [s] for an image."""
        connection, profile = servo.connection, servo.profile
        images = ImageSubscriber(
            connection.transport, profile.camera, camera, connection.clock, assumes_age=pipeline.knows_age
        )
        executor = CallerExecutor(connection.clock, perception_time)
        self._loop = ControlLoop(pipeline, images, connection, profile.operator, executor)
        self.statistics, self._is_thinking = self._loop.statistics, False

    def look(self) -> None:
        """A look of the control loop, which may take its time; while it does, it does not look again."""
        if not self._is_thinking:
            self._is_thinking = True
            self._loop.poll()
            self._is_thinking = False
