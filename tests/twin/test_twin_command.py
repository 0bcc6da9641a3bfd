"""The command itself, over DDS."""

import json
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from typing import Any

import pytest

from domains import PATIENCE, own_domain
from pixel2catch.errors import DeviceUnavailableError
from pixel2catch.rendering.renderer import find_gl_backend
from pixel2catch.ros2 import messages
from pixel2catch.ros2.profile import Profile
from pixel2catch.ros2.transport import LOOPBACK, RealClock, make_transport
from pixel2catch.twin.lab_node import COMMAND, STATE

RATE = 0.5


@pytest.fixture
def twin(monkeypatch: pytest.MonkeyPatch) -> Iterator[subprocess.Popen[str]]:
    try:
        find_gl_backend()
    except DeviceUnavailableError as error:
        pytest.skip(str(error))
    monkeypatch.setenv("ROS_DOMAIN_ID", own_domain())
    command = [sys.executable, "-m", "pixel2catch", "twin", "--clock", str(RATE), "--objects", "cube_s"]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    yield process
    process.kill()
    process.wait()
    assert process.stderr is not None
    process.stderr.close()


def test_it_throws_when_asked_and_ends_with_ctrl_c(twin: subprocess.Popen[str]):
    clock, profile = RealClock(RATE), Profile.load("ur5e_allegro_v4")
    with make_transport("dds", "operator", LOOPBACK, clock) as node:
        states, requests = node.subscription(STATE, depth=100_000), node.publisher(COMMAND)
        begin = clock.stamp()
        images = node.subscription(profile.camera.image, depth=4)

        def wait_for(phase: str) -> dict[str, Any]:
            end = time.monotonic() + PATIENCE
            while time.monotonic() < end:
                node.wait(0.1)
                for message in states.take():
                    state = json.loads(messages.read_text(message.data))
                    if state["phase"] == phase:
                        return state
            raise AssertionError(f"never {phase}")

        wait_for("empty")
        requests.publish(messages.text('{"do": "prepare", "seed": 3}'))
        state, seen = wait_for("held"), []
        while len(seen) < 16:  # the first are of the time before
            seen += images.take()
            wait_for("held")
        reading = messages.read_image(seen[-1].data)
        assert begin < reading.stamp < clock.stamp()
        xmin, ymin, xmax, ymax = (round(edge) for edge in state["box"])
        shown = reading.pixels[ymin:ymax, xmin:xmax].astype(int)
        assert (shown[..., 0] > 1.8 * shown[..., 1]).mean() > 0.5  # the cube is red
        requests.publish(messages.text('{"do": "throw"}'))
        assert wait_for("flying")["throw"] == 1
    twin.send_signal(signal.SIGINT)
    _, said = twin.communicate(timeout=PATIENCE)
    assert twin.returncode == 0, said
    assert "cube_s held; program runs" in said
    assert "throw 1: cube_s flying" in said
    assert "cycles" in said.splitlines()[-1]


PARENT = """
import time
from multiprocessing import get_context
from pixel2catch.interruption import end_with_parent

def wait():
    end_with_parent()
    print(1, flush=True)
    time.sleep(600)

child = get_context("fork").Process(target=wait)
child.start()
child.join()
"""


def test_a_child_ends_with_its_killed_parent():
    """As the process that draws, and those of pages."""
    parent = subprocess.Popen([sys.executable, "-c", PARENT], stdout=subprocess.PIPE)
    assert parent.stdout is not None
    assert parent.stdout.readline() == b"1\n"
    parent.kill()
    assert parent.stdout.read() == b""  # the pipe is closed when the child has ended, too
    parent.communicate()
