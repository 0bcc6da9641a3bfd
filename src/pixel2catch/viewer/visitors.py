"""The browsers that look at a page of our own: what they are told, and what they hold."""

import asyncio
import json
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any, final

from websockets.asyncio.server import ServerConnection
from websockets.exceptions import ConnectionClosed

from pixel2catch.errors import DeploymentError, InvalidValueError, Pixel2CatchError
from pixel2catch.files import json_object

BEAT_AGE = 0.4
"""Real time for which a browser that says nothing still holds the switch [s]. Source: ours: it says so every
0.05 s (`operate.js`), and draws in between; letting go is said at once, this is for one that hangs."""

LONGEST = 1000  #: Characters of a request; ours have a hundred.

Visitor = ServerConnection  #: One browser, as long as it is connected.
Heed = Callable[[Visitor, dict[str, Any]], None]  #: Does what a browser asks for, or raises Pixel2CatchError.


@final
class HeldButton:
    """The dead-man's switch of a page: one browser holds it, for as long as it says so again and again.

    One that falls silent must press anew; what it says of holding before counts for nothing. Any thread may
    call this.
    """

    def __init__(self, age: float = BEAT_AGE, now: Callable[[], float] = time.monotonic) -> None:
        """Begin with nobody holding it; a browser may be silent for so long [s]."""
        self._age, self._now = age, now
        self._holding: tuple[object, float] | None = None

    @property
    def holder(self) -> object | None:
        """The browser that holds it now, if one does."""
        holding = self._holding
        return holding[0] if holding and self._now() <= holding[1] else None

    def press(self, visitor: object) -> None:
        """Begin to hold it.

        Raises:
            DeploymentError: Another browser holds it.
        """
        if self.holder not in (None, visitor):
            raise DeploymentError("another page holds the switch: let go of it there")
        self._holding = (visitor, self._now() + self._age)

    def go_on(self, visitor: object) -> None:
        """Go on holding it.

        Raises:
            DeploymentError: It has fallen, as the browser was silent for too long, or somebody stopped.
        """
        if self.holder is not visitor:
            raise DeploymentError("the switch has fallen: let go of it, and hold it again")
        self.press(visitor)

    def let_go(self, visitor: object) -> None:
        """Hold it no longer, if that browser does."""
        if self.holder is visitor:
            self.drop()

    def drop(self) -> None:
        """Let it fall, whoever holds it."""
        self._holding = None


@final
class Visitors:
    """Tells every browser the newest state and image, as fast as it takes them; any thread may `tell`."""

    def __init__(self, heed: Heed, on_leave: Callable[[Visitor], None]) -> None:
        """Begin with nobody; both functions are called in the server's thread."""
        self._heed, self._on_leave = heed, on_leave
        self._news: dict[Visitor, asyncio.Event] = {}
        self._loop: asyncio.AbstractEventLoop | None = None
        self._state, self._image = "", b""

    @property
    def num(self) -> int:
        """How many there are."""
        return len(self._news)

    def tell(self, state: dict[str, Any], image: bytes) -> None:
        """Tell all of a state, if it is another one, and of an image, a JPEG, if it is."""
        written = json.dumps(state)
        if (written, image) == (self._state, self._image):
            return
        self._state, self._image = written, image
        if self._loop and self._news:
            with suppress(RuntimeError):  # the server has ended
                self._loop.call_soon_threadsafe(self._wake)

    def _wake(self) -> None:
        for news in self._news.values():
            news.set()

    async def talk(self, visitor: Visitor) -> None:
        """Speak with a browser until it leaves; one that says what no page of ours says is cut off."""
        self._loop = asyncio.get_running_loop()
        news = self._news[visitor] = asyncio.Event()
        news.set()
        sending = asyncio.create_task(self._send(visitor, news))
        try:
            async for said in visitor:
                await self._hear(visitor, said)
        except ConnectionClosed:
            pass
        finally:
            del self._news[visitor]
            sending.cancel()
            self._on_leave(visitor)

    async def _hear(self, visitor: Visitor, said: str | bytes) -> None:
        try:
            asked = json_object(said) if isinstance(said, str) and len(said) <= LONGEST else None
        except InvalidValueError:
            asked = None
        if asked is None:
            return await visitor.close(1008, "not a request")
        try:
            self._heed(visitor, asked)
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
