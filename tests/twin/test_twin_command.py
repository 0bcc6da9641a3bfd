"""The command itself, over DDS."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from domains import PATIENCE, own_domain
from pixel2catch.errors import DeviceUnavailableError
from pixel2catch.mdp.dynamics_file import DynamicsFile
from pixel2catch.rendering.renderer import find_gl_backend
from pixel2catch.robots.joint_dynamics import JointDynamics
from pixel2catch.ros2 import messages
from pixel2catch.ros2.factory import make_transport
from pixel2catch.ros2.profile import Profile
from pixel2catch.ros2.transport import LOOPBACK, RealClock
from pixel2catch.twin.lab_node import COMMAND, STATE

RATE = 0.5
DOMAIN = own_domain()


@pytest.fixture
def twin(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[subprocess.Popen[str]]:
    try:
        find_gl_backend()
    except DeviceUnavailableError as error:
        pytest.skip(str(error))
    monkeypatch.setenv("ROS_DOMAIN_ID", DOMAIN)
    command = [sys.executable, "-m", "pixel2catch", "twin", "--clock", str(RATE), "--objects", "cube_s"]
    command += ["--draw-dynamics", str(tmp_path / "truth.json")]
    environment = {name: value for name, value in os.environ.items() if name != "ROS_DOMAIN_ID"}
    process = subprocess.Popen(
        [*command, "--domain", DOMAIN], env=environment, stderr=subprocess.PIPE, text=True
    )
    yield process
    process.kill()
    process.wait()
    assert process.stderr is not None
    process.stderr.close()


def test_it_throws_when_asked_and_ends_with_ctrl_c(twin: subprocess.Popen[str], tmp_path: Path):
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
    truth = DynamicsFile.load(tmp_path / "truth.json")
    assert set(truth.gains.stiffness_scale) == {(1.0, 1.0)}  # known exactly
    factors = truth.dynamics.stiffness / JointDynamics.nominal().stiffness
    assert 0.7 <= factors.min() < 0.9 < 1.1 < factors.max() <= 1.4


def test_a_killed_twin_leaves_no_process_behind(twin: subprocess.Popen[str]):
    assert twin.stderr is not None
    while "the room is empty" not in (line := twin.stderr.readline()):
        assert line, "it has ended"
    children = Path(f"/proc/{twin.pid}/task/{twin.pid}/children").read_text().split()
    assert children  # one of them draws
    twin.kill()
    end = time.monotonic() + PATIENCE
    while any(is_alive(number) for number in children):
        assert time.monotonic() < end
        time.sleep(0.1)


def is_alive(number: str) -> bool:
    try:
        stat = Path(f"/proc/{number}/stat").read_text()
    except (FileNotFoundError, ProcessLookupError):
        return False
    return stat.rpartition(")")[2].split()[0] != "Z"  # ended, and nobody has looked yet


def test_without_opengl_it_says_what_to_install(tmp_path: Path):
    environment = os.environ | {"PYOPENGL_PLATFORM": "egl", "__EGL_VENDOR_LIBRARY_DIRS": str(tmp_path)}
    command = [sys.executable, "-m", "pixel2catch", "twin", "--domain", DOMAIN]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 2, done.stderr
    assert "apt-get install" in done.stderr
