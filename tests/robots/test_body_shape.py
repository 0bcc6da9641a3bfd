"""The hand's links: the mirror image, and masses worked out by hand; tests/frozen has all numbers."""

import numpy as np

from pixel2catch.scene.scene import SceneCfg, build_model

FINGERS = ("index", "middle", "ring", "thumb")


def test_right_hand_is_the_mirror_image_of_the_left():
    left, right = (build_model(SceneCfg(workcell=name)) for name in ("ur5e_allegro", "ur5e_allegro_right"))
    for geom in range(left.ngeom):
        name, twin = left.geom(geom).name, right.geom(geom)
        assert twin.name == name
        np.testing.assert_allclose(twin.size, left.geom(geom).size)
        if left.body(left.geom_bodyid[geom]).name.split("_")[0] in (*FINGERS, "palm"):
            np.testing.assert_allclose(twin.pos, left.geom(geom).pos * (1, -1, 1), atol=1e-12)


def test_last_link_is_a_block_with_a_ball_at_its_end():
    """Index finger, by hand: 9.6 g of 19.6 x 27.5 x 26.7 mm around 13.35 mm, and 16.8 g at 26.7 mm."""
    link = build_model(SceneCfg()).body("index_link_3")
    middle = (9.6 * 13.35 + 16.8 * 26.7) / 26.4
    np.testing.assert_allclose(link.ipos, (0, 0, 1e-3 * middle), atol=1e-9)
    spread = 9.6 * (middle - 13.35) ** 2 + 16.8 * (26.7 - middle) ** 2  # [g mm²], also of the next line
    ball, x, y, z = 0.4 * 16.8 * 12**2, 19.6**2, 27.5**2, 26.7**2
    by_hand = (0.8 * (y + z) + ball + spread, 0.8 * (x + z) + ball + spread, 0.8 * (x + y) + ball)
    np.testing.assert_allclose(link.inertia, 1e-9 * np.array(by_hand), rtol=1e-6)
