"""Kinematics of the model against chains written out here."""

from math import cos, pi, sin

import mujoco
import numpy as np
import pytest

from pixel2catch.scene.scene import SceneCfg, build_model
from pixel2catch.workcells.ur5e_allegro import UR5E_ALLEGRO

NUM_SAMPLES = 100
FINGERS = ("index", "middle", "ring", "thumb")

# UR's table of the UR5e, typed in again: d, a, alpha.
DH = (
    (0.1625, 0.0, pi / 2),
    (0.0, -0.425, 0.0),
    (0.0, -0.3922, 0.0),
    (0.1333, 0.0, pi / 2),
    (0.0997, 0.0, -pi / 2),
    (0.0996, 0.0, 0.0),
)


def rotation(axis: str, angle: float) -> np.ndarray:
    c, s = cos(angle), sin(angle)
    i, j = {"x": (1, 2), "y": (2, 0), "z": (0, 1)}[axis]
    matrix = np.eye(4)
    matrix[i, i], matrix[i, j], matrix[j, i], matrix[j, j] = c, -s, s, c
    return matrix


def translation(x: float, y: float, z: float) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, 3] = (x, y, z)
    return matrix


def flange(joint_pos: np.ndarray) -> np.ndarray:
    """Pose of the flange by the textbook DH matrices, base parallel to the world."""
    pose = translation(0.0, 0.0, 0.821)
    for q, (d, a, alpha) in zip(joint_pos, DH, strict=True):
        c, s, ca, sa = cos(q), sin(q), cos(alpha), sin(alpha)
        pose = pose @ np.array(
            [[c, -s * ca, s * sa, a * c], [s, c * ca, -c * sa, a * s], [0.0, sa, ca, d], [0.0, 0.0, 0.0, 1.0]]
        )
    return pose


def hand(joint_pos: np.ndarray) -> np.ndarray:
    """Hand frame: on the flange, hand x along the flange's y."""
    return flange(joint_pos) @ translation(0.0, 0.0097, 0.0074) @ rotation("z", pi / 2)


def finger_tip(finger: str, q: np.ndarray) -> np.ndarray:
    """Tip of a finger of the left hand in the hand frame, from the table of the task."""
    if finger == "thumb":
        root = rotation("z", pi / 2) @ rotation("y", -np.radians(95.0))
        root[:3, 3] = (-0.0182, -0.0193, 0.0490)
        pose = root @ rotation("x", q[0]) @ translation(-0.027, -0.005, 0.0399) @ rotation("z", -q[1])
        pose = pose @ translation(0, 0, 0.0177) @ rotation("y", q[2]) @ translation(0, 0, 0.0514)
        return pose @ rotation("y", q[3]) @ translation(0, 0, 0.0423)
    y, z, tilt = {"index": (-0.0435, 0.0935, 5), "middle": (0, 0.0957, 0), "ring": (0.0435, 0.0935, -5)}[
        finger
    ]
    pose = translation(0, y, z) @ rotation("x", np.radians(tilt))
    for angle, length in zip(q, (0.0164, 0.0540, 0.0384), strict=True):
        pose = pose @ translation(0, 0, length) @ rotation("y", angle)
    return pose @ translation(0, 0, 0.0267)


def random_positions() -> np.ndarray:
    """Joint positions within the limits, (NUM_SAMPLES, 19)."""
    low, high = np.array([(joint.lower, joint.upper) for joint in UR5E_ALLEGRO.joints]).T
    return np.random.default_rng(0).uniform(low, high, (NUM_SAMPLES, 19))


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    return build_model(SceneCfg())


def place(model: mujoco.MjModel, joint_pos: np.ndarray) -> mujoco.MjData:
    data = mujoco.MjData(model)
    data.qpos[:19] = joint_pos
    mujoco.mj_kinematics(model, data)
    return data


def site_pose(data: mujoco.MjData, name: str) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = data.site(name).xmat.reshape(3, 3), data.site(name).xpos
    return pose


def test_start_pose_is_the_one_of_the_task(model):
    data = place(model, np.array([joint.home for joint in UR5E_ALLEGRO.joints]))
    palm = site_pose(data, "palm")
    np.testing.assert_allclose(palm[:3, 3], (0.434, 0.133, 1.391), atol=6e-4)
    np.testing.assert_allclose(palm[:3, 0], (0.208, 0.0, 0.978), atol=6e-4)
    np.testing.assert_allclose(palm[:3, 2], (0.978, 0.0, -0.208), atol=6e-4)


def test_flange_follows_the_dh_chain(model):
    for joint_pos in random_positions():
        np.testing.assert_allclose(
            site_pose(place(model, joint_pos), "tool0"), flange(joint_pos[:6]), atol=1e-9
        )


def test_fingertips_follow_the_link_table(model):
    first = {"index": 6, "middle": 9, "ring": 12, "thumb": 15}
    for joint_pos in random_positions():
        data = place(model, joint_pos)
        for finger in FINGERS:
            q = joint_pos[first[finger] :][: 4 if finger == "thumb" else 3]
            expected = (hand(joint_pos[:6]) @ finger_tip(finger, q))[:3, 3]
            np.testing.assert_allclose(data.site(f"{finger}_tip").xpos, expected, atol=1e-4)
