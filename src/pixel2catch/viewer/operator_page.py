"""The page of an operator: camera image, perception, servo, and requests.

It is a node of the network like any other. A browser is no safety device: the switch on the page is released
as soon as it may not be held, and the hardware emergency stop remains necessary.
"""

from collections.abc import Callable
from contextlib import suppress
from math import isfinite
from threading import Event
from typing import Any, final

from pixel2catch.camera.image import Verdict
from pixel2catch.deployment.operator import ANSWERS, OperatorConsole
from pixel2catch.errors import DeploymentError
from pixel2catch.ros2 import messages
from pixel2catch.ros2.profile import CameraProfile, Profile
from pixel2catch.ros2.transport import Clock, Transport
from pixel2catch.servo.status_words import latencies, refusal_words, status_words, verdict_words
from pixel2catch.viewer import PageCfg
from pixel2catch.viewer.server import open_server
from pixel2catch.viewer.visitors import HeldButton, Visitor, Visitors, jpeg

PERIOD = 0.02  #: Real time between two polls of network and page [s]. Source: ours, half of the switch's.
PICTURE_TIME = 1 / 15  #: Time between two images [s]. Source: ours.
SILENCE = 1.0  #: Time without messages after which deployment or camera are absent [s]. Source: ours.
REFUSAL_TIME = 6.0  #: Time for which the reason of a refused arming is shown [s].
REQUEST_AGE = 0.5
"""Largest age of the state that a page had when it sent a request [s]. Source: ours, the pause between two
requests to arm; requests that waited in a suspended page or for a program that hung are older."""

LEAST_SIDE = 3.0  #: Least side of a box that points at the object [px].

ACTIVE = ("armed", "ramp", "run", "several")
"""Modes in which the robot may move; "several" stands for several programs that publish a status."""

REQUESTS = "stop, arm, press, hold, let_go, point, caught, reached, dropped, repeat"  #: Of every page.


@final
class OperatorPage:
    """The page; `update` refreshes it."""

    def __init__(
        self,
        cfg: PageCfg,
        title: str,
        profile: Profile,
        transport: Transport,
        clock: Clock,
        console: OperatorConsole,
        *,
        button: HeldButton | None,
        words: str = "",
        more: Callable[[dict[str, Any]], None] | None = None,
    ) -> None:
        """Serve it.

        The owner of the console calls `watch`. The button is the switch on the page, none beside a pedal.
        `words` are robot, profile, network and clock of this program. `more` handles requests besides
        `REQUESTS`, or raises DeploymentError.
        """
        self._console, self._clock, self._camera = console, clock, profile.camera
        self._button, self._more, self._title, self._words = button, more, title, words
        self._images = transport.subscription(profile.camera.image)
        self._visitors = Visitors(self._handle, self._release)
        self._server = open_server(cfg, title, self._visitors.talk)
        self.address = self._server.address  #: Address of the page.
        self._status = console.status
        self._status_time = self._image_time = self._refusal_time = self._shown_time = -SILENCE
        self._refusal, self._image = "", b""
        self._is_stopping, self._num_heard, self._is_switched = False, 0, Event()
        self.state: dict[str, Any] = {}  #: The state that the page shows.

    @property
    def is_held(self) -> bool:
        """Whether a browser holds the switch of the page."""
        return self._button is not None and self._button.holder is not None

    def update(self, twin: dict[str, Any] | None = None) -> None:
        """Send the newest state to all browsers; of a twin also its texts."""
        now = self._clock.now()
        if self._console.status is not self._status:
            self._read_status(self._console.status, now)
        if self._is_stopping:
            self._console.stop()
        if now - self._shown_time >= PICTURE_TIME:
            self._shown_time = now
            self._read_image()
        self.state = self._page_state(now) | {"twin": twin}
        self._visitors.send(self.state, self._image)

    def rest(self) -> None:
        """Wait for the next update, or until the switch is pressed or released."""
        self._is_switched.wait(PERIOD)
        self._is_switched.clear()

    def operate(self, is_over: Callable[[], bool], report: Callable[[dict[str, Any]], None]) -> None:
        """Operate by the page until `is_over`, then release the switch; report the newest status."""
        try:
            while not is_over():
                self._console.holds = self.is_held
                self._console.watch()
                self.update()
                report(self._console.status)
                self.rest()
        finally:
            self._console.holds = False
            self._console.watch()

    def close(self) -> None:
        self._server.close()

    def _read_status(self, status: dict[str, Any], now: float) -> None:
        self._status, self._status_time = status, now
        if (refusal := refusal_words(status)) or status.get("mode") in ACTIVE:
            self._refusal, self._refusal_time = refusal, now
        if self._is_stopping and status.get("mode") not in ACTIVE:
            self._is_stopping, self._num_heard = False, self._num_heard + 1

    def _read_image(self) -> None:
        for message in self._images.take()[-1:]:
            with suppress(DeploymentError):  # unreadable images are skipped
                pixels = messages.read_image(message.data).pixels
                self._image_time = self._shown_time
                if self._visitors.num:
                    self._image = jpeg(pixels)

    def _page_state(self, now: float) -> dict[str, Any]:
        status = self._status if now - self._status_time < SILENCE else {}
        words = status_words(status)
        return {
            "title": self._title,
            "robot": self._robot(str(status.get("robot", ""))),
            "tone": words.tone,
            "headline": words.headline,
            "advice": words.advice,
            "refusal": self._refusal if now - self._refusal_time < REFUSAL_TIME else "",
            "message": status.get("message", ""),
            "is_active": status.get("mode") in ACTIVE,
            "num_heard": self._num_heard,
            "time": round(now, 1),
            "has_switch": self._button is not None,
            "is_held": self._console.holds,
            "size": (self._camera.width, self._camera.height),
            "is_asking": status.get("is_asking") is True,
            "has_image": now - self._image_time < SILENCE,
            "box": status.get("box"),
            "sight": verdict_words(status),
            "is_seen": (status.get("object") or status.get("verdict")) == Verdict.SEEN,
            "latency_ms": latencies(status),
        }

    def _robot(self, theirs: str) -> str:
        """Return the robot of a deployment in words; with those of this program where they differ."""
        if theirs and theirs.startswith(self._words):
            return theirs
        return "; but this program: ".join(filter(None, (theirs, self._words)))

    def _handle(self, visitor: Visitor, request: dict[str, Any]) -> None:
        """Do what a browser requests; stops at any time, the rest only if its state is recent."""
        heard = request.pop("heard", None)
        is_recent = isinstance(heard, int | float) and abs(self._clock.now() - heard) <= REQUEST_AGE
        if not is_recent and request.get("do") not in ("stop", "let_go"):
            raise DeploymentError("the request came too late and does not count: press again")
        if request.get("do") in ANSWERS:
            self._console.answer(request["do"])
        else:
            self._do(visitor, request)

    def _do(self, visitor: Visitor, request: dict[str, Any]) -> None:
        match request:
            case {"do": "stop"}:
                self._stop()
            case {"do": "arm"}:
                self._console.arm()
            case {"do": "press"} if self._button:
                self._button.press(visitor)
                self._is_switched.set()
            case {"do": "hold"} if self._button:
                self._button.keep(visitor)
            case {"do": "let_go"} if self._button:
                self._release(visitor)
            case {"do": "point", "box": box}:
                self._console.point(box_in_image(box, self._camera))
            case _ if self._more:
                self._more(request)
            case _:
                raise DeploymentError(f"{request} is no request; valid: {REQUESTS}")

    def _stop(self) -> None:
        """Request a stop now, and again until a status reports it."""
        if self._button:
            self._button.drop()
            self._is_switched.set()
        self._is_stopping = True
        self._console.stop()

    def _release(self, visitor: Visitor) -> None:
        if self._button:
            self._button.let_go(visitor)
            self._is_switched.set()


def box_in_image(box: Any, camera: CameraProfile) -> list[float]:
    """Return the part of a box in the image: xmin, ymin, xmax, ymax [px], or raise DeploymentError."""
    is_box = isinstance(box, list) and len(box) == 4 and all(type(edge) in (int, float) for edge in box)
    if not (is_box and all(map(isfinite, box))):
        raise DeploymentError(f"{box} is no box: give xmin, ymin, xmax, ymax in pixels of the image")
    ends = (camera.width, camera.height, camera.width, camera.height)
    xmin, ymin, xmax, ymax = (float(min(max(edge, 0), end)) for edge, end in zip(box, ends, strict=True))
    if min(xmax - xmin, ymax - ymin) < LEAST_SIDE:
        raise DeploymentError(f"box {box} has a side below {LEAST_SIDE:g} px; drag it round the object")
    return [xmin, ymin, xmax, ymax]
