"""The browsers of an own page: the state that is sent to them, and the switch that they hold."""

import asyncio
import io
import json
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any, final

import numpy as np
from PIL import Image
from websockets.asyncio.server import ServerConnection
from websockets.exceptions import ConnectionClosed

from pixel2catch.errors import DeploymentError, InvalidValueError, Pixel2CatchError
from pixel2catch.files import json_object

BEAT_AGE = 0.4
"""Real time after which a silent browser no longer holds the switch [s]. Source: ours: `operate.js` repeats
`hold` every 0.05 s and sends a release at once, so this is for a browser that hangs."""

QUALITY = 80  #: Quality of the JPEG images of a page.
LONGEST = 1000  #: Largest number of characters of a request; those of our pages have a hundred.

Visitor = ServerConnection  #: A connected browser.
Handle = Callable[[Visitor, dict[str, Any]], None]
"""Does what a browser requests, or raises Pixel2CatchError."""


@final
class HeldButton:
    """The dead-man's switch of a page: one browser holds it while it keeps repeating so.

    A browser that was silent must press again; its further `hold` requests do not count. Thread-safe.
    """

    def __init__(self, age: float = BEAT_AGE, now: Callable[[], float] = time.monotonic) -> None:
        """Begin with the switch released; a holding browser may be silent for `age` [s]."""
        self._age, self._now = age, now
        self._holding: tuple[object, float] | None = None

    @property
    def holder(self) -> object | None:
        """The browser that holds it now, if any."""
        holding = self._holding
        return holding[0] if holding and self._now() <= holding[1] else None

    def press(self, visitor: object) -> None:
        """Hold the switch; raise DeploymentError if another browser holds it."""
        if self.holder not in (None, visitor):
            raise DeploymentError("another page holds the switch: let go of it there")
        self._holding = (visitor, self._now() + self._age)

    def keep(self, visitor: object) -> None:
        """Keep holding the switch; raise DeploymentError if silence or a stop of the robot released it."""
        if self.holder is not visitor:
            raise DeploymentError("the switch was released: let go of it, and hold it again")
        self.press(visitor)

    def let_go(self, visitor: object) -> None:
        """Release the switch, if that browser holds it."""
        if self.holder is visitor:
            self.drop()

    def drop(self) -> None:
        """Release the switch, whoever holds it."""
        self._holding = None


@final
class Visitors:
    """Sends the newest state and image to every browser as fast as it takes them; `send` is thread-safe."""

    def __init__(self, handle: Handle, on_leave: Callable[[Visitor], None]) -> None:
        """Begin without browsers; both functions are called in the server's thread."""
        self._handle, self._on_leave = handle, on_leave
        self._news: dict[Visitor, asyncio.Event] = {}
        self._loop: asyncio.AbstractEventLoop | None = None
        self._state, self._image = "", b""

    @property
    def num(self) -> int:
        return len(self._news)

    def send(self, state: dict[str, Any], image: bytes) -> None:
        """Send a state and an image (JPEG) to all browsers, where they changed."""
        written = json.dumps(state)
        if (written, image) == (self._state, self._image):
            return
        self._state, self._image = written, image
        if self._loop and self._news:
            with suppress(RuntimeError):  # the server has ended
                self._loop.call_soon_threadsafe(lambda: [news.set() for news in self._news.values()])

    async def talk(self, visitor: Visitor) -> None:
        """Serve a browser until it leaves; close the connection after a message that is no request."""
        self._loop = asyncio.get_running_loop()
        news = self._news[visitor] = asyncio.Event()
        news.set()
        sending = asyncio.create_task(self._send(visitor, news))
        try:
            async for message in visitor:
                await self._receive(visitor, message)
        except ConnectionClosed:
            pass
        finally:
            del self._news[visitor]
            sending.cancel()
            self._on_leave(visitor)

    async def _receive(self, visitor: Visitor, message: str | bytes) -> None:
        try:
            request = json_object(message) if isinstance(message, str) and len(message) <= LONGEST else None
        except InvalidValueError:
            request = None
        if request is None:
            return await visitor.close(1008, "not a request")
        try:
            self._handle(visitor, request)
        except Pixel2CatchError as error:
            await visitor.send(json.dumps({"error": str(error)}))

    async def _send(self, visitor: Visitor, news: asyncio.Event) -> None:
        state, image = "", b""
        with suppress(ConnectionClosed):
            while await news.wait():
                news.clear()
                if self._state != state:
                    state = self._state
                    await visitor.send(state)
                if self._image is not image:
                    image = self._image
                    await visitor.send(image)


def jpeg(image: np.ndarray) -> bytes:
    """Return an image (red, green, blue) as JPEG."""
    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, "jpeg", quality=QUALITY)
    return buffer.getvalue()
