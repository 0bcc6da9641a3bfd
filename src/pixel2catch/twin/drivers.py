"""Simulated drivers of arm, hand and camera: from commands to servo targets, from exposures to images.

Not modelled: the UR's look-ahead between two commands (identified dynamics may have it as a filter), and the
rest of its safety functions.
"""

from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from typing import final

import numpy as np
from jaxtyping import Float

from pixel2catch.camera.image import Image, Pixels
from pixel2catch.rendering.camera import Exposure
from pixel2catch.ros2.messages import NORMAL_SAFETY_MODE, PROTECTIVE_STOP
from pixel2catch.twin.simulated_lab import JointState

CYCLE = 0.002  #: Period in which drivers read a command and publish joints [s]. Source: UR driver, 500 Hz.
MAX_STEP = 20.0 * CYCLE  #: Change of a target from which the UR ignores a command [rad]. Source: UR driver.

DECELERATION = 4.0  #: Deceleration of every stop [rad/s²]. Source: UR driver, `stopj` of a halt.
SILENCE = 0.04
"""Time without a command in a motion after which the UR's program halts [s]. Source: UR driver (Jazzy).

Differs: the UR's driver repeats the last command without end, and only its own silence halts the program.
"""

LATENCY = 0.015
"""Time from the middle of the exposure to the published image [s].

Source: ours, for half the exposure, readout and transfer.
"""

MOST_WAITING = 2  #: Images that may be drawn at once; further ones are lost.

Joints = Float[np.ndarray, " num_part_joints"]


class Driver(ABC):
    """The driver of one part of the robot."""

    def __init__(self, position: Joints) -> None:
        """Hold these joint positions [rad]."""
        self._target, self.num_ignored = position, 0  #: Commands that were not followed.

    def reset(self, position: Joints) -> None:
        """Hold other positions [rad]."""
        self._target = position

    @abstractmethod
    def cycle(self, command: Joints | None, joints: JointState) -> Joints:
        """Return the servos' target until the next cycle [rad], by the newest command [rad], if any."""


@final
class HandDriver(Driver):
    """Follows every finite command, and holds the last one without end."""

    def cycle(self, command: Joints | None, joints: JointState) -> Joints:
        if command is not None and np.isfinite(command).all():
            self._target = command
        elif command is not None:
            self.num_ignored += 1
        return self._target


@final
class ArmDriver(Driver):
    """The UR's driver and its program on the robot, which ignores too large steps."""

    def __init__(self, position: Joints, lag: Joints) -> None:
        """Hold these positions [rad]; the joints follow in a steady motion with a lag [s]."""
        super().__init__(position)
        self._lag, self._silence, self._is_moving = lag, 0.0, False
        self._braking: JointState | None = None
        self.safety_mode = NORMAL_SAFETY_MODE  #: Or `PROTECTIVE_STOP`.
        self.num_halts = 0
        self.num_missed = 0  #: Next cycles that are lost: no command is read, and the target stays.
        self._newest: Joints | None = None  #: Newest command that arrived in lost cycles.

    @property
    def is_running(self) -> bool:
        return self._braking is None

    def reset(self, position: Joints) -> None:
        """See `Driver.reset`; the program runs again."""
        super().reset(position)
        self._braking, self.safety_mode, self._is_moving = None, NORMAL_SAFETY_MODE, False

    def protective_stop(self) -> None:
        """Stop as after a collision."""
        self.safety_mode = PROTECTIVE_STOP

    def cycle(self, command: Joints | None, joints: JointState) -> Joints:
        command = self._newest if command is None else command
        if self.num_missed > 0:
            self.num_missed -= 1
            self._newest = command
            return self._target
        self._newest = None
        self._silence = self._silence + CYCLE if command is None else 0.0
        is_silent = self._is_moving and self._silence > SILENCE + 0.5 * CYCLE
        if self.is_running and (is_silent or self.safety_mode != NORMAL_SAFETY_MODE):
            self._braking = joints
            self.num_halts += 1
        if self._braking is not None:
            self._braking = _brake_for_one_cycle(self._braking)
            return self._braking.position + self._lag * self._braking.velocity
        if command is not None:
            step = np.abs(command - self._target).max()
            if step <= MAX_STEP:  # false for NaN
                self._target, self._is_moving = command, bool(step > 0.0)
            else:
                self.num_ignored += 1
        return self._target


def _brake_for_one_cycle(joints: JointState) -> JointState:
    speed = np.maximum(np.abs(joints.velocity) - DECELERATION * CYCLE, 0.0)
    velocity = np.copysign(speed, joints.velocity)
    way = 0.5 * CYCLE * (joints.velocity + velocity)
    return JointState(position=joints.position + way, velocity=velocity)


class CameraDriver:
    """The camera's driver: delays images, and loses those that are drawn too slowly."""

    def __init__(self, draw: Callable[[Exposure], "Future[Pixels]"], clock_error: float = 0.0) -> None:
        """Begin without an image; stamps are too early by the clock error [s]."""
        self._draw, self._clock_error = draw, clock_error
        self._waiting: deque[tuple[float, Future[Pixels]]] = deque()
        self.num_late = 0  #: Images that were published a cycle or more after their time.
        self.num_lost = 0  #: Images that were not drawn, because earlier ones took too long.

    def expose(self, exposure: Exposure) -> None:
        if len(self._waiting) >= MOST_WAITING:
            self.num_lost += 1
        else:
            self._waiting.append((exposure.moment.time, self._draw(exposure)))

    def take(self, now: float) -> Iterator[Image]:
        """Yield the images that are due; the stamp is the middle of the exposure."""
        while self._waiting and self._waiting[0][0] + LATENCY <= now and self._waiting[0][1].done():
            time, image = self._waiting.popleft()
            self.num_late += now >= time + LATENCY + CYCLE
            yield Image(pixels=image.result(), stamp=time - self._clock_error)
