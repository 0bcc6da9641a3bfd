"""Taking the images of a calibration: which are taken, and the calibration from them."""

import csv
import os
import signal
import threading
from pathlib import Path

import cv2
import numpy as np
import pytest
from calibration_views import board_in_camera, poses, rendered

from domains import PATIENCE, own_domain
from pixel2catch.camera.camera_file import CameraFile
from pixel2catch.camera.image import Image
from pixel2catch.cli.main import main
from pixel2catch.perception.calibration.capture import Capture, blur
from pixel2catch.perception.calibration.lens import CharucoBoard, read_image
from pixel2catch.robots.ur5e import ARM
from pixel2catch.ros2 import messages
from pixel2catch.ros2.profile import Profile
from pixel2catch.ros2.transport import LOOPBACK, RealClock, make_transport
from pixel2catch.scene.constants import RGB_CAMERA

JOINTS = [joint.name for joint in ARM.joints]
PROFILE = Profile.load("ur5e_allegro_v4")


def image_of(joint_pos: np.ndarray, seed: int = 0) -> np.ndarray:
    return cv2.cvtColor(rendered(board_in_camera(joint_pos), np.random.default_rng(seed)), cv2.COLOR_BGR2RGB)


@pytest.fixture(scope="module")
def pose() -> np.ndarray:
    return list(poses(4, seed=2))[3]  # a near one


@pytest.fixture(scope="module")
def picture(pose: np.ndarray) -> np.ndarray:
    return image_of(pose)


class Session:
    """Images shown to a capture, 0.1 s apart."""

    def __init__(self, folder: Path) -> None:
        self.capture = Capture(folder, CharucoBoard(), JOINTS)
        self._time = 0.0

    def show(self, pixels: np.ndarray, joint_pos: np.ndarray | None, times: int = 5) -> list[str]:
        said = []
        for _ in range(times):
            self._time += 0.1
            image = Image(pixels=pixels, stamp=self._time, joint_pos=joint_pos)
            said.append(self.capture.look(image))
        return said


def test_a_still_view_is_taken_once(tmp_path: Path, pose: np.ndarray, picture: np.ndarray):
    session = Session(tmp_path / "views")
    said = session.show(picture, pose)
    assert said[0] == "hold still"
    assert said[3] == "1 of 15: wrote pose01.png"
    assert said[4].startswith("like pose01.png")
    with open(tmp_path / "views" / "views.csv", newline="", encoding="utf-8") as file:
        (row,) = csv.DictReader(file)
    assert [float(row[joint]) for joint in JOINTS] == pose.tolist()
    assert np.array_equal(read_image(tmp_path / "views" / row["image"]), picture)


def test_an_unsuitable_image_is_refused_with_a_reason(tmp_path: Path, pose: np.ndarray, picture: np.ndarray):
    session = Session(tmp_path / "views")
    assert session.show(np.full_like(picture, 90), pose)[-1].startswith("no board: show all of it")
    assert session.show(picture, None)[-1].startswith("no positions of the arm's joints")
    assert session.show(cv2.GaussianBlur(picture, (0, 0), 1.4), pose)[-1].startswith("blurred (")
    session.show(np.full_like(picture, 90), pose)
    moving = [session.show(picture, pose + 2e-3 * i, times=1)[0] for i in range(8)]
    assert all(words.startswith("hold still") for words in moving)
    assert not session.capture.taken


@pytest.mark.parametrize("spread", [0.8, 1.4])
def test_blur_is_measured_in_pixels(pose: np.ndarray, picture: np.ndarray, spread: float):
    """The rendered image has a spread of 0.7 px and that of its own pixels; Gaussians add in squares."""
    view = CharucoBoard().find(picture)
    assert view is not None
    sharp = blur(picture, view)
    assert 0.5 < sharp < 1.2
    blurred = blur(cv2.GaussianBlur(picture, (0, 0), spread), view)
    assert blurred == pytest.approx(np.hypot(sharp, spread), rel=0.25)


def show_poses(folder: Path, num: int, done: threading.Event) -> None:
    """Be a camera and an arm on the network: show a pose until its image is there, then the next."""
    clock, topics = RealClock(), (PROFILE.camera.image, PROFILE.robots[0].state_topic)
    with make_transport("camera_and_arm", LOOPBACK, clock) as node:
        image, state = map(node.publisher, topics)
        for number, joint_pos in enumerate(poses(num, seed=2), start=1):
            picture = image_of(joint_pos, number)
            while not (folder / f"pose{number:02d}.png").exists():
                if done.wait(0.05):
                    return
                stamp = clock.stamp()
                state.publish(messages.joint_state(JOINTS, joint_pos, stamp))
                image.publish(messages.image(picture, stamp))
        os.kill(os.getpid(), signal.SIGINT)  # as an operator who has had enough


@pytest.mark.slow
def test_a_camera_on_the_network_is_calibrated_as_the_arm_moves(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.setenv("ROS_DOMAIN_ID", own_domain())
    CameraFile(camera=RGB_CAMERA).save(tmp_path / "lens.json")
    done = threading.Event()
    robot = threading.Thread(target=show_poses, args=(tmp_path / "views", 8, done), daemon=True)
    robot.start()
    args = ["--live", "--intrinsics", tmp_path / "lens.json", "--capture", tmp_path / "views"]
    try:
        assert main(["calibrate", *map(str, args), "--out", str(tmp_path / "camera.json")]) == 0
    finally:
        done.set()
        robot.join(PATIENCE)
    printed = capsys.readouterr()
    assert "8 of 15: wrote pose08.png" in printed.err
    assert "By the arm's motion the squares are" in printed.out
    found = CameraFile.load(tmp_path / "camera.json")
    error = np.abs(np.subtract(found.camera.pos, RGB_CAMERA.pos))
    assert (error < 3.0 * np.array(found.pos_std)).all()
    assert len(list((tmp_path / "views").glob("*.png"))) == 8
    assert main(["calibrate", *map(str, args), "--out", str(tmp_path / "other.json")]) == 2
    assert "views' is not an empty folder" in capsys.readouterr().err
