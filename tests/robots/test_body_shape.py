"""Surfaces of the hand's links, felt by rays: how far they reach and how thick they are."""

import mujoco
import numpy as np
import pytest

from pixel2catch.scene.scene import SceneCfg, build_model
from pixel2catch.workcells.ur5e_allegro import UR5E_ALLEGRO

FINGERS = ("index", "middle", "ring", "thumb")
HOME = np.array([joint.home for joint in UR5E_ALLEGRO.joints])
ROBOT_ONLY = np.array((0, 0, 0, 1, 0, 0), dtype=np.uint8)
FAR = 0.3


@pytest.fixture(scope="module", params=["ur5e_allegro", "ur5e_allegro_right"])
def hand(request) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """Either hand in the start pose, the object far away."""
    model = build_model(SceneCfg(workcell=request.param))
    data = mujoco.MjData(model)
    data.qpos[:19] = HOME
    data.qpos[6:15] = 0.4
    mujoco.mj_kinematics(model, data)
    return model, data


def reach(hand: tuple[mujoco.MjModel, mujoco.MjData], link: str, start: tuple, direction: tuple) -> float:
    """How far the link's surface is from `start` along `direction`, in the link's frame, met from outside."""
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


@pytest.mark.parametrize(
    ("link", "length"), [("middle_link_0", 0.0164), ("thumb_link_1", 0.0177), ("ring_link_1", 0.054)]
)
def test_links_have_the_published_section_and_balance_in_their_middle(hand, link, length):
    np.testing.assert_allclose(hand[0].body(link).ipos, (0, 0, length / 2))
    for way, half in (((1, 0, 0), 0.0098), ((-1, 0, 0), 0.0098), ((0, 1, 0), 0.01375), ((0, -1, 0), 0.01375)):
        assert reach(hand, link, (0, 0, length / 2), way) == pytest.approx(half)


def test_right_hand_is_the_mirror_image_of_the_left():
    left, right = (build_model(SceneCfg(workcell=name)) for name in ("ur5e_allegro", "ur5e_allegro_right"))
    for geom in range(left.ngeom):
        name, twin = left.geom(geom).name, right.geom(geom)
        assert twin.name == name
        np.testing.assert_allclose(twin.size, left.geom(geom).size)
        if left.body(left.geom_bodyid[geom]).name.split("_")[0] in (*FINGERS, "palm"):
            np.testing.assert_allclose(twin.pos, left.geom(geom).pos * (1, -1, 1), atol=1e-12)


def test_last_link_is_a_block_with_a_ball_at_its_end(hand):
    """Index finger, by hand: 9.6 g of 19.6 x 27.5 x 26.7 mm around 13.35 mm, and 16.8 g at 26.7 mm."""
    model, _ = hand
    link = model.body("index_link_3")
    middle = (9.6 * 13.35 + 16.8 * 26.7) / 26.4
    np.testing.assert_allclose(link.ipos, (0, 0, 1e-3 * middle), atol=1e-9)
    spread = 9.6 * (middle - 13.35) ** 2 + 16.8 * (26.7 - middle) ** 2  # [g mm²], also of the next line
    ball, x, y, z = 0.4 * 16.8 * 12**2, 19.6**2, 27.5**2, 26.7**2
    by_hand = (0.8 * (y + z) + ball + spread, 0.8 * (x + z) + ball + spread, 0.8 * (x + y) + ball)
    np.testing.assert_allclose(link.inertia, 1e-9 * np.array(by_hand), rtol=1e-6)
