"""The camera's image on a page, with the box of the policy, drawn in a thread of its own."""

import base64
import contextlib
import io
import time
from queue import Empty, Full, Queue
from threading import Thread

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
        """Show a dark image of the camera's size."""
        self._html, self._scene, camera = html, scene, scene.camera
        self._style = f"width:100%;display:block;aspect-ratio:{camera.width}/{camera.height}"
        self._dark = np.full((camera.height, camera.width, 3), DARK, np.uint8)
        self._show(self._dark)
        self._steps: Queue[ThrowStep | None] = Queue(maxsize=1)
        self._thread = Thread(target=self._run, name="camera images", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the thread."""
        while self._thread.is_alive():
            self.draw(None)
            self._thread.join(timeout=0.05)

    def draw(self, step: ThrowStep | None) -> None:
        """Draw this control step next, instead of a waiting one; none ends the thread."""
        with contextlib.suppress(Empty):
            self._steps.get_nowait()
        with contextlib.suppress(Full):
            self._steps.put_nowait(step)

    def _run(self) -> None:
        with contextlib.ExitStack() as stack:
            try:
                camera = stack.enter_context(RoomCamera(self._scene, ROOM_SEED))
            except DeviceUnavailableError:
                camera = None
            while (step := self._steps.get()) is not None:
                begin = time.monotonic()
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
