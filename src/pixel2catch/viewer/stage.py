"""A throw on a page: the scene, the camera's image, and the controls of time."""

import base64
import time
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, suppress
from threading import Condition

import numpy as np
import viser

from pixel2catch.errors import DeviceUnavailableError
from pixel2catch.rendering.camera import RoomCamera
from pixel2catch.rendering.video import draw_box
from pixel2catch.scene.constants import CONTROL_DT
from pixel2catch.scene.scene import SceneCfg
from pixel2catch.viewer.scene import ROOM_SEED, SceneView
from pixel2catch.viewer.throws import PlayedThrow, ThrowStep
from pixel2catch.viewer.visitors import jpeg

MOST_LATE = 0.1  #: Largest delay of pictures that is made up for [s]. Source: ours.
IMAGE_PERIOD = 1 / 15  #: Least time between two images [s]. Source: ours, so that the physics has a core.
REST = 2.0  #: Least pause after an image over its drawing time, so that the physics is not delayed.
DARK = 40  #: Level of an image where nothing can be drawn but the box.
SPEEDS = {"real time": 1.0, "half": 0.5, "a quarter": 0.25, "a tenth": 0.1}  #: Speeds of time by name.


class Playback:
    """Paces the pictures of one thread; any thread may change the speed."""

    def __init__(self) -> None:
        self._changed = Condition()
        self.speed = 1.0  #: Simulated time per real time.
        self.is_paused = False  #: Whether time stands still.
        self._is_interrupted, self._due = False, 0.0

    def set(self, **values: float) -> None:
        """Set `speed` or `is_paused`."""
        with self._changed:
            vars(self).update(values)
            self._changed.notify_all()

    def interrupt(self) -> None:
        """End all waits until the next `begin`."""
        self.set(_is_interrupted=True)

    def begin(self) -> None:
        self._due = time.monotonic()
        self.set(_is_interrupted=False)

    def wait(self, duration: float) -> bool:
        """Wait until the next picture is due, this time after the last [s]; return whether to continue."""
        with self._changed:
            if not self.is_paused:
                self._due = max(self._due + duration / self.speed, time.monotonic() - MOST_LATE)
            while not self._is_interrupted:
                if self.is_paused:
                    self._due = time.monotonic()
                    self._changed.wait()
                elif (left := self._due - time.monotonic()) > 0:
                    self._changed.wait(left)
                else:
                    break
            return not self._is_interrupted


class Stage:
    """Shows throws while they happen, or again; one thread calls `show` and `replay`."""

    def __init__(self, server: viser.ViserServer, scene: SceneCfg, playback: Playback) -> None:
        self._server, self._playback = server, playback
        gui = server.gui
        gui.main_panel.dock_right()
        gui.main_panel.set_width(380)
        self.text = gui.add_markdown("")  #: Number, object and outcome of the throw, or an error.
        pause = gui.add_checkbox("pause", False)
        pause.on_update(lambda _: playback.set(is_paused=pause.value))
        speed = gui.add_dropdown("speed", list(SPEEDS), initial_value="real time")
        speed.on_update(lambda _: playback.set(speed=SPEEDS[speed.value]))
        self._html = gui.add_html("")  #: The camera's image, with the box of the policy.
        self.num_pictures = 0  #: Number of pictures so far.
        self._open(scene)

    def set_scene(self, scene: SceneCfg) -> None:
        """Show a scene, if it differs from the present one."""
        if scene == self._scene:
            return
        self._images.close()
        self.view.remove()
        self._open(scene)

    def show(self, throw: PlayedThrow, number: int) -> bool:
        """Show a control step of a throw when it is due; return whether to continue."""
        step, before = throw.steps[number], throw.steps[number - 1].exposure if number else None
        if before is None:
            self.view.show_path(throw.path)
            self.show_text(throw)
        self._images.draw(step)
        count = 1 if before is None else max(1, round(1 / self._playback.speed))
        for i in range(count):
            with self._server.atomic():
                self.view.show(step.exposure, before, (i + 1) / count)
            self.num_pictures += 1
            if not self._playback.wait(CONTROL_DT / count):
                return False
        return True

    def show_text(self, throw: PlayedThrow) -> None:
        """Show number, object and outcome of a throw."""
        outcome = f" **{throw.outcome}**" if throw.outcome else ""
        self.text.content = f"throw {throw.number}: {throw.object_name}{outcome}"

    def replay(self, throw: PlayedThrow) -> None:
        for number in range(len(throw.steps)):
            if not self.show(throw, number):
                return

    def close(self) -> None:
        self._images.close()

    def _open(self, scene: SceneCfg) -> None:
        self._scene = scene
        self.view = SceneView(self._server, scene)  #: The scene.
        self._images = CameraImages(self._html, scene)


class CameraImages:
    """Draws the newest control step on a page in a thread of its own; close it.

    Differs from viser's image, which is freed before a busy browser has loaded it.
    """

    def __init__(self, html: viser.GuiHtmlHandle, scene: SceneCfg) -> None:
        camera = scene.camera
        self._html, self._stack, self._newest = html, ExitStack(), None
        self._style = f"width:100%;display:block;aspect-ratio:{camera.width}/{camera.height}"
        self._dark = np.full((camera.height, camera.width, 3), DARK, np.uint8)
        self._show(self._dark)
        self._pool = ThreadPoolExecutor(1, "camera images")
        self._camera = self._pool.submit(self._open, scene)
        self._drawing: Future[None] | None = None

    def close(self) -> None:
        self._newest = None
        self._pool.submit(self._stack.close)
        self._pool.shutdown()

    def draw(self, step: ThrowStep) -> None:
        """Draw this control step next, instead of a waiting one."""
        self._newest = step
        if self._drawing is None or self._drawing.done():
            self._drawing = self._pool.submit(self._draw_newest)

    def _open(self, scene: SceneCfg) -> RoomCamera | None:
        with suppress(DeviceUnavailableError):
            return self._stack.enter_context(RoomCamera(scene, ROOM_SEED))

    def _draw_newest(self) -> None:
        camera = self._camera.result()
        while step := self._newest:
            begin, self._newest = time.monotonic(), None
            image = camera.image(step.exposure) if camera else self._dark.copy()
            draw_box(image, step.box)
            self._show(image)
            spent = time.monotonic() - begin
            time.sleep(max(IMAGE_PERIOD - spent, REST * spent))

    def _show(self, image: np.ndarray) -> None:
        data = base64.b64encode(jpeg(image)).decode()
        self._html.content = (
            f'<img alt="the camera\'s image" decoding="sync" style="{self._style}" '
            f'src="data:image/jpeg;base64,{data}">'
        )
