"""The web server of every page: viser's, with checks of every request.

Any web page in a browser can send requests to this machine. So a request must name this machine as its host
(against DNS rebinding) and come from the page itself, and no other page may frame it. If other machines can
reach the server, the address has a token, which the browser keeps in a cookie.
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
from pixel2catch.viewer import PageCfg

KINDS = {".html": "text/html", ".js": "text/javascript", ".css": "text/css"}  #: Types of a page's files.

FRAMED = "hideViserLogo"  #: Part of the query with which an own page frames viser's page.
LOOPBACK_NAMES = ("localhost", "127.0.0.1", "::1")  #: Names of this machine in its own browser.

UNFRAMED = {"X-Frame-Options": "DENY", "Content-Security-Policy": "frame-ancestors 'none'"}
"""Headers of every answer: no other page may frame this one."""

FRAMED_BY_OWN = {"X-Frame-Options": "SAMEORIGIN", "Content-Security-Policy": "frame-ancestors 'self'"}
"""Headers of viser's page beside an `OwnPage`, which shows it in a frame."""

OWN_POLICY = "default-src 'self'; img-src 'self' data:; frame-ancestors 'none'"
"""What an `OwnPage` may load: only files of this server, and no inline scripts."""

Answer = Callable[[Any, Request], Response | None]
"""Hook of `websockets` before a handshake: an HTTP answer, or none to continue."""

Talk = Callable[[ServerConnection], Awaitable[None]]  #: Handler of a connection of `websockets`.


@dataclass(frozen=True, kw_only=True)
class OwnPage:
    """An HTML page of this package, beside viser's and on the same server."""

    path: str  #: Its path, such as "/operate".
    files: Mapping[str, tuple[str, bytes]]  #: Types and contents of its files, by path.
    talk: Talk  #: Handler of the connection of an open page.

    def answer(self, request: Request) -> Response | None:
        """Return the requested file, or a redirect from "/" to this page; none for files of viser."""
        path, _, query = request.path.partition("?")
        if "Upgrade" in request.headers:
            return None
        if path == "/" and FRAMED not in query:
            place = f"{self.path}?{query}" if query else self.path
            headers = {"Location": place, "Content-Length": "0"} | UNFRAMED
            return Response(http.HTTPStatus.TEMPORARY_REDIRECT.value, "Temporary Redirect", Headers(headers))
        if path not in self.files:
            return None
        kind, body = self.files[path]
        headers = {"Content-Type": kind, "Content-Length": str(len(body)), "Cache-Control": "no-cache"}
        framing = UNFRAMED | {"Content-Security-Policy": OWN_POLICY}
        return Response(http.HTTPStatus.OK.value, "OK", Headers(headers | framing), body)

    async def handle(self, other: Talk, connection: ServerConnection) -> None:
        """Handle the connection of this page; leave others to the other handler."""
        is_ours = connection.request is not None and connection.request.path.startswith(self.path)
        await (self.talk if is_ours else other)(connection)


@dataclass(frozen=True, kw_only=True)
class RequestCheck:
    """Checks which requests are answered."""

    names: tuple[str, ...]  #: Valid host names of a request; all, if empty.
    token: str = ""  #: Token that the address or a cookie must have; no token if empty.
    cookie: str = ""  #: Name of that cookie.

    @classmethod
    def of(cls, host: str) -> "RequestCheck":
        """Return the check for a server that listens on this address."""
        if ip_address_of(host).is_loopback:
            return cls(names=(*LOOPBACK_NAMES, host))
        return cls(names=(), token=secrets.token_urlsafe(24), cookie=f"pixel2catch_{secrets.token_hex(4)}")

    def refusal(self, request: Request) -> str:
        """Return why a request is refused; empty if it is answered."""
        host, origin = (_only(request.headers, name) for name in ("Host", "Origin"))
        if host is None or (self.names and _name_without_port(host) not in self.names):
            return f"This page is for {', '.join(self.names) or 'requests that name one host'}."
        if origin is None and "Upgrade" in request.headers:
            return "A connection needs an Origin header, the page that it comes from."
        if origin is not None and origin not in (f"http://{host}", f"https://{host}"):
            return "Requests of other pages are refused."
        if self.token and not (self.is_in_address(request) or self._is_in_cookie(request)):
            return "The address must have its token in it, as it was printed."
        return ""

    def is_in_address(self, request: Request) -> bool:
        """Return whether a request's address has the token."""
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
        """Return the hook that refuses a request, or lets the own page or the server answer it."""

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
    """A running server and its address."""

    viser: viser.ViserServer
    address: str  #: Address to open in a browser.

    def close(self) -> None:
        """End the server."""
        with contextlib.redirect_stdout(io.StringIO()):
            self.viser.stop()


def open_server(cfg: PageCfg, title: str, own: OwnPage | None = None) -> PageServer:
    """Serve an empty page of viser, and an own page, if one is given, whose address is then returned.

    Raises:
        InvalidValueError: This machine cannot listen on that address.
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
    """Return types and contents of the files of an own page by path: its folder, and `link.js`."""
    name, viewer = path.removeprefix("/"), files("pixel2catch.viewer")
    found = {file.name: file.read_bytes() for file in (viewer / "link.js", *(viewer / name).iterdir())}
    contents = {
        f"{path}/{each}": (f"{KINDS[PurePath(each).suffix]}; charset=utf-8", data)
        for each, data in found.items()
    }
    return contents | {path: contents[f"{path}/{name}.html"]}


def ip_address_of(host: str) -> Any:
    """Return the IP address of a host's name.

    Raises:
        InvalidValueError: It has none.
    """
    try:
        return ip_address(socket.getaddrinfo(host, None)[0][4][0])
    except (OSError, ValueError) as error:
        raise InvalidValueError(
            f"the page's host is '{host}', which has no address ({error}): give one of this machine's own, "
            "127.0.0.1 for itself or 0.0.0.0 for all."
        ) from None


def require_address(cfg: PageCfg) -> None:
    """Require an address on which a server can listen; viser would try a thousand ports and then hang.

    Raises:
        InvalidValueError: It is not one of this machine.
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
    """Wrap the server that is made in this context, because viser has no hook for requests."""
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
    """Return the value of a header that occurs once."""
    values = headers.get_all(name)
    return values[0] if len(values) == 1 else None


def _name_without_port(host: str) -> str:
    try:
        return urlsplit(f"//{host}").hostname or ""
    except ValueError:
        return ""
