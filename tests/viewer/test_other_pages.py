"""Pages of a training, of a recording and of the twin."""

import csv
import json
import os
import re
import signal
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from websockets.sync.client import connect
from websockets.typing import Origin

from domains import PATIENCE, free_port, own_domain
from pixel2catch.cli.operate import Keys
from pixel2catch.deployment.operator import EVENT, KEY
from pixel2catch.deployment.recorder import BagRecorder
from pixel2catch.errors import DeviceUnavailableError
from pixel2catch.rendering.renderer import find_gl_backend
from pixel2catch.rendering.video import BOX_COLOR
from pixel2catch.ros2 import messages
from pixel2catch.ros2.profile import Profile
from pixel2catch.ros2.transport import LOOPBACK, RealClock, make_transport
from pixel2catch.scene.constants import RGB_CAMERA
from pixel2catch.viewer.config import PageCfg
from pixel2catch.viewer.replay import RecordingPage
from pixel2catch.viewer.server import open_server
from pixel2catch.viewer.train import TrainingCurves, progress_text

PROFILE = Profile.load("ur5e_allegro_v4")
EPOCH = 1_790_000_000.0


def test_progress_in_words():
    row = {"transitions": 250_000.0, "transitions_per_second": 5_000.0, "success_rate": 0.125}
    # 750,000 transitions at 5,000 a second are 150 s.
    assert progress_text(row, 1_000_000) == "**25.0 %**, 2 min 30 s left; success rate 12.5 %"


def test_curves_grow_with_the_metrics_of_a_run(tmp_path: Path):
    rows = [
        {"transitions": 1000 * i, "transitions_per_second": 500, "success_rate": 0.1 * i, "reward/arm": -i}
        for i in (1, 2, 3)
    ]
    server = open_server(PageCfg(port=free_port()), "training")
    curves = TrainingCurves(server.viser.gui, tmp_path, 10_000)
    curves.update()
    assert curves.text.content == "no update yet"
    for count in (2, 3):
        with open(tmp_path / "metrics.csv", "w", newline="") as file:
            writer = csv.DictWriter(file, [*rows[0]])
            writer.writeheader()
            writer.writerows(rows[:count])
        curves.update()
        assert curves.num_rows == count
    assert "**30.0 %**, 0 min 14 s left" in curves.text.content
    server.close()


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    """A tenth of a second in which the robot turns from its first joint position, and an image with a box."""
    part = PROFILE.robots[0]
    names = [joint.name_in_state for joint in part.joints.values()]
    with BagRecorder(tmp_path / "rec") as recorder:
        for i in range(10):
            stamp = EPOCH + 0.01 * i
            position = np.full(len(names), 0.1 * i)
            state = messages.joint_state(names, position, stamp, np.zeros(len(names)))
            recorder.record(part.state_topic, state, stamp)
        status = messages.text('{"mode": "run", "box": [100, 50, 120, 80]}')
        recorder.record(PROFILE.operator.status, status, EPOCH + 0.01)
        pixels = np.zeros((RGB_CAMERA.height, RGB_CAMERA.width, 3), np.uint8)
        image = messages.image(pixels, EPOCH, "camera")
        recorder.record(PROFILE.camera.image, image, EPOCH + 0.05)
    return tmp_path / "rec"


def test_a_recording_is_played_and_played_again(recording: Path):
    page = RecordingPage(PageCfg(port=free_port()), recording, PROFILE, RGB_CAMERA)
    page.playback.set_speed(100.0)
    with ThreadPoolExecutor(1) as pool:
        playing = pool.submit(page.run)

        def wait_for_image() -> None:
            end = time.monotonic() + PATIENCE
            while not (page.picture.image == BOX_COLOR).all(axis=-1).any():
                assert time.monotonic() < end
                assert not playing.done()
                time.sleep(0.02)

        wait_for_image()
        assert page.words.content == "**running: follows the policy** "
        assert "| servo | run |" in page.table.content
        assert not page.wire.view.bodies["thrower"].visible
        page.picture.show(np.zeros_like(page.picture.image))
        page.begin()
        wait_for_image()
        page.close()
        playing.result(PATIENCE)
    page.free()


@contextmanager
def started(*args: str | Path) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """A command that serves a page, and the page's address."""
    command = [sys.executable, "-m", "pixel2catch", *map(str, args), "--port", str(free_port())]
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


def is_served(address: str) -> bool:
    with urllib.request.urlopen(address, timeout=PATIENCE) as answer:
        return answer.status == 200


@pytest.mark.slow
def test_a_training_has_a_page(tmp_path: Path):
    args = ("--preset", "cpu", "--num-envs", "2", "--transitions", "1000000", "--out", tmp_path / "run")
    with started("train", *args, "--web") as (_, address):
        assert is_served(address)


@pytest.mark.slow
def test_a_recording_has_a_page(recording: Path):
    with started("replay", recording, "--web") as (_, address):
        assert is_served(address)


@pytest.mark.slow
def test_the_twin_has_a_page():
    try:
        find_gl_backend()
    except DeviceUnavailableError as error:
        pytest.skip(str(error))
    with started("twin", "--web", "--clock", "0.2", "--domain", own_domain()) as (_, address):
        assert is_served(address)


@pytest.mark.slow
def test_an_operator_has_a_page_whose_switch_is_let_go_at_its_end(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("ROS_DOMAIN_ID", own_domain())
    with (
        make_transport("dds", "laboratory", LOOPBACK, RealClock()) as node,
        started("operate", "--web") as (process, address),
    ):
        heard = node.subscription(PROFILE.operator.dead_man, depth=1000)
        link = f"{address.replace('http', 'ws')}/operate/link"
        with connect(link, origin=Origin(address), open_timeout=PATIENCE) as visitor:
            said: list[bool] = []
            end = time.monotonic() + PATIENCE
            while True not in said:  # on a slow machine a browser may be silent for too long: it presses anew
                assert time.monotonic() < end
                for do in ("press", "hold"):
                    visitor.send(json.dumps({"do": do}))
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
        connect(f"{address.replace('http', 'ws')}/operate/link", origin=Origin(address)) as visitor,
    ):
        keys.write(EVENT.pack(1, 2, KEY, Keys().hold[0], 1))
        states = (json.loads(said) for said in visitor if isinstance(said, str))
        state = next(state for state in states if state["is_held"])
        assert not state["has_switch"]
