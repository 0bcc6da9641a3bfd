"""Surfaces of the hand's links, felt by rays: how far they reach and how thick they are."""

import mujoco
import numpy as np
import pytest

from pixel2catch.robot.constants import FINGERS, JOINTS
from pixel2catch.robot.scene import SceneCfg, build_model

HOME = np.array([joint.home for joint in JOINTS])
ROBOT_ONLY = np.array((0, 0, 0, 1, 0, 0), dtype=np.uint8)
FAR = 0.3


@pytest.fixture(scope="module", params=["left", "right"])
def hand(request) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """Either hand in the start pose, the object far away."""
    model = build_model(SceneCfg(handedness=request.param))
    data = mujoco.MjData(model)
    data.qpos[:19] = HOME
    data.qpos[6:15] = 0.4
    mujoco.mj_kinematics(model, data)
    return model, data


def reach(hand: tuple[mujoco.MjModel, mujoco.MjData], link: str, start: tuple, direction: tuple) -> float:
    """Distance from `start` to the link's surface along `direction`, both in the link's frame, from outside."""
    model, data = hand
    alone = model.geom_group.copy()
    model.geom_group[model.geom_bodyid != model.body(link).id] = 5
    pose, way = data.body(link).xmat.reshape(3, 3), np.array(direction, dtype=float)
    outside = data.body(link).xpos + pose @ (np.array(start) + FAR * way)
    geom = np.zeros(1, dtype=np.int32)
    distance = mujoco.mj_ray(model, data, outside, -pose @ way, ROBOT_ONLY, 1, -1, geom)
    model.geom_group[:] = alone
    return FAR - distance if distance >= 0 else np.nan


@pytest.mark.parametrize("finger", FINGERS)
def test_tips_end_12_mm_beyond_the_published_point(hand, finger):
    published = 0.0423 if finger == "thumb" else 0.0267
    assert reach(hand, f"{finger}_link_3", (0, 0, 0), (0, 0, 1)) == pytest.approx(published + 0.012)
    for side in ((1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0)):
        assert reach(hand, f"{finger}_link_3", (0, 0, published), side) == pytest.approx(0.012)
    site = hand[0].site(f"{finger}_tip")
    assert site.pos[2] == pytest.approx(published)
