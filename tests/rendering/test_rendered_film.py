"""The film of a throw: what moves, what the sensor adds, and the truth beside it."""

from collections.abc import Iterator

import mujoco
import numpy as np
import pytest
import torch
from rendered_scenes import MODEL, RELEASE, STILL, moment
from rendered_throws import FilmCfg, ThrowFilm

from pixel2catch.camera.pinhole import project
from pixel2catch.rendering.camera import CameraCfg
from pixel2catch.rendering.room import BYSTANDER_JOINTS, HAND_DROP, Bystanders, build_room
from pixel2catch.scene.constants import RGB_CAMERA
from pixel2catch.scene.scene import SceneCfg


@pytest.fixture
def film(opengl: None, request: pytest.FixtureRequest) -> Iterator[ThrowFilm]:
    cfg = FilmCfg(camera=request.param, num_empty=2, num_held=1)
    with ThrowFilm(cfg, "cube_l", RELEASE, seed=0) as film:
        yield film


def test_the_positions_of_the_scene_come_first_in_the_room():
    room = build_room(SceneCfg(), "cube_l", seed=0)
    names = [room.joint(i).name for i in range(room.njnt)]
    assert names == [MODEL.joint(i).name for i in range(MODEL.njnt)] + list(BYSTANDER_JOINTS)


def test_the_object_lies_on_the_throwers_hand_until_it_is_released():
    room = build_room(SceneCfg(), "cube_l", seed=0)
    bystanders, data = Bystanders(release_pos=RELEASE, phase=0.4), mujoco.MjData(room)
    hand = max(geom for geom in range(room.ngeom) if room.geom_bodyid[geom] == room.body("thrower_arm").id)
    heights = []
    for time in (-0.7, 0.0, 0.5):
        data.qpos[-len(BYSTANDER_JOINTS) :] = bystanders.joint_pos(time)
        mujoco.mj_kinematics(room, data)
        heights.append(data.geom_xpos[hand] - RELEASE)
    # A standing person sways by 1 cm.
    assert np.abs(heights[0] - (0.0, 0.0, -HAND_DROP)).max() < 0.03
    assert np.abs(heights[1] - (0.0, 0.0, -HAND_DROP)).max() < 0.03
    assert heights[2][2] > 0.2


@pytest.mark.parametrize("film", [STILL], indirect=True)
def test_the_true_box_is_where_the_object_projects_to(film: ThrowFilm):
    for pos in (RELEASE, np.array((1.5, -0.2, 1.6))):
        shot = film.shot(moment(pos))
        center = 0.5 * (shot.box[0, :2] + shot.box[0, 2:])
        pixels, _ = project(RGB_CAMERA, torch.from_numpy(pos)[None, None])
        assert (center - pixels[0, 0]).abs().max() < 2.0
        assert shot.num_pixels > 60


@pytest.mark.parametrize("film", [CameraCfg()], indirect=True)
def test_the_sensors_noise_grows_with_the_light(film: ThrowFilm):
    first, second = (film.shot(moment(RELEASE)).image.pixels.astype(float) for _ in range(2))
    difference, light = first - second, 0.5 * (first + second)
    for low, high in ((20, 45), (110, 140)):
        band = (light > low) & (light < high)
        expected = 2.0 * (1.5**2 + 0.05 * light[band].mean() + 1 / 12)
        assert difference[band].var() == pytest.approx(expected, rel=0.2)
