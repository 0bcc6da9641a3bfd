"""The web server of every page: viser's, which answers the browser of its owner and no other page in it.

A page has buttons, and any web page that is open in a browser can send requests to this machine. So a request
must be made to this machine by name (else a foreign name that resolves to it would do), come from the page
itself, and nobody may frame the page. Where others can reach the server, the address has a token in it as
well; a browser that came with it keeps it in a cookie.
"""

import contextlib
import http
import io
import secrets
import socket
from collections.abc import Awaitable, Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from http.cookies import CookieError, SimpleCookie
from importlib.resources import files
from ipaddress import ip_address
from pathlib import PurePath
from typing import Any
from urllib.parse import parse_qs, urlsplit

import viser
import websockets.asyncio.server
from websockets import Headers
from websockets.asyncio.server import ServerConnection
from websockets.http11 import Request, Response

from pixel2catch.errors import InvalidValueError
from pixel2catch.viewer.config import PageCfg

KINDS = {".html": "text/html", ".js": "text/javascript", ".css": "text/css"}  #: Types of a page's files.

LOOPBACK_NAMES = ("localhost", "127.0.0.1", "::1")  #: What this machine's own browser calls it.

UNFRAMED = {"X-Frame-Options": "DENY", "Content-Security-Policy": "frame-ancestors 'none'"}
"""Headers of every answer: nobody may lay the page under another one and borrow a click."""

FRAMED_BY_OWN = {"X-Frame-Options": "SAMEORIGIN", "Content-Security-Policy": "frame-ancestors 'self'"}
"""Headers of what a page of our own shows in a frame: viser's page, beside it."""

OWN_POLICY = "default-src 'self'; img-src 'self' data:; frame-ancestors 'none'"
"""What a page of our own may load: nothing from elsewhere, and no script that is not one of its files."""

Answer = Callable[[Any, Request], Response | None]
"""What `websockets` asks before a handshake: an HTTP answer, or none to go on with it."""

Talk = Callable[[ServerConnection], Awaitable[None]]  #: What `websockets` calls for a connection.


@dataclass(frozen=True, kw_only=True)
class OwnPage:
    """A page of our own, beside that of viser and on the same server."""

    path: str  #: Where it is, such as "/operate".
    files: Mapping[str, tuple[str, bytes]]  #: Types and contents of its files, by their paths.
    talk: Talk  #: What speaks with the page, as long as it is open.

    def answer(self, request: Request) -> Response | None:
        """The file that is asked for; none if it is none of this page's."""
        path = request.path.partition("?")[0]
        if path not in self.files or "Upgrade" in request.headers:
            return None
        kind, body = self.files[path]
        headers = {"Content-Type": kind, "Content-Length": str(len(body)), "Cache-Control": "no-cache"}
        framing = UNFRAMED | {"Content-Security-Policy": OWN_POLICY}
        return Response(http.HTTPStatus.OK.value, "OK", Headers(headers | framing), body)

    async def handle(self, other: Talk, connection: ServerConnection) -> None:
        """Speak with the page, if it is the one that connects; else leave it to the other."""
        is_ours = connection.request is not None and connection.request.path.startswith(self.path)
        await (self.talk if is_ours else other)(connection)


@dataclass(frozen=True, kw_only=True)
class RequestCheck:
    """Which requests are answered."""

    names: tuple[str, ...]  #: Names of this machine that a request may be made to; any, if there are none.
    token: str = ""  #: What the address or a cookie must have in it; nothing if empty.
    cookie: str = ""  #: Name of that cookie.

    @classmethod
    def of(cls, host: str) -> "RequestCheck":
        """The check for a server that listens on this address."""
        if is_loopback(host):
            return cls(names=(*LOOPBACK_NAMES, host))
        return cls(names=(), token=secrets.token_urlsafe(24), cookie=f"pixel2catch_{secrets.token_hex(4)}")

    def refusal(self, request: Request) -> str:
        """Why a request is not answered; empty if it is."""
        host, origin = (_only(request.headers, name) for name in ("Host", "Origin"))
        if host is None or (self.names and _name(host) not in self.names):
            return f"This page is for {', '.join(self.names) or 'requests that name one host'}."
        if origin is None and "Upgrade" in request.headers:
            return "A connection must say from which page it comes."
        if origin is not None and origin not in (f"http://{host}", f"https://{host}"):
            return "Another page may not ask this one."
        if self.token and not (self.is_in_address(request) or self._is_in_cookie(request)):
            return "The address must have its token in it, as it was printed."
        return ""

    def is_in_address(self, request: Request) -> bool:
        """Whether the token is in a request's address."""
        given = parse_qs(urlsplit(request.path).query).get("token", [""])[-1]
        return bool(self.token) and secrets.compare_digest(given.encode(), self.token.encode())

    def _is_in_cookie(self, request: Request) -> bool:
        try:
            jar = SimpleCookie(_only(request.headers, "Cookie") or "")
        except CookieError:
            return False
        given = jar[self.cookie].value if self.cookie in jar else ""
        return secrets.compare_digest(given.encode(), self.token.encode())

    def before(self, answer: Answer, own: OwnPage | None = None) -> Answer:
        """The answers of a server, and of a page of our own, to requests that pass."""

        def checked(connection: Any, request: Request) -> Response | None:
            reason = self.refusal(request)
            if reason:
                body = reason.encode()
                headers = Headers(
                    {"Content-Type": "text/plain; charset=utf-8", "Content-Length": str(len(body))}
                )
                return Response(http.HTTPStatus.FORBIDDEN.value, "Forbidden", headers, body)
            response = own.answer(request) if own else None
            if response is None and (response := answer(connection, request)) is not None:
                response.headers.update(FRAMED_BY_OWN if own else UNFRAMED)
            if response is not None and self.is_in_address(request):
                kept = f"{self.cookie}={self.token}; Path=/; HttpOnly; SameSite=Strict"
                response.headers["Set-Cookie"] = kept
            return response

        return checked


@dataclass(frozen=True, kw_only=True)
class PageServer:
    """A server that runs, and where."""

    viser: viser.ViserServer
    address: str  #: What to open in a browser.

    def close(self) -> None:
        """End it."""
        with contextlib.redirect_stdout(io.StringIO()):
            self.viser.stop()


def open_server(cfg: PageCfg, title: str, own: OwnPage | None = None) -> PageServer:
    """Serve an empty page of viser's, and one of our own, to whose address visitors are sent then.

    Raises:
        InvalidValueError: If this machine cannot listen on that address.
    """
    require_address(cfg)
    check = RequestCheck.of(cfg.host)
    with contextlib.redirect_stdout(io.StringIO()), _checked(check, own):
        server = viser.ViserServer(cfg.host, cfg.port, label=title, verbose=False)
    server.gui.configure_theme(show_logo=False, show_share_button=False, control_width="large")
    name = "localhost" if ip_address_of(cfg.host).is_unspecified else cfg.host
    place = f"[{name}]" if ":" in name else name
    path = own.path if own else "/" if check.token else ""
    token = f"?token={check.token}" if check.token else ""
    return PageServer(viser=server, address=f"http://{place}:{server.get_port()}{path}{token}")


def page_files(path: str) -> dict[str, tuple[str, bytes]]:
    """Files of a page of our own by their paths, with their types: the folder of its name, and `link.js`."""
    name, viewer = path.removeprefix("/"), files("pixel2catch.viewer")
    found = {file.name: file.read_bytes() for file in (viewer / "link.js", *(viewer / name).iterdir())}
    contents = {
        f"{path}/{each}": (f"{KINDS[PurePath(each).suffix]}; charset=utf-8", data)
        for each, data in found.items()
    }
    return contents | {path: contents[f"{path}/{name}.html"]}


def is_loopback(host: str) -> bool:
    """Whether only this machine can reach an address."""
    return ip_address_of(host).is_loopback


def ip_address_of(host: str) -> Any:
    """The IP address of a host's name.

    Raises:
        InvalidValueError: If it has none.
    """
    try:
        return ip_address(socket.getaddrinfo(host, None)[0][4][0])
    except (OSError, ValueError) as error:
        raise InvalidValueError(
            f"the page's host is '{host}', which has no address ({error}): give one of this machine's own, "
            "127.0.0.1 for itself or 0.0.0.0 for all."
        ) from None


def require_address(cfg: PageCfg) -> None:
    """See that a server can listen; viser would try a thousand ports and then wait for ever.

    Raises:
        InvalidValueError: If it cannot.
    """
    if not 0 <= cfg.port < 65536:
        raise InvalidValueError(f"the page's port is {cfg.port}; it must be from 0 to 65535.")
    family = socket.AF_INET6 if ip_address_of(cfg.host).version == 6 else socket.AF_INET
    try:
        socket.create_server((cfg.host, 0), family=family).close()
    except OSError as error:
        raise InvalidValueError(
            f"this machine cannot listen on '{cfg.host}' ({error}): give one of its own addresses, 127.0.0.1 "
            "for itself or 0.0.0.0 for all."
        ) from None


@contextlib.contextmanager
def _checked(check: RequestCheck, own: OwnPage | None) -> Iterator[None]:
    """Let the server that is made within ask the check first, and then our own page.

    viser has no place for either.
    """
    module: Any = websockets.asyncio.server
    serve, times = module.serve, 0

    def checked_serve(handle: Any, *args: Any, process_request: Answer, **options: Any) -> Any:
        nonlocal times
        times += 1
        return serve(
            handle if own is None else partial(own.handle, handle),
            *args,
            process_request=check.before(process_request, own),
            **options,
        )

    module.serve = checked_serve
    try:
        yield
    finally:
        module.serve = serve
    if not times:
        raise RuntimeError("viser did not serve through websockets: its requests would not be checked")


def _only(headers: Headers, name: str) -> str | None:
    """The value of a header that is there once."""
    values = headers.get_all(name)
    return values[0] if len(values) == 1 else None


def _name(host: str) -> str:
    """The name in a `Host` header, without its port."""
    try:
        return urlsplit(f"//{host}").hostname or ""
    except ValueError:
        return ""
