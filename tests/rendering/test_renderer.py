"""Pictures of a model, and the camera in a room, fast without shadows."""

from collections.abc import Iterator
from dataclasses import replace
from math import inf
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch

from pixel2catch.camera.pinhole import project
from pixel2catch.errors import DeviceUnavailableError, InvalidValueError
from pixel2catch.rendering import renderer as module
from pixel2catch.rendering.camera import CameraCfg, Exposure, Moment, RoomCamera, room_positions
from pixel2catch.rendering.renderer import DRAWN_GROUPS, Renderer, find_gl_backend
from pixel2catch.rendering.room import BYSTANDER_JOINTS, HAND_DROP, Bystanders, build_room
from pixel2catch.rendering.video import write_video
from pixel2catch.scene.constants import OBJECT_POS, OBJECT_VEL, RGB_CAMERA
from pixel2catch.scene.scene import OBJECT_START, SceneCfg, build_model
from pixel2catch.workcells import find_workcell
from pixel2catch.workcells.ur5e_allegro import UR5E_ALLEGRO

RELEASE = np.array((2.6, 0.1, 0.8))
MODEL = build_model(SceneCfg())
THROWER = Bystanders(release_pos=RELEASE, phase=0.3, release=inf)
STILL = CameraCfg(read_noise=0.0, shot_noise=0.0)


def moment(pos: np.ndarray = RELEASE, speed: float = 0.0, time: float = -1.0) -> Moment:
    """The robot at home, the object at a position with a speed along y."""
    qpos, qvel = MODEL.qpos0.copy(), np.zeros(MODEL.nv)
    qpos[: len(UR5E_ALLEGRO.joints)] = [joint.home for joint in UR5E_ALLEGRO.joints]
    qpos[OBJECT_POS], qvel[OBJECT_VEL] = pos, (0.0, speed, 0.0)
    return Moment(qpos=qpos, qvel=qvel, time=time)


def exposure(object_name: str | None = "cone_l", pos: np.ndarray = RELEASE, speed: float = 0.0) -> Exposure:
    shown = moment(pos, speed, time=1.0)
    return Exposure(moment=shown, object_name=object_name, thrower=THROWER.joint_pos)


@pytest.fixture
def view(opengl: None, request: pytest.FixtureRequest) -> Iterator[RoomCamera]:
    with RoomCamera(SceneCfg(), 0, request.param) as view:
        yield view


@pytest.mark.parametrize("view", [STILL], indirect=True)
def test_it_is_the_picture_of_the_room_without_shadows(view: RoomCamera):
    shown, room = exposure("l_block"), build_room(SceneCfg(), "l_block", 0)
    with Renderer(room, shadows=False) as renderer:
        expected = renderer.image(room_positions(room, shown.moment, 0.0, THROWER.joint_pos))
    difference = np.abs(view.image(shown).astype(int) - expected).max(axis=-1)
    assert (difference > 8).mean() < 0.003  # the outlines of round geoms, which are coarser
    row, column = 203, 311  # the object; its neighbours in the list look different
    assert (difference[row - 15 : row + 15, column - 15 : column + 15] > 60).mean() < 0.03


@pytest.mark.parametrize("view", [STILL], indirect=True)
def test_another_object_looks_different_and_an_empty_room_has_none(view: RoomCamera):
    cone, ball, none = (view.image(exposure(name)).astype(int) for name in ("cone_l", "sphere_s", None))
    assert np.array_equal(cone, view.image(exposure("cone_l")))
    for one, other in ((cone, ball), (cone, none), (ball, none)):
        changed = np.argwhere(np.abs(one - other).max(axis=-1) > 40)
        assert 20 < len(changed) < 1500
        assert np.abs(changed - (203, 311)).max() < 30  # only at the thrower's hand


@pytest.mark.parametrize("view", [replace(STILL, exposure=0.02, part_length=8.0)], indirect=True)
def test_what_moves_is_smeared_over_what_stands_still(view: RoomCamera):
    pos = np.array((1.5, 0.6, 1.2))  # nothing else moves there
    none, still, moving = (
        view.image(shown).astype(int)
        for shown in (exposure(None), exposure(pos=pos), exposure(pos=pos, speed=-4.0))
    )
    rows, columns = np.nonzero((np.abs(still - none) > 15).any(axis=-1))
    near = slice(rows.min(), rows.max()), slice(columns.min() - 40, columns.max() + 40)
    widths = [
        np.ptp(np.flatnonzero((np.abs(each - none)[near] > 15).any(axis=(0, 2)))) for each in (still, moving)
    ]
    # 8 cm at 2 m are 24 px; the first and the last of four pictures are 18 px apart.
    assert widths[1] - widths[0] == pytest.approx(18, abs=3)


def test_the_robots_of_any_work_cell_are_drawn(opengl: None):
    """Two arms, of which the second moves: it is smeared."""
    scene = SceneCfg(workcell="two_ur5e_allegro")
    model, workcell = build_model(scene), find_workcell(scene.workcell)
    qpos, qvel = model.qpos0.copy(), np.zeros(model.nv)
    qpos[: len(workcell.joints)] = [joint.home for joint in workcell.joints]
    images = []
    with RoomCamera(scene, 0, replace(STILL, part_length=1.0)) as camera:
        for speed in (0.0, 3.0):
            qvel[workcell.palms[1].carriers] = speed
            moment = Moment(qpos=qpos, qvel=qvel, time=0.0)
            shown = Exposure(moment=moment, object_name="cube_s", thrower=THROWER.joint_pos)
            images.append(camera.image(shown).astype(int))
    changed = (np.abs(images[1] - images[0]) > 15).any(axis=-1)
    assert 200 < changed.sum() < 20_000


SEEN = build_model(SceneCfg(visuals=True))


@pytest.mark.usefixtures("opengl")
def test_the_camera_sees_the_object_where_its_mask_is():
    with Renderer(SEEN, shadows=False) as renderer:
        image, mask = renderer.image(SEEN.qpos0), renderer.object_mask(SEEN.qpos0)
    assert image.shape == (480, 640, 3)
    assert 20 < mask.sum() < 1000
    red, green, blue = image[mask].mean(0)
    assert red > 1.5 * max(green, blue)


@pytest.mark.usefixtures("opengl")
def test_pictures_are_taken_by_the_camera_of_the_scene():
    """A small sphere's mask is about where the camera's numbers project its centre."""
    camera = replace(RGB_CAMERA, pos=(-0.5, 0.2, 2.1), fx=700.0, fy=690.0, cx=300.0, cy=260.0)
    model = build_model(SceneCfg(camera=camera), "sphere_s")
    with Renderer(model, shadows=False) as renderer:
        mask = renderer.object_mask(model.qpos0)
    rows, columns = np.nonzero(mask)
    expected = project(camera, torch.tensor([[OBJECT_START]], dtype=torch.float64))[0][0, 0]
    np.testing.assert_allclose((columns.mean() + 0.5, rows.mean() + 0.5), expected, atol=0.5)


@pytest.mark.usefixtures("opengl")
def test_what_collides_is_not_drawn_of_a_body_that_has_looks():
    with Renderer(SEEN) as renderer:
        groups = renderer.model.geom_group
        base, table = (renderer.model.geom(name).id for name in ("base_link", "table"))
        assert groups[base] not in DRAWN_GROUPS
        assert groups[table] in DRAWN_GROUPS


@pytest.mark.parametrize(
    ("platform", "draws", "words"),
    [("", False, "apt-get install libegl1 libgl1"), ("glx", True, "PYOPENGL_PLATFORM is 'glx', .* unset it")],
)
def test_missing_packages_and_a_platform_that_needs_a_display_are_named(
    platform: str, draws: bool, words: str, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setenv("PYOPENGL_PLATFORM", platform)
    monkeypatch.setattr(module, "_draws", lambda *_: draws)
    with pytest.raises(DeviceUnavailableError, match=words):
        find_gl_backend.__wrapped__()


@pytest.mark.usefixtures("opengl")
def test_a_device_that_is_not_there_is_named(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv(module.EGL_DEVICE, "99")
    with pytest.raises(DeviceUnavailableError, match=r"MUJOCO_EGL_DEVICE_ID is '99', .* unset it"):
        find_gl_backend.__wrapped__()


def test_an_odd_picture_is_refused_and_the_old_film_stays(tmp_path: Path):
    (tmp_path / "odd.mp4").write_text("before")
    with pytest.raises(InvalidValueError, match="even width and height, not 63 x 48"):
        write_video(tmp_path / "odd.mp4", [np.zeros((48, size, 3), dtype=np.uint8) for size in (64, 63)])
    assert [file.read_text() for file in tmp_path.iterdir()] == ["before"]


@pytest.fixture
def camera(opengl: None, request: pytest.FixtureRequest) -> Iterator[RoomCamera]:
    with RoomCamera(SceneCfg(), 0, request.param, shadows=True) as camera:
        yield camera


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
    assert np.abs(np.array(heights[:2]) - (0.0, 0.0, -HAND_DROP)).max() < 0.03  # a person sways by 1 cm
    assert heights[2][2] > 0.2


@pytest.mark.parametrize("camera", [STILL], indirect=True)
def test_the_mask_is_where_the_object_projects_to(camera: RoomCamera):
    for pos in (RELEASE, np.array((1.5, -0.2, 1.6))):
        mask = camera.object_mask(exposure("cube_l", pos))
        rows, columns = np.nonzero(mask)
        center = 0.5 * np.array((columns.min() + columns.max() + 1, rows.min() + rows.max() + 1))
        pixels, _ = project(RGB_CAMERA, torch.from_numpy(pos)[None, None])
        assert np.abs(center - pixels[0, 0].numpy()).max() < 2.0
        assert mask.sum() > 60


@pytest.mark.parametrize("camera", [CameraCfg()], indirect=True)
def test_the_sensors_noise_grows_with_the_light(camera: RoomCamera):
    first, second = (camera.image(exposure("cube_l")).astype(float) for _ in range(2))
    difference, light = first - second, 0.5 * (first + second)
    for low, high in ((20, 45), (110, 140)):
        band = (light > low) & (light < high)
        expected = 2.0 * (1.5**2 + 0.05 * light[band].mean() + 1 / 12)
        assert difference[band].var() == pytest.approx(expected, rel=0.2)
