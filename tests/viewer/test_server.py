"""Who may ask a page: its owner's browser, from the page itself."""

import re
import signal
import subprocess
import sys
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import closing
from typing import Any

import pytest
import viser
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect
from websockets.typing import Origin, Subprotocol

from domains import PATIENCE, free_port, own_domain
from pixel2catch.errors import InvalidValueError
from pixel2catch.viewer import PageCfg
from pixel2catch.viewer.server import PageServer, open_server

PROTOCOL = Subprotocol(f"viser-v{viser.__version__}")


@pytest.fixture(scope="module")
def own() -> Iterator[PageServer]:
    with closing(open_server(PageCfg(address=f"127.0.0.1:{free_port()}"), "own")) as server:
        yield server


def status(address: str, **headers: str) -> int:
    request = urllib.request.Request(address, headers=headers)
    try:
        with urllib.request.urlopen(request, timeout=PATIENCE) as answer:
            return answer.status
    except urllib.error.HTTPError as error:
        with error:
            return error.code


def handshake(address: str, origin: str | None, **headers: str) -> int:
    """Status of the answer to a page's connection: 101 if it may press buttons."""
    try:
        with connect(
            address.replace("http://", "ws://"),
            origin=None if origin is None else Origin(origin),
            subprotocols=[PROTOCOL],
            additional_headers=headers,
            open_timeout=PATIENCE,
        ):
            return 101
    except InvalidStatus as error:
        return error.response.status_code


def test_its_own_page_is_answered_by_any_name_of_this_machine(own: PageServer):
    port = own.viser.get_port()
    assert own.address == f"http://127.0.0.1:{port}"
    for host in (f"127.0.0.1:{port}", f"localhost:{port}", f"[::1]:{port}", "localhost:1234"):
        assert status(own.address, Host=host) == 200
    assert handshake(own.address, own.address) == 101


def test_a_foreign_page_cannot_press_a_button(own: PageServer):
    port = own.viser.get_port()
    assert handshake(own.address, "http://evil.example") == 403
    assert handshake(own.address, f"http://evil.example:{port}") == 403
    assert handshake(own.address, f"http://127.0.0.1:{port + 1}") == 403  # another server on this machine
    assert handshake(own.address, "null") == 403  # a file, or a sandboxed frame
    assert handshake(own.address, None) == 403
    assert status(own.address, Origin="http://evil.example") == 403


@pytest.mark.parametrize("host", ["127.0.0.1.evil.example", "["])
def test_a_foreign_name_that_leads_here_is_refused(own: PageServer, host: str):
    """DNS rebinding: the browser takes the page for one of evil.example's own."""
    assert status(own.address, Host=host) in (400, 403)


async def talk(visitor: Any) -> None:
    await visitor.send("hello")


def test_the_operators_page_is_as_closed_as_the_other():
    server = open_server(PageCfg(address=f"127.0.0.1:{free_port()}"), "ours", talk)
    root = server.address
    for name, kind in (("/", "text/html"), ("/operate.js", "text/javascript"), ("/operate.css", "text/css")):
        with urllib.request.urlopen(root + name, timeout=PATIENCE) as answer:
            assert answer.headers.get_content_type() == kind
            assert "default-src 'self'" in answer.headers["Content-Security-Policy"]
            assert answer.headers["X-Frame-Options"] == "DENY"
    assert status(root, Host="evil.example") == status(root, Origin="http://evil") == 403
    for origin in ("http://evil.example", "null", None):
        assert handshake(f"{root}/link", origin) == 403
    with connect(f"{root.replace('http', 'ws')}/link", origin=Origin(root), open_timeout=PATIENCE) as ours:
        assert ours.recv(PATIENCE) == "hello"
    server.close()


@pytest.fixture
def shared() -> Iterator[PageServer]:
    with closing(open_server(PageCfg(address=f"0.0.0.0:{free_port()}"), "shared")) as server:
        yield server


def test_others_need_the_token_of_its_address(shared: PageServer):
    plain = f"http://127.0.0.1:{shared.viser.get_port()}"
    token = shared.address.partition("?token=")[2]
    assert len(token) >= 32
    assert status(plain) == status(f"{plain}/?token={token[:-1]}") == status(f"{plain}/?token=") == 403
    assert handshake(plain, plain) == 403
    with urllib.request.urlopen(f"{plain}/?token={token}", timeout=PATIENCE) as answer:
        cookie = answer.headers["Set-Cookie"]
    assert "HttpOnly" in cookie
    assert "SameSite=Strict" in cookie
    kept = cookie.partition(";")[0]
    assert handshake(plain, plain, Cookie=kept) == 101
    assert handshake(plain, "http://evil.example", Cookie=kept) == 403
    assert handshake(plain, plain, Cookie=kept[:-1]) == 403


def test_a_taken_port_leads_to_the_next(own: PageServer):
    other = open_server(PageCfg(address=f"127.0.0.1:{own.viser.get_port()}"), "other")
    assert other.viser.get_port() > own.viser.get_port()
    other.close()


@pytest.mark.parametrize(
    ("cfg", "words"),
    [
        (PageCfg(address="no.such.host.example:8080"), "no.such.host.example"),
        (PageCfg(address="192.0.2.1:8080"), "192.0.2.1"),  # reserved for documents: nobody's
    ],
)
def test_an_address_that_is_not_this_machines_is_refused(cfg: PageCfg, words: str):
    with pytest.raises(InvalidValueError, match=words):
        open_server(cfg, "nowhere")


@pytest.mark.slow
@pytest.mark.usefixtures("opengl")
@pytest.mark.parametrize("args", ["twin --web --clock 0.2", "operate --web"])
def test_a_command_serves_its_page(args: str, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("ROS_DOMAIN_ID", own_domain())
    command = [sys.executable, "-m", "pixel2catch", *args.split(), "--address", f"127.0.0.1:{free_port()}"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as process:
        assert process.stdout is not None
        lines = iter(process.stdout)
        address = next(found[0] for line in lines if (found := re.search(r"http://[\d.]+:\d+", line)))
        assert status(address) == 200
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=PATIENCE)
        assert process.returncode == 0
