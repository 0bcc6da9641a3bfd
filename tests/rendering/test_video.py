from dataclasses import replace
from pathlib import Path

import av
import numpy as np
import pytest
import torch

from pixel2catch.camera.pinhole import project
from pixel2catch.errors import DeviceUnavailableError, InvalidValueError, UnknownNameError
from pixel2catch.evaluation.protocol import EvaluationCfg, recorded_throws
from pixel2catch.methods import PROPOSED
from pixel2catch.policy import Policy, contract_of
from pixel2catch.rendering.renderer import find_gl_backend
from pixel2catch.rendering.video import RecordedThrow, draw_box, write_video
from pixel2catch.scene.constants import RGB_CAMERA
from pixel2catch.scene.scene import SceneCfg


@pytest.fixture(scope="module")
def throws() -> list[RecordedThrow]:
    torch.manual_seed(0)
    policy = Policy(contract_of(PROPOSED), hidden=(16,))
    return recorded_throws(EvaluationCfg(objects=("cube_l",), num_envs=2, seed=1), policy, PROPOSED)


def test_the_box_belongs_to_the_object(throws: list[RecordedThrow]):
    """While the object hovers, its centre is in the box, but for the corners' noise; then both move on."""
    for throw in throws:
        centers = torch.from_numpy(throw.qpos[:, None, 19:22]).float()
        pixels = project(RGB_CAMERA, centers)[0][:, 0].numpy()
        low, high = throw.box[:, :2] - 6.0, throw.box[:, 2:] + 6.0
        assert ((low <= pixels) & (pixels <= high))[:5].all()
        assert np.abs(throw.box[-1] - throw.box[0]).max() > 30.0
        assert throw.object_name == "cube_l"


def test_a_throw_ends_before_the_next_episode_begins(throws: list[RecordedThrow]):
    """A reset would move the object back to its release point, x > 2.4 m."""
    for throw in throws:
        assert throw.qpos[0, 19] > 2.3
        assert throw.qpos[-1, 19] < 1.5
        assert (np.diff(throw.qpos[:, 19]) < 0.5).all()


def test_drawn_box_by_hand():
    """Edges 2 px wide inside the box, a mark of 4 x 4 px in the middle; what is off the image is cut off."""
    image = np.zeros((40, 60, 3), dtype=np.uint8)
    draw_box(image, np.array([10.0, 5.0, 30.0, 25.0]))
    drawn = np.any(image, axis=-1, keepdims=False)
    assert isinstance(drawn, np.ndarray)
    assert drawn.sum() == 20 * 20 - 16 * 16 + 16
    assert drawn[5, 10]
    assert drawn[24, 29]
    assert not drawn[25, 30]
    draw_box(image, np.array([-50.0, -50.0, -10.0, 90.0]))
    assert drawn.sum() == image.any(axis=-1).sum()


def test_unknown_view(throws: list[RecordedThrow], tmp_path: Path):
    with pytest.raises(UnknownNameError, match="outside"):
        write_video(tmp_path / "video.mp4", throws, SceneCfg(), "inside")


@pytest.mark.parametrize("name", ["absent/video.mp4", "video.nonsense"])
def test_a_file_that_cannot_be_written(name: str, throws: list[RecordedThrow], tmp_path: Path):
    with pytest.raises(InvalidValueError, match=name):
        write_video(tmp_path / name, throws, SceneCfg())


def test_video_has_every_control_step(throws: list[RecordedThrow], tmp_path: Path):
    try:
        find_gl_backend()
    except DeviceUnavailableError as error:
        pytest.skip(str(error))
    first = {name: getattr(throws[0], name)[:3] for name in ("qpos", "qvel", "box")}
    short = replace(throws[0], **first)
    path = tmp_path / "video.mp4"
    assert write_video(path, [short], SceneCfg()) == 3
    with av.open(str(path)) as container:
        shapes = [frame.to_ndarray(format="rgb24").shape for frame in container.decode(video=0)]
    assert shapes == [(480, 1280, 3)] * 3
