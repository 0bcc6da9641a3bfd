"""Images on their way from exposure to wire."""

from concurrent.futures import Future

import numpy as np
import pytest

from pixel2catch.camera.image import Pixels
from pixel2catch.rendering.camera import Exposure, Moment
from pixel2catch.twin.drivers import CameraDriver


class SlowDrawing:
    """Draws when it is told to."""

    def __init__(self) -> None:
        self.begun: list[Future[Pixels]] = []

    def __call__(self, exposure: Exposure) -> "Future[Pixels]":
        self.begun.append(Future())
        return self.begun[-1]

    def finish(self, number: int) -> None:
        self.begun[number].set_result(np.full((480, 640, 3), number, dtype=np.uint8))


def exposure(time: float) -> Exposure:
    moment = Moment(qpos=np.zeros(26), qvel=np.zeros(25), time=time)
    return Exposure(moment=moment, object_name=None, thrower=lambda _: np.zeros(6))


def developed(camera: CameraDriver, now: float) -> list[tuple[float, int]]:
    return [(image.stamp, int(image.pixels[0, 0, 0])) for image in camera.take(now)]


def test_an_image_comes_when_it_is_due_and_not_before():
    drawing = SlowDrawing()
    camera = CameraDriver(drawing)
    camera.expose(exposure(0.1))
    drawing.finish(0)
    assert developed(camera, 0.114) == []
    assert developed(camera, 0.116) == [(0.1, 0)]
    assert developed(camera, 0.2) == []
    assert (camera.num_images, camera.num_late, camera.num_lost) == (1, 0, 0)


def test_a_clock_that_is_late_makes_images_older_and_no_later():
    drawing = SlowDrawing()
    camera = CameraDriver(drawing, clock_error=0.02)
    camera.expose(exposure(0.1))
    drawing.finish(0)
    assert developed(camera, 0.114) == []
    assert developed(camera, 0.116) == [(pytest.approx(0.08), 0)]


def test_a_late_image_keeps_its_time_and_is_counted():
    drawing = SlowDrawing()
    camera = CameraDriver(drawing)
    camera.expose(exposure(0.1))
    camera.expose(exposure(0.2))
    assert developed(camera, 0.13) == []
    drawing.finish(1)
    assert developed(camera, 0.22) == []  # images keep their order
    drawing.finish(0)
    assert developed(camera, 0.23) == [(0.1, 0), (0.2, 1)]
    assert (camera.num_images, camera.num_late, camera.num_lost) == (2, 1, 0)


def test_an_image_is_lost_while_two_are_in_work():
    drawing = SlowDrawing()
    camera = CameraDriver(drawing)
    for i in range(4):
        camera.expose(exposure(0.1 * i))
    assert (len(drawing.begun), camera.num_lost) == (2, 2)
    drawing.finish(0)
    assert developed(camera, 1.0) == [(0.0, 0)]
    camera.expose(exposure(0.5))
    assert (len(drawing.begun), camera.num_lost) == (3, 2)
