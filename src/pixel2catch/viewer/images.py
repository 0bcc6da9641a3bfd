"""The camera's image on a page, with the box of the policy, drawn in a thread of its own."""

import base64
import io
import time
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, suppress

import numpy as np
import viser
from PIL import Image

from pixel2catch.errors import DeviceUnavailableError
from pixel2catch.rendering.camera import RoomCamera
from pixel2catch.rendering.video import draw_box
from pixel2catch.scene.scene import SceneCfg
from pixel2catch.viewer.scene import ROOM_SEED
from pixel2catch.viewer.throws import ThrowStep

PERIOD = 1 / 15  #: Least time between two images [s]. Source: ours, so that the physics has a core.
REST = 2.0  #: Least pause after an image over its drawing time, so that the physics is not delayed.
DARK = 40  #: Level of an image where nothing can be drawn but the box.
QUALITY = 80  #: Quality of the JPEG images of a page.


def jpeg(image: np.ndarray) -> bytes:
    """Return an image (red, green, blue) as JPEG."""
    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, "jpeg", quality=QUALITY)
    return buffer.getvalue()


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
        """End the thread."""
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
            time.sleep(max(PERIOD - spent, REST * spent))

    def _show(self, image: np.ndarray) -> None:
        data = base64.b64encode(jpeg(image)).decode()
        self._html.content = (
            f'<img alt="the camera\'s image" decoding="sync" style="{self._style}" '
            f'src="data:image/jpeg;base64,{data}">'
        )
