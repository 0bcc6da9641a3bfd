"""The camera's driver: it is told what there is to see, and has the image when it is due."""

from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing import get_context

import torch

from pixel2catch.rendering.camera import Exposure, Image, RoomCamera
from pixel2catch.rendering.renderer import find_gl_backend
from pixel2catch.scene.scene import SceneCfg
from pixel2catch.twin.processes import SECOND, obey_parent

LATENCY = 0.015
"""Time from the middle of the exposure to the image on the wire [s].

Source: ours, for half the exposure, readout and transfer.
"""

MOST_WAITING = 2
"""Images that may be in work; while there are as many, the next is lost."""


class Camera:
    """Images on their way from exposure to wire.

    Attributes:
        num_images: Images that came out.
        num_late: Those of them that were not drawn in time.
        num_lost: Images that were never drawn, as the ones before took too long.
    """

    def __init__(
        self,
        draw: Callable[[Exposure], "Future[Image]"],
        latency: float = LATENCY,
        clock_error: float = 0.0,
    ) -> None:
        """Begin without an image.

        Args:
            draw: Begins to draw.
            latency: Time from the middle of the exposure to the wire [s].
            clock_error: How late the clock is that stamps the images [s].
        """
        self._draw, self._latency, self._clock_error = draw, latency, clock_error
        self._waiting: deque[tuple[float, Future[Image]]] = deque()
        self._is_overdue = False
        self.num_images, self.num_late, self.num_lost = 0, 0, 0

    def expose(self, exposure: Exposure) -> None:
        """Take an image."""
        if len(self._waiting) >= MOST_WAITING:
            self.num_lost += 1
        else:
            self._waiting.append((exposure.moment.time, self._draw(exposure)))

    def developed(self, now: float) -> Iterator[tuple[float, Image]]:
        """Yield the images that are due, each with its stamp: the middle of its exposure [s]."""
        while self._waiting and self._waiting[0][0] + self._latency <= now:
            time, image = self._waiting[0]
            if not image.done():
                self._is_overdue = True
                return
            self._waiting.popleft()
            self.num_images += 1
            self.num_late += self._is_overdue
            self._is_overdue = False
            yield time - self._clock_error, image.result()


@contextmanager
def drawing_process(scene: SceneCfg, seed: int) -> Iterator[Callable[[Exposure], "Future[Image]"]]:
    """A process that draws what the camera sees, so that the physics keeps its time.

    Args:
        scene: The scene of the simulation.
        seed: Of the room's looks and the sensor's noise.

    Yields:
        Function that begins to draw.

    Raises:
        DeviceUnavailableError: If no OpenGL back end works.
    """
    find_gl_backend()
    with ProcessPoolExecutor(1, get_context("spawn"), _open, (scene, seed)) as process:
        process.submit(_is_open).result()
        yield lambda exposure: process.submit(_draw, exposure)


_VIEWS: list[RoomCamera] = []
"""The view of a process that draws."""


def _open(scene: SceneCfg, seed: int) -> None:
    obey_parent(SECOND)
    torch.set_num_threads(1)
    _VIEWS.append(RoomCamera(scene, seed))


def _is_open() -> bool:
    return bool(_VIEWS)


def _draw(exposure: Exposure) -> Image:
    return _VIEWS[0].image(exposure)
