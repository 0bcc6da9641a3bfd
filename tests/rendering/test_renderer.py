from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from pixel2catch.camera.pinhole import project
from pixel2catch.errors import DeviceUnavailableError, InvalidValueError
from pixel2catch.rendering import renderer as module
from pixel2catch.rendering.renderer import DRAWN_GROUPS, Renderer, Viewpoint, find_gl_backend
from pixel2catch.rendering.video import VideoWriter
from pixel2catch.scene.constants import RGB_CAMERA
from pixel2catch.scene.scene import OBJECT_START, SceneCfg, build_model

MODEL = build_model(SceneCfg(visuals=True))


@pytest.mark.usefixtures("opengl")
def test_the_camera_sees_the_object_where_its_mask_is():
    with Renderer(MODEL, shadows=False) as renderer:
        image, mask = renderer.image(MODEL.qpos0), renderer.object_mask(MODEL.qpos0)
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
def test_a_path_is_drawn_into_one_picture():
    """A line through the middle of the picture, 2 m away."""
    view = Viewpoint(lookat=(0.0, 3.0, 1.5), distance=2.0, azimuth=90.0)
    path = np.array([(x, 3.0, 1.5) for x in (-0.3, 0.0, 0.3)])
    with Renderer(MODEL, view, shadows=False) as renderer:
        before, shown = renderer.image(MODEL.qpos0), renderer.image(MODEL.qpos0, path=path)
        assert np.array_equal(renderer.image(MODEL.qpos0), before)
    rows, columns = np.nonzero((np.abs(shown.astype(int) - before) > 20).any(axis=-1))
    assert 235 <= rows.min() <= rows.max() <= 245
    assert np.ptp(columns) == pytest.approx(0.6 / (2.0 * 2.0 * np.tan(np.pi / 8)) * 480, abs=12)


@pytest.mark.usefixtures("opengl")
def test_what_collides_is_not_drawn_of_a_body_that_has_looks():
    with Renderer(MODEL) as renderer:
        groups = renderer.model.geom_group
        base, table = (renderer.model.geom(name).id for name in ("base_link", "table"))
        assert groups[base] not in DRAWN_GROUPS
        assert groups[table] in DRAWN_GROUPS


def test_without_opengl_the_error_names_the_packages(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(module, "_draws", lambda _backend: False)
    find_gl_backend.cache_clear()
    try:
        with pytest.raises(DeviceUnavailableError, match="apt-get install libegl1 libgl1"):
            find_gl_backend()
    finally:
        find_gl_backend.cache_clear()


def test_an_odd_picture_is_refused(tmp_path: Path):
    with (
        VideoWriter(tmp_path / "odd.mp4") as video,
        pytest.raises(InvalidValueError, match="even width and height, got 63 x 48"),
    ):
        video.write(np.zeros((48, 63, 3), dtype=np.uint8))
