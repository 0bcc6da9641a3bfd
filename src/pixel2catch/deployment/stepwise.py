"""A deployment step by step, on one thread: its time goes on when it has nothing left to do.

For rehearsals and replays in which it does not matter how fast the machine is.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import final

from pixel2catch.deployment.brain import Brain
from pixel2catch.deployment.clock import Clock
from pixel2catch.deployment.connection import Connection
from pixel2catch.deployment.deploying import Deployment
from pixel2catch.deployment.eyes import Eyes
from pixel2catch.deployment.servo_link import link
from pixel2catch.deployment.servo_process import Servo, ServoSetup
from pixel2catch.deployment.tape import Tape
from pixel2catch.deployment.transport import Transport
from pixel2catch.perception.segmenter import Image, Mask, Prompt, Segmentation, Segmenter
from pixel2catch.robot.constants import CameraSpec


@final
class StepClock(Clock):
    """Time that goes on only while somebody waits; time of day is the same.

    Attributes:
        time: The time [s].
    """

    def __init__(self, wait: Callable[[float], None]) -> None:
        """Begin at 0.

        Args:
            wait: Lets happen what happens until a moment [s].
        """
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


@final
class SlowSegmenter(Segmenter):
    """Another segmenter, that takes its time."""

    def __init__(self, segmenter: Segmenter, clock: Clock, seconds: float) -> None:
        """Slow this one down.

        Args:
            segmenter: What finds the object.
            clock: Whose time it takes.
            seconds: How much of it, for each image [s].
        """
        self._segmenter, self._clock, self._seconds = segmenter, clock, seconds

    def start(self, image: Image, prompt: Prompt, ignored: Mask | None = None) -> Segmentation:
        """See `Segmenter.start`."""
        self._clock.sleep_until(self._clock.now() + self._seconds)
        return self._segmenter.start(image, prompt, ignored)

    def track(self, image: Image, ignored: Mask | None = None) -> Segmentation:
        """See `Segmenter.track`."""
        self._clock.sleep_until(self._clock.now() + self._seconds)
        return self._segmenter.track(image, ignored)

    def reset(self) -> None:
        """See `Segmenter.reset`."""
        self._segmenter.reset()


MakeBrain = Callable[[Clock], Brain]
"""Makes perception and policy; its `SlowSegmenter` takes time of this clock."""


@dataclass(frozen=True, kw_only=True)
class Nodes:
    """How a deployment hears of its robot.

    Attributes:
        servo: The servo's node.
        brain: The brain's node; it may be the same.
        clock: The clock of both.
        tape: The recording, if there is one.
    """

    servo: Transport
    brain: Transport
    clock: Clock
    tape: Tape | None = None


class Stepwise:
    """Servo and brain, each of which does what it has to do when it is told to.

    Attributes:
        deployment: The brain's loop.
    """

    def __init__(self, setup: ServoSetup, camera: CameraSpec, nodes: Nodes, make_brain: MakeBrain) -> None:
        """Put both in place.

        Args:
            setup: What the servo is the servo of.
            camera: The camera of the laboratory.
            nodes: How they hear of it.
            make_brain: Makes what catches.
        """
        brain_end, servo_end = link()
        self._ends, clock = (brain_end, servo_end), nodes.clock
        self._servo = Servo(servo_end, nodes.servo, setup, clock)
        connection = Connection(
            transport=nodes.brain,
            servo=brain_end,
            servo_dt=setup.limits.dt,
            clock=clock,
            tape=nodes.tape,
        )
        eyes = Eyes(nodes.brain, setup.profile.camera, camera, clock)
        self.deployment = Deployment(make_brain(clock), eyes, connection, setup.profile.operator)
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
        """A look of the brain, which may take its time; while it does, it does not look again."""
        if not self._is_thinking:
            self._is_thinking = True
            self.deployment.poll()
            self._is_thinking = False

    def close(self) -> None:
        """Cut the link between the two."""
        for end in self._ends:
            end.close()
