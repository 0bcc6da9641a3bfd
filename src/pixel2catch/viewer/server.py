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
from http.cookies import CookieError, SimpleCookie
from importlib.resources import files
from ipaddress import IPv4Address, IPv6Address, ip_address
from typing import Any
from urllib.parse import parse_qs, urlsplit

import viser
import websockets.asyncio.server
from websockets import Headers
from websockets.asyncio.server import ServerConnection
from websockets.http11 import Request, Response

from pixel2catch.errors import InvalidValueError
from pixel2catch.viewer import PageCfg

LOOPBACK_NAMES = ("localhost", "127.0.0.1", "::1")  #: Names of this machine in its own browser.

UNFRAMED = {"X-Frame-Options": "DENY", "Content-Security-Policy": "frame-ancestors 'none'"}
"""Headers of every answer: no other page may frame this one."""

OWN_POLICY = "default-src 'self'; img-src 'self' data:; frame-ancestors 'none'"
"""What the operator's page may load: only files of this server, and no inline scripts."""

Answer = Callable[[Any, Request], Response | None]
"""Hook of `websockets` before a handshake: an HTTP answer, or none to continue."""

Talk = Callable[[ServerConnection], Awaitable[None]]  #: Handler of a connection of `websockets`.


def own_files() -> dict[str, tuple[str, bytes]]:
    """Return types and contents of the files of the operator's page, by path."""
    own, kinds = dict[str, tuple[str, bytes]](), {"html": "html", "js": "javascript", "css": "css"}
    for file in (files("pixel2catch.viewer") / "operate").iterdir():
        kind = kinds[file.name.rpartition(".")[2]]
        own[f"/{file.name}"] = f"text/{kind}; charset=utf-8", file.read_bytes()
    return own | {"/": own["/index.html"]}


def _response(status: http.HTTPStatus, kind: str, body: bytes, **headers: str) -> Response:
    headers |= {"Content-Type": kind, "Content-Length": str(len(body))}
    return Response(status.value, status.phrase, Headers(headers), body)


@dataclass(frozen=True, kw_only=True)
class RequestCheck:
    """Checks which requests are answered."""

    names: tuple[str, ...]  #: Valid host names in a request's Host header; all if empty.
    token: str = ""  #: Token that the address or a cookie must have; no token if empty.
    cookie: str = ""  #: Name of that cookie.

    @classmethod
    def of(cls, host: str, *, is_loopback: bool) -> "RequestCheck":
        """Return the check for a server that listens on this host."""
        if is_loopback:
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
        """Return whether the URL of a request has the valid token."""
        given = parse_qs(urlsplit(request.path).query).get("token", [""])[-1]
        return bool(self.token) and secrets.compare_digest(given.encode(), self.token.encode())

    def _is_in_cookie(self, request: Request) -> bool:
        try:
            jar = SimpleCookie(_only(request.headers, "Cookie") or "")
        except CookieError:
            return False
        given = jar[self.cookie].value if self.cookie in jar else ""
        return secrets.compare_digest(given.encode(), self.token.encode())

    def before(self, answer: Answer, own: Mapping[str, tuple[str, bytes]]) -> Answer:
        """Return the hook that refuses a request, answers it with an own file, or lets the server answer."""

        def checked(connection: Any, request: Request) -> Response | None:
            if reason := self.refusal(request):
                return _response(http.HTTPStatus.FORBIDDEN, "text/plain; charset=utf-8", reason.encode())
            path = request.path.partition("?")[0]
            if path in own and "Upgrade" not in request.headers:
                response = _response(http.HTTPStatus.OK, *own[path])
                response.headers.update(UNFRAMED | {"Content-Security-Policy": OWN_POLICY})
            elif (response := answer(connection, request)) is not None:
                response.headers.update(UNFRAMED)
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
        with contextlib.redirect_stdout(io.StringIO()):
            self.viser.stop()


def open_server(cfg: PageCfg, title: str, talk: Talk | None = None) -> PageServer:
    """Serve an empty page of viser, or, if a handler of its connections is given, the operator's page."""
    address = listening_address(cfg.host)
    check = RequestCheck.of(cfg.host, is_loopback=address.is_loopback)
    with contextlib.redirect_stdout(io.StringIO()), _checked(check, talk):
        server = viser.ViserServer(cfg.host, cfg.port, label=title, verbose=False)
    server.gui.configure_theme(show_logo=False, show_share_button=False, control_width="large")
    name = "localhost" if address.is_unspecified else cfg.host
    place = f"[{name}]" if ":" in name else name
    token = f"/?token={check.token}" if check.token else ""
    return PageServer(viser=server, address=f"http://{place}:{server.get_port()}{token}")


def listening_address(host: str) -> IPv4Address | IPv6Address:
    """Return the IP address of a host on which this machine can listen; raise InvalidValueError for others.

    On any other address viser would try a thousand ports and then hang.
    """
    try:
        address = ip_address(socket.getaddrinfo(host, None)[0][4][0])
        family = socket.AF_INET6 if address.version == 6 else socket.AF_INET
        socket.create_server((host, 0), family=family).close()
    except (OSError, ValueError) as error:
        fix = "127.0.0.1 for itself or 0.0.0.0 for all its addresses"
        raise InvalidValueError(f"this machine cannot listen on '{host}' ({error}): give {fix}.") from None
    return address


@contextlib.contextmanager
def _checked(check: RequestCheck, talk: Talk | None) -> Iterator[None]:
    """Wrap the server that is made in this context, because viser has no hook for requests."""
    module: Any = websockets.asyncio.server
    serve, times, own = module.serve, 0, own_files() if talk else {}

    def checked_serve(handle: Any, *args: Any, process_request: Answer, **options: Any) -> Any:
        nonlocal times
        times += 1
        return serve(talk or handle, *args, process_request=check.before(process_request, own), **options)

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
