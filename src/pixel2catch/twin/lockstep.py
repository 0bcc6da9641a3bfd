"""A rehearsal in step: twin, servo and deployment in one process, whose time goes on when one of them waits.

Messages travel in memory, and perception takes as long as is said: how fast the machine is, and what else
runs on it, changes nothing.
"""

from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass, field
from typing import final

from pixel2catch.deployment.brain import Brain
from pixel2catch.deployment.clock import Clock
from pixel2catch.deployment.connection import Connection
from pixel2catch.deployment.deploying import Deployment
from pixel2catch.deployment.eyes import Eyes
from pixel2catch.deployment.limits import ServoLimits
from pixel2catch.deployment.memory import Broker
from pixel2catch.deployment.profile import Profile
from pixel2catch.deployment.servo_link import link
from pixel2catch.deployment.servo_process import Servo, ServoSetup
from pixel2catch.envs.cfg import CatchEnvCfg
from pixel2catch.perception.segmenter import Image, Mask, Prompt, Segmentation, Segmenter
from pixel2catch.twin.camera import Camera
from pixel2catch.twin.drivers import CYCLE
from pixel2catch.twin.lab import Lab
from pixel2catch.twin.operator import Operator
from pixel2catch.twin.running import PROFILE
from pixel2catch.twin.view import Exposure
from pixel2catch.twin.wires import Wires

HOP = 0.0005
"""Time from a cycle of the drivers to the servo's tick, and from there to the brain [s].

Source: ours; DDS between two processes takes as long in the median (`benchmarks/transport_latency.py`).
"""

ROUNDING = 1e-9
"""Difference of two times that is none [s]."""


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


Draw = Callable[[Lab, Exposure], Image]
"""Draws what the camera sees."""

MakeBrain = Callable[[Clock], Brain]
"""Makes perception and policy; its `SlowSegmenter` takes time of this clock."""


@dataclass(frozen=True, kw_only=True)
class LockstepCfg:
    """What is rehearsed.

    Attributes:
        task: What is thrown at which robot.
        limits: What the servo keeps to.
        seed: Of the first start pose and all noise.
    """

    task: CatchEnvCfg
    limits: ServoLimits = field(default_factory=ServoLimits)
    seed: int = 0


class Lockstep:
    """The twin, a deployment, and an operator.

    Attributes:
        clock: The time, which goes on when somebody waits.
        broker: The network.
        lab: What is true.
        operator: Who asks for throws.
        deployment: What catches.
    """

    def __init__(self, cfg: LockstepCfg, draw: Draw, make_brain: MakeBrain) -> None:
        """Put everybody in place; nothing happens yet.

        Args:
            cfg: What is rehearsed.
            draw: Draws what the camera sees.
            make_brain: Makes what catches.
        """
        self.clock, self.broker = clock, broker = StepClock(self._wait), Broker()
        profile = Profile.load(PROFILE)
        self._num_cycles, self._is_thinking = 0, False
        self.lab = Lab(cfg.task, cfg.seed)
        self._wires = Wires(
            self.lab, profile, broker.node(clock), Camera(lambda seen: _done(draw(self.lab, seen)))
        )
        brain_end, servo_end = link()
        self._servo = Servo(
            servo_end, broker.node(clock), ServoSetup(profile=profile, limits=cfg.limits), clock
        )
        connection = Connection(
            transport=broker.node(clock), servo=brain_end, servo_dt=cfg.limits.dt, clock=clock, tape=None
        )
        eyes = Eyes(connection.transport, profile.camera, self.lab.camera, clock)
        self.deployment = Deployment(make_brain(clock), eyes, connection, profile.operator)
        self.operator = Operator(broker.node(clock), profile.operator, clock)
        self._ends = (brain_end, servo_end)

    def close(self) -> None:
        """Free the simulation."""
        self.lab.close()
        for end in self._ends:
            end.close()

    def __enter__(self) -> "Lockstep":
        """Return the rehearsal itself."""
        return self

    def __exit__(self, *exception: object) -> None:
        """Close it."""
        self.close()

    def _wait(self, moment: float) -> None:
        """Let happen what happens until a moment [s], or shortly after."""
        while self.clock.time < moment - ROUNDING:
            self._cycle()

    def _cycle(self) -> None:
        """A cycle of the drivers, a tick of the servo, and a look of the brain, if it does not think."""
        begin = self._num_cycles * CYCLE
        self._num_cycles += 1
        self.clock.time = begin
        self._wires.cycle(start=0.0)
        self.clock.time = begin + HOP
        self._servo.tick()
        if self._servo.unforeseen:
            raise self._servo.unforeseen
        self.clock.time = begin + 2 * HOP
        if not self._is_thinking:
            self._is_thinking = True
            self.deployment.poll()
            self._is_thinking = False


def _done(image: Image) -> "Future[Image]":
    """An image that need not be waited for."""
    future: Future[Image] = Future()
    future.set_result(image)
    return future
