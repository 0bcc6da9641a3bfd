"""A board in the hand of a robot, seen by a camera with known pose: corners, and rendered images."""

from collections.abc import Callable, Iterator
from contextlib import nullcontext
from dataclasses import replace
from functools import cache

import cv2
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from pixel2catch.camera.camera_file import CameraFile
from pixel2catch.cli.link import Network
from pixel2catch.deployment.control_loop import StepClock
from pixel2catch.perception.calibration.extrinsics import HandView
from pixel2catch.perception.calibration.lens import SQUARE, SQUARES, BoardView, CharucoBoard
from pixel2catch.robots.geometry import chain_of
from pixel2catch.robots.poses import pose_matrix
from pixel2catch.robots.ur5e import ARM
from pixel2catch.ros2 import messages
from pixel2catch.ros2.memory import Broker
from pixel2catch.ros2.profile import Profile
from pixel2catch.scene.constants import RGB_CAMERA, CameraSpec
from pixel2catch.workcells.ur5e_allegro import UR5E_ALLEGRO

HOME = np.array([joint.home for joint in ARM.joints])
REACH = np.array((0.4, 0.35, 0.35, 0.5, 0.6, 0.9))
"""How far the arm goes from its start pose [rad]: within the UR5e's range, wider than a policy's."""

GREY = 127
MARGIN = 0.015
"""White edge of the board [m]."""

COLUMNS, ROWS = SQUARES
CORNERS = SQUARE * np.array([(x, y, 0) for y in range(1, ROWS) for x in range(1, COLUMNS)], dtype=float)
OUTLINE = SQUARE * np.array([(x, y, 0) for y in (0, ROWS) for x in (0, COLUMNS)], dtype=float)

BOARD = np.eye(4)
BOARD[:3, :3] = Rotation.from_euler("yx", (-90.0, 12.0), degrees=True).as_matrix()
BOARD[:3, 3] = 0.02, 0.05, -0.08
"""The board in the hand: its back on the palm, a little askew."""


def camera_pose(camera: CameraSpec) -> np.ndarray:
    return pose_matrix(camera.pos, camera.quat)


def lens(distortion: tuple[float, ...] = ()) -> CameraFile:
    return CameraFile(camera=RGB_CAMERA, distortion=distortion)


def palm(joint_pos: np.ndarray) -> np.ndarray:
    """Pose of the palm in the world at joint positions [rad]."""
    chain = chain_of(UR5E_ALLEGRO, UR5E_ALLEGRO.palms[0])
    return chain.link_poses(torch.from_numpy(joint_pos)[None])[0, -1].numpy()


def board_in_camera(joint_pos: np.ndarray, camera: CameraSpec = RGB_CAMERA) -> np.ndarray:
    return np.linalg.inv(camera_pose(camera)) @ palm(joint_pos) @ BOARD


def drawn_lens(rng: np.random.Generator) -> CameraFile:
    """A lens near the policies': focal length 0.3 %, axis 2 px, (k1, k2, p1, p2) 0.1, 0.1, 0.0005, 0.0005."""
    zoom, camera = 1.0 + rng.normal(0, 0.003), RGB_CAMERA
    cx, cy = np.array((camera.cx, camera.cy)) + rng.normal(0, 2.0, 2)
    camera = replace(camera, fx=zoom * camera.fx, fy=zoom * camera.fy, cx=float(cx), cy=float(cy))
    return CameraFile(camera=camera, distortion=tuple(rng.normal(0, (0.1, 0.1, 5e-4, 5e-4)).tolist()))


def near_views(rng: np.random.Generator, num: int, lens: CameraFile, tilt: float = 0.5) -> list[BoardView]:
    """Views of a board 0.4 to 0.7 m from a camera, turned about each of its axes by up to `tilt` [rad]."""
    views = []
    while len(views) < num:
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_rotvec(rng.uniform(-tilt, tilt, 3)).as_matrix()
        middle = np.array((*rng.uniform(-0.2, 0.2, 2), rng.uniform(0.4, 0.7)))
        pose[:3, 3] = middle - pose[:3, :3] @ CORNERS.mean(axis=0)
        pixels = pixels_of(pose, OUTLINE, lens)
        if (pixels > 8).all() and (pixels < np.array((632, 472))).all():
            seen = pixels_of(pose, CORNERS, lens) + rng.normal(0, 0.2, (len(CORNERS), 2))
            views.append(BoardView(points=CORNERS, pixels=seen))
    return views


def pixels_of(pose: np.ndarray, points: np.ndarray, lens: CameraFile) -> np.ndarray:
    seen = points @ pose[:3, :3].T + pose[:3, 3]
    matrix, distortion = np.array(lens.camera.matrix), np.array(lens.distortion or np.zeros(4))
    pixels, _ = cv2.projectPoints(seen, np.zeros(3), np.zeros(3), matrix, distortion)
    return pixels[:, 0]


def poses(num: int, seed: int = 0) -> Iterator[np.ndarray]:
    """Joint positions [rad] at which the camera sees the whole board, not too much from the side."""
    rng = np.random.default_rng(seed)
    while num:
        joint_pos = HOME + REACH * rng.uniform(-1, 1, 6)
        pose = board_in_camera(joint_pos)
        pixels = pixels_of(pose, OUTLINE, lens())
        middle = pose[:3, :3] @ OUTLINE.mean(axis=0) + pose[:3, 3]
        is_frontal = pose[:3, 2] @ middle > 0.5 * np.linalg.norm(middle)
        if is_frontal and (pixels > 8).all() and (pixels < np.array((632, 472))).all():
            num -= 1
            yield joint_pos


def hand_views(
    num: int,
    *,
    seed: int = 0,
    noise: float = 0.3,
    distortion: tuple[float, ...] = (),
    shift: float = 0.0,
    shaking: float = 0.0,
    offset: float = 0.0,
    square: float = 0.0,
    focal: float = 0.0,
    true_size: float = 1.0,
    offsets: np.ndarray | None = None,
    true_lens: CameraFile | None = None,
) -> list[HandView]:
    """Corners as a laboratory has them, with standard deviations of what is wrong.

    Of each corner [px]; of all corners of an image together [px]; of the joints anew in each image, and of
    their constant offsets [rad]; of the squares' size and of the focal length, relative. A row of `offsets`
    has the errors of the joint positions in an image [rad].
    """
    true_lens = true_lens or lens(distortion)
    rng = np.random.default_rng(1000 + seed)
    constant, zoom = rng.normal(0, offset, len(HOME)), 1.0 + rng.normal(0, focal)
    corners = true_size * (1.0 + rng.normal(0, square)) * CORNERS
    center = np.array((RGB_CAMERA.cx, RGB_CAMERA.cy))
    views = []
    for i, joint_pos in enumerate(poses(num, seed)):
        pixels = center + zoom * (pixels_of(board_in_camera(joint_pos), corners, true_lens) - center)
        pixels += rng.normal(0, noise, pixels.shape) + rng.normal(0, shift, 2)
        said = joint_pos + constant + rng.normal(0, shaking, len(HOME))
        said = said if offsets is None else said + offsets[i]
        steps = 1e-4 * np.eye(len(HOME))
        rates = np.stack([(palm(said + step) - palm(said - step)) / 2e-4 for step in steps])
        view = BoardView(points=CORNERS, pixels=pixels)
        views.append(HandView(name=f"view{i}", view=view, palm=palm(said), palm_rates=rates))
    return views


def memory_network(
    monkeypatch: pytest.MonkeyPatch,
    shown: Callable[[float], tuple[np.ndarray, np.ndarray]],
    late: float = 0.0,
) -> None:
    """Be a camera and an arm in memory: while a command waits, 0.1 s pass, and joints and image arrive."""
    profile, broker, clock = Profile.load("ur5e_allegro_v4"), Broker(), StepClock(lambda _: None)
    node, robot = broker.node(clock), broker.node(clock)
    image, state = map(robot.publisher, (profile.camera.image, profile.robots[0].state_topic))

    def wait(_: float) -> bool:
        clock.time += 0.1
        joint_pos, picture = shown(clock.time)
        image.publish(messages.image(picture, clock.time + late))
        state.publish(messages.joint_state([joint.name for joint in ARM.joints], joint_pos, clock.time))
        return True

    monkeypatch.setattr(node, "wait", wait)
    joined = lambda *_: nullcontext((node, clock))  # noqa: E731
    monkeypatch.setattr(Network, "join", joined)


@cache
def texture() -> tuple[np.ndarray, float]:
    """The printed board with its white edge, and its pixels a metre."""
    board = CharucoBoard().picture()
    scale = board.shape[1] / (COLUMNS * SQUARE)
    edge = round(MARGIN * scale)
    return cv2.copyMakeBorder(board, edge, edge, edge, edge, cv2.BORDER_CONSTANT, value=255), scale


def rendered(pose: np.ndarray, rng: np.random.Generator, magnification: int = 4) -> np.ndarray:
    """What the camera sees of the board in this pose before grey, with sensor noise: OpenCV's BGR."""
    board, scale = texture()
    edge = round(MARGIN * scale) / scale
    to_board = np.array(((1 / scale, 0, -edge), (0, 1 / scale, -edge), (0, 0, 1.0)))
    plane = np.array(RGB_CAMERA.matrix) @ pose[:3, [0, 1, 3]] @ to_board
    finer = np.diag((magnification, magnification, 1.0))
    centers = np.array(((1, 0, 0.5), (0, 1, 0.5), (0, 0, 1.0)))  # OpenCV's (0, 0) is a pixel's middle
    homography = np.linalg.inv(centers) @ finer @ plane @ centers
    size = (640 * magnification, 480 * magnification)
    large = cv2.warpPerspective(board, homography, size, flags=cv2.INTER_LINEAR, borderValue=GREY)
    image = cv2.resize(large, (640, 480), interpolation=cv2.INTER_AREA).astype(float)
    image = cv2.GaussianBlur(image, (0, 0), 0.7) + rng.normal(0, 2.0, image.shape)
    return cv2.cvtColor(np.clip(image, 0, 255).astype(np.uint8), cv2.COLOR_GRAY2BGR)
