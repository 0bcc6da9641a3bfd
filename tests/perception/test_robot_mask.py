"""The projected robot against rays: one through the middle of every third pixel."""

from functools import cache

import mujoco
import numpy as np
import pytest
import torch

from pixel2catch.camera.pinhole import nominal_projection
from pixel2catch.perception import regions
from pixel2catch.perception.regions import MARGIN, RobotMask
from pixel2catch.robots.ur5e import ARM
from pixel2catch.robots.workcell import WorkcellSpec
from pixel2catch.scene.constants import RGB_CAMERA
from pixel2catch.scene.scene import SceneCfg, build_model
from pixel2catch.workcells import find_workcell, workcells
from pixel2catch.workcells.ur5e_allegro import UR5E_ALLEGRO

STRIDE = 3
ROBOT_GROUPS = (2, 3)
"""What is only seen, the pedestal below the table among it, and the robot."""

ROWS, COLUMNS = np.mgrid[: RGB_CAMERA.height : STRIDE, : RGB_CAMERA.width : STRIDE]
IS_ARM = np.arange(len(UR5E_ALLEGRO.joints)) < len(ARM.joints)


def poses() -> np.ndarray:
    """The start pose, and joints within 0.25 rad of it, fingers anywhere within their limits."""
    home, lower, upper = np.array([(each.home, each.lower, each.upper) for each in UR5E_ALLEGRO.joints]).T
    offsets = np.where(IS_ARM, 0.25, 2.0) * np.random.default_rng(0).uniform(-1, 1, (11, len(home)))
    return np.vstack((home, np.clip(home + offsets, lower, upper)))


@cache
def rays() -> np.ndarray:
    """From the camera to points 1 m away behind the pixels' middles [m]."""
    pixels = torch.from_numpy(np.stack((COLUMNS + 0.5, ROWS + 0.5), axis=-1).reshape(-1, 2))
    points = nominal_projection(RGB_CAMERA, pixels).points(pixels, torch.ones_like(pixels[:, 0]))
    return points.numpy() - np.array(RGB_CAMERA.pos)


def seen_robot(model: mujoco.MjModel, joint_pos: np.ndarray) -> np.ndarray:
    """Which of the pixels show the robot."""
    data = mujoco.MjData(model)
    data.qpos[: len(joint_pos)] = joint_pos
    mujoco.mj_kinematics(model, data)
    geoms, distance = np.zeros(ROWS.size, dtype=np.int32), np.zeros(ROWS.size)
    groups = np.isin(np.arange(mujoco.mjNGROUP), (0, *ROBOT_GROUPS)).astype(np.uint8)
    origin = np.array(RGB_CAMERA.pos)
    mujoco.mj_multiRay(
        model, data, origin, rays().ravel(), groups, True, -1, geoms, distance, None, ROWS.size, 1e3
    )
    root = model.body("base_link").id
    is_robot = (geoms >= 0) & (model.body_rootid[model.geom_bodyid[geoms]] == root)
    return is_robot.reshape(ROWS.shape)


@pytest.mark.parametrize(
    ("workcell", "margin", "late", "least_covered", "most_hidden"),
    [
        ("ur5e_allegro", 0, 0.0, 0.99, 0.05),
        ("ur5e_allegro_right", 0, 0.0, 0.99, 0.05),
        ("ur5e_allegro", MARGIN, 0.0, 0.999, 0.6),
        # encoders that are half an image interval late, at a tenth of the arm's largest speed
        ("ur5e_allegro", MARGIN, 0.279 / 60, 0.99, 0.6),
    ],
)
def test_the_mask_covers_the_robot_and_little_else(
    workcell: str, margin: int, late: float, least_covered: float, most_hidden: float
):
    """In every pose, masked pixels of the robot and of the rest, both as shares of the robot's."""
    model = build_model(SceneCfg(workcell=workcell, visuals=True))
    robot = RobotMask(find_workcell(workcell), margin=margin)
    covered, hidden = [], []
    for joint_pos in poses():
        truth = seen_robot(model, joint_pos)
        mask = robot.at(joint_pos + late * IS_ARM)[::STRIDE, ::STRIDE]
        assert truth.sum() > 50
        covered.append(mask[truth].mean())
        hidden.append((mask & ~truth).sum() / truth.sum())
    assert min(covered) >= least_covered
    assert np.median(hidden) <= most_hidden


@pytest.mark.parametrize("workcell", workcells().values(), ids=lambda workcell: workcell.name)
def test_every_robot_can_be_masked(workcell: WorkcellSpec):
    mask = RobotMask(workcell).at(np.array([joint.home for joint in workcell.joints]))
    assert 0.01 < mask.mean() < 0.5


def test_geoms_that_others_hide_are_left_out_and_not_missed(monkeypatch: pytest.MonkeyPatch):
    robot = RobotMask(UR5E_ALLEGRO, margin=0)
    monkeypatch.setattr(regions, "HIDDEN", -1.0)
    whole = RobotMask(UR5E_ALLEGRO, margin=0)
    for joint_pos in poses():
        mask, all_of_it = robot.at(joint_pos), whole.at(joint_pos)
        assert not (mask & ~all_of_it).any()
        assert (all_of_it & ~mask).sum() < 0.01 * all_of_it.sum()
