"""A rehearsal in step: twin and deployment in one process, whose time goes on when one of them waits.

Messages travel in memory, and perception takes as long as is said: how fast the machine is, and what else
runs on it, changes nothing.
"""

from collections.abc import Callable
from concurrent.futures import Future
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path

from pixel2catch.deployment.brain import Brain
from pixel2catch.deployment.limits import ServoLimits
from pixel2catch.deployment.memory import Broker
from pixel2catch.deployment.profile import Profile
from pixel2catch.deployment.recorder import Recorder
from pixel2catch.deployment.servo_process import ServoSetup
from pixel2catch.deployment.stepwise import Nodes, PerceptionTime, StepClock, Stepwise
from pixel2catch.deployment.tape import Tape
from pixel2catch.envs.cfg import CatchEnvCfg
from pixel2catch.perception.segmenter import Image
from pixel2catch.rendering.camera import Exposure
from pixel2catch.twin.camera import Camera
from pixel2catch.twin.drivers import CYCLE
from pixel2catch.twin.lab import Lab
from pixel2catch.twin.operator import Operator
from pixel2catch.twin.running import PROFILE
from pixel2catch.twin.wires import Wires

HOP = 0.0005
"""Time from a cycle of the drivers to the servo's tick, and from there to the brain [s].

Source: ours, for DDS between two processes.
"""

ROUNDING = 1e-9
"""Difference of two times that is none [s]."""

PERCEPTION_TIME = 0.010
"""Time that perception takes for an image [s]. Source: ours, background subtraction on one core."""

Draw = Callable[[Lab, Exposure], Image]
"""Draws what the camera sees."""


@dataclass(frozen=True, kw_only=True)
class LockstepCfg:
    """What is rehearsed.

    Attributes:
        task: What is thrown at which robot.
        limits: What the servo keeps to.
        seed: Of the first start pose and all noise.
        perception_time: Least time that perception takes for an image [s].
        perception_jitter: How much more it may be, drawn for each image [s].
        clock_error: How much older images are by their stamps than they are [s]; negative: younger.
        record: New folder for the recording of the deployment; none for no recording.
    """

    task: CatchEnvCfg
    limits: ServoLimits = field(default_factory=ServoLimits)
    seed: int = 0
    perception_time: float = PERCEPTION_TIME
    perception_jitter: float = 0.0
    clock_error: float = 0.0
    record: Path | None = None


class Lockstep:
    """The twin, a deployment, and an operator.

    Attributes:
        clock: The time, which goes on when somebody waits.
        broker: The network.
        lab: What is true.
        operator: Who asks for throws.
        deployment: What catches.
    """

    def __init__(self, cfg: LockstepCfg, draw: Draw, brain: Brain) -> None:
        """Put everybody in place; nothing happens yet.

        Args:
            cfg: What is rehearsed.
            draw: Draws what the camera sees.
            brain: What catches.
        """
        self.clock, self.broker = clock, broker = StepClock(self._wait), Broker()
        profile, self._num_cycles = Profile.load(PROFILE), 0
        self.lab = Lab(cfg.task, cfg.seed)
        camera = Camera(lambda exposure: _done(draw(self.lab, exposure)), clock_error=cfg.clock_error)
        self._wires = Wires(self.lab, profile, broker.node(clock), camera)
        self._open = ExitStack()
        node = broker.node(clock)
        tape = None
        if cfg.record:
            tape = Tape(self._open.enter_context(Recorder(cfg.record)), node, profile, clock, "jpeg")
        nodes = Nodes(servo=broker.node(clock), brain=node, clock=clock, tape=tape)
        setup = ServoSetup(profile=profile, limits=cfg.limits)
        time = PerceptionTime(cfg.perception_time, cfg.perception_jitter, cfg.seed)
        self._robot = Stepwise(setup, self.lab.camera, nodes, brain, time)
        self.deployment = self._robot.deployment
        self.operator = Operator(broker.node(clock), profile.operator, clock)

    def close(self) -> None:
        """Free the simulation, and end the recording."""
        self._open.close()
        self.lab.close()
        self._robot.close()

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
        self._robot.tick()
        self.clock.time = begin + 2 * HOP
        self._robot.look()


def _done(image: Image) -> "Future[Image]":
    """An image that need not be waited for."""
    future: Future[Image] = Future()
    future.set_result(image)
    return future
