"""What the drivers of arm and hand make of the commands that reach them, and the camera's of its images.

Not modelled: the UR's look-ahead between two commands (identified dynamics may have it as a filter), and the
rest of its safety functions.
"""

from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import Float

from pixel2catch.camera.image import Image, Pixels
from pixel2catch.rendering.camera import Exposure
from pixel2catch.ros2.messages import NORMAL_SAFETY_MODE, PROTECTIVE_STOP

CYCLE = 0.002  #: Period in which drivers read a command and publish joints [s]. Source: UR driver, 500 Hz.
MAX_STEP = 20.0 * CYCLE  #: Change of a target from which the UR ignores a command [rad]. Source: UR driver.

SILENCE = 0.04
"""Time without a command after which the UR's program halts [s]. Source: UR driver (Jazzy).

Differs: there it is the silence of the driver, whose forward position controller repeats the last command for
ever. The twin takes the sender's silence in the middle of a motion for it, so that a gap in the commands is
seen; a sender whose commands stand still may go.
"""

DECELERATION = 4.0  #: Deceleration of a halt, here of every stop [rad/s²]. Source: UR driver, its `stopj`.

ENCODER_STEP = {"arm": 9.5e-6, "hand": 8.9e-5}
"""Step of measured positions by the role of a joint group [rad].

Source: arm: recorded positions of a real UR5 are multiples of it (of 8.1e-6 at its wrists), and repeat
themselves to the last bit at rest; hand: its maker's driver, 333.3° in 65,536 counts.
"""

ENCODER_NOISE = 0.3
"""Standard deviation of a position before it is rounded [steps]. Source: ours; at rest most repeat."""

LATENCY = 0.015
"""Time from the middle of the exposure to the image on the wire [s].

Source: ours, for half the exposure, readout and transfer.
"""

MOST_WAITING = 2  #: Images that may be in work; while there are as many, the next is lost.

Joints = Float[np.ndarray, " num_part_joints"]


@dataclass(frozen=True, kw_only=True)
class Motion:
    """Joints of one part."""

    position: Joints  #: Where they are [rad].
    velocity: Joints  #: How fast they are [rad/s].


class Driver(ABC):
    """The driver of one part of the robot."""

    num_ignored: int  #: Commands that it did not take.

    @abstractmethod
    def reset(self, position: Joints) -> None:
        """Hold the joints where they have just been put [rad]."""

    @abstractmethod
    def cycle(self, command: Joints | None, joints: Motion) -> Joints:
        """Return what the servos aim at until the next cycle [rad].

        The command [rad] is the newest one, if one came since the last cycle.
        """


@final
class HandDriver(Driver):
    """Takes every command that is numbers, and holds the last for ever."""

    def __init__(self, position: Joints) -> None:
        """Begin by holding the joints [rad]."""
        self._target = position
        self.num_ignored = 0

    def reset(self, position: Joints) -> None:
        """See `Driver.reset`."""
        self._target = position

    def cycle(self, command: Joints | None, joints: Motion) -> Joints:
        """See `Driver.cycle`."""
        if command is not None and np.isfinite(command).all():
            self._target = command
        elif command is not None:
            self.num_ignored += 1
        return self._target


@final
class ArmDriver(Driver):
    """The UR's driver and its program on the robot, which ignores commands that ask for too large a step."""

    def __init__(self, position: Joints, lag: Joints) -> None:
        """Begin where the joints are [rad], with a running program that has no command yet.

        The lag is how far the joints are behind their target in a steady motion, per speed [s].
        """
        self._target, self._lag = position, lag
        self._silence = 0.0
        self._is_moving = False
        self._braking: Motion | None = None
        self.safety_mode = NORMAL_SAFETY_MODE  #: Or `PROTECTIVE_STOP`.
        self.num_ignored, self.num_halts = 0, 0

    @property
    def is_running(self) -> bool:
        """Whether the program runs."""
        return self._braking is None

    def reset(self, position: Joints) -> None:
        """See `Driver.reset`; the program runs again."""
        self._target, self._braking, self.safety_mode = position, None, NORMAL_SAFETY_MODE
        self._is_moving = False

    def protective_stop(self) -> None:
        """Stop as after a collision."""
        self.safety_mode = PROTECTIVE_STOP

    def cycle(self, command: Joints | None, joints: Motion) -> Joints:
        """See `Driver.cycle`."""
        self._silence = self._silence + CYCLE if command is None else 0.0
        is_silent = self._is_moving and self._silence > SILENCE + 0.5 * CYCLE
        if self.is_running and (is_silent or self.safety_mode != NORMAL_SAFETY_MODE):
            self._braking = joints
            self.num_halts += 1
        if self._braking is not None:
            self._braking = _braked(self._braking)
            return self._braking.position + self._lag * self._braking.velocity
        if command is not None:
            self._follow(command)
        return self._target

    def _follow(self, command: Joints) -> None:
        """Take a command for the target, if it is near enough."""
        step = np.abs(command - self._target).max()
        if step <= MAX_STEP:  # false for what is no number
            self._target, self._is_moving = command, bool(step > 0.0)
        else:
            self.num_ignored += 1


@final
class ArmDrivers(tuple[ArmDriver, ...]):
    """Those of all arms, which stop together, as behind one safety circuit."""

    @property
    def is_running(self) -> bool:
        """Whether all programs run."""
        return all(arm.is_running for arm in self)

    @property
    def safety_mode(self) -> int:
        """The highest of all, which is normal if none stopped."""
        return max(arm.safety_mode for arm in self)

    def protective_stop(self) -> None:
        """Stop as after a collision of one of them."""
        for arm in self:
            arm.protective_stop()


def _braked(motion: Motion) -> Motion:
    """The motion a cycle later, at constant deceleration."""
    speed = np.maximum(np.abs(motion.velocity) - DECELERATION * CYCLE, 0.0)
    velocity = np.copysign(speed, motion.velocity)
    return Motion(position=motion.position + 0.5 * CYCLE * (motion.velocity + velocity), velocity=velocity)


class Camera:
    """The camera's driver: images on their way from exposure to wire."""

    def __init__(self, draw: Callable[[Exposure], "Future[Pixels]"], clock_error: float = 0.0) -> None:
        """Begin without an image, and with what begins to draw one.

        The clock that stamps the images is late by its error [s].
        """
        self._draw, self._clock_error = draw, clock_error
        self._waiting: deque[tuple[float, Future[Pixels]]] = deque()
        self._is_overdue = False
        self.num_images = 0  #: Images that came out.
        self.num_late = 0  #: Those of them that were not drawn in time.
        self.num_lost = 0  #: Images that were never drawn, as the ones before took too long.

    def expose(self, exposure: Exposure) -> None:
        """Take an image."""
        if len(self._waiting) >= MOST_WAITING:
            self.num_lost += 1
        else:
            self._waiting.append((exposure.moment.time, self._draw(exposure)))

    def developed(self, now: float) -> Iterator[Image]:
        """Yield the images that are due; the stamp is the middle of the exposure."""
        while self._waiting and self._waiting[0][0] + LATENCY <= now:
            time, image = self._waiting[0]
            if not image.done():
                self._is_overdue = True
                return
            self._waiting.popleft()
            self.num_images += 1
            self.num_late += self._is_overdue
            self._is_overdue = False
            yield Image(pixels=image.result(), stamp=time - self._clock_error)
