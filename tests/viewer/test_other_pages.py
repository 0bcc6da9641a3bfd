"""Pages of the commands `twin` and `operate`."""

import json
import os
import re
import signal
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from websockets.sync.client import connect
from websockets.typing import Origin

from domains import PATIENCE, free_port, own_domain
from pixel2catch.cli.operate import KEYS
from pixel2catch.deployment.operator import EVENT, KEY
from pixel2catch.ros2 import messages
from pixel2catch.ros2.profile import Profile
from pixel2catch.ros2.transport import LOOPBACK, RealClock, make_transport

PROFILE = Profile.load("ur5e_allegro_v4")


@contextmanager
def started(*args: str | Path) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """A command that serves a page, and the page's address."""
    command = [sys.executable, "-m", "pixel2catch", *map(str, args), "--address", f"127.0.0.1:{free_port()}"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    try:
        assert process.stdout is not None
        for line in process.stdout:
            if found := re.search(r"http://127\.0\.0\.1:\d+", line):
                yield process, found[0]
                break
        else:
            raise AssertionError("it named no page")
    finally:
        process.terminate()
        process.communicate(timeout=PATIENCE)


@pytest.mark.slow
@pytest.mark.usefixtures("opengl")
def test_the_twin_has_a_page(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("ROS_DOMAIN_ID", own_domain())
    with (
        started("twin", "--web", "--clock", "0.2") as (_, address),
        urllib.request.urlopen(address, timeout=PATIENCE) as answer,
    ):
        assert answer.status == 200


@pytest.mark.slow
def test_an_operator_has_a_page_whose_switch_is_let_go_at_its_end(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("ROS_DOMAIN_ID", own_domain())
    with (
        make_transport("laboratory", LOOPBACK, RealClock()) as node,
        started("operate", "--web") as (process, address),
    ):
        heard = node.subscription(PROFILE.operator.dead_man, depth=1000)
        link = f"{address.replace('http', 'ws')}/link"
        with connect(link, origin=Origin(address), open_timeout=PATIENCE) as visitor:
            said: list[bool] = []
            end = time.monotonic() + PATIENCE
            while True not in said:  # on a slow machine a browser may be silent for too long: it presses anew
                assert time.monotonic() < end
                newest = visitor.recv(PATIENCE)
                if isinstance(newest, str) and "time" in (state := json.loads(newest)):
                    for do in ("press", "hold"):
                        visitor.send(json.dumps({"do": do, "heard": state["time"]}))
                node.wait(0.01)
                said += [messages.read_boolean(message.data) for message in heard.take()]
            process.send_signal(signal.SIGINT)
            while said[-1]:
                assert time.monotonic() < end
                node.wait(0.01)
                said += [messages.read_boolean(message.data) for message in heard.take()]
        process.wait(PATIENCE)
        assert process.returncode == 0


@pytest.mark.slow
def test_beside_a_pedal_the_page_has_no_switch(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("ROS_DOMAIN_ID", own_domain())
    pedal = tmp_path / "pedal"
    os.mkfifo(pedal)
    with (
        open(os.open(pedal, os.O_RDWR), "wb", buffering=0) as keys,
        started("operate", pedal, "--web") as (_, address),
        connect(f"{address.replace('http', 'ws')}/link", origin=Origin(address)) as visitor,
    ):
        keys.write(EVENT.pack(1, 2, KEY, KEYS[0][0], 1))
        states = (json.loads(said) for said in visitor if isinstance(said, str))
        state = next(state for state in states if state["is_held"])
        assert not state["has_switch"]
