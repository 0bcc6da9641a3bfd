from pathlib import Path

import av
import numpy as np
import pytest
import torch
from PIL import Image, ImageSequence

from pixel2catch.camera.pinhole import project
from pixel2catch.envs.cfg import CatchEnvCfg
from pixel2catch.evaluation.protocol import EvaluationCfg, RecordedThrow, recorded_throws
from pixel2catch.methods import PROPOSED
from pixel2catch.policy import Policy, contract_of
from pixel2catch.rendering import film
from pixel2catch.rendering.video import draw_box, write_film
from pixel2catch.robots.geometry import chain_of
from pixel2catch.scene.constants import OBJECT_POS, OBJECT_VEL, RGB_CAMERA
from pixel2catch.scene.scene import SceneCfg, build_model
from pixel2catch.workcells import find_workcell


@pytest.fixture(scope="module")
def throws() -> list[RecordedThrow]:
    torch.manual_seed(0)
    policy = Policy(contract_of(PROPOSED), hidden=(16,))
    task = CatchEnvCfg(scene=SceneCfg(physics_hz=60.0))
    cfg = EvaluationCfg(objects=("cube_l",), num_envs=2, seed=1, task=task)
    return recorded_throws(cfg, policy, PROPOSED)


def test_a_recorded_throw_has_its_boxes_and_ends_before_the_next_episode(throws: list[RecordedThrow]):
    """While the object hovers, its centre is in the box, but for the corners' noise; then both move on.

    A reset would move the object back to its release point, x > 2.4 m.
    """
    for throw in throws:
        assert throw.object_name == "cube_l"
        centers = torch.from_numpy(throw.qpos[:, None, 19:22]).float()
        pixels = project(RGB_CAMERA, centers)[0][:, 0].numpy()
        low, high = throw.box[:, :2] - 6.0, throw.box[:, 2:] + 6.0
        assert ((low <= pixels) & (pixels <= high))[:5].all()
        assert np.abs(throw.box[-1] - throw.box[0]).max() > 30.0
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


@pytest.mark.parametrize("ending", [".mp4", ".webp", ".gif"])
def test_a_film_has_its_pictures_in_order(ending: str, tmp_path: Path):
    path = tmp_path / f"film{ending}"
    pictures = [np.full((32, 64, 3), level, dtype=np.uint8) for level in (0, 100, 200)]
    assert write_film(path, pictures, fps=25) == 3
    if ending == ".mp4":
        with av.open(str(path)) as container:
            assert container.streams.video[0].codec_context.name == "h264"
            shown = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    else:
        with Image.open(path) as file:
            shown = [np.asarray(frame.convert("RGB")) for frame in ImageSequence.all_frames(file)]
    assert [picture.mean() for picture in shown] == pytest.approx([0, 100, 200], abs=4)


def falling(num_steps: int, catch: int) -> RecordedThrow:
    """A throw by hand: it rests, flies from step 10 on, and is in the palm from a step on."""
    workcell = find_workcell("ur5e_allegro")
    model = build_model(SceneCfg())
    home = np.array([joint.home for joint in workcell.joints])
    qpos, qvel = np.tile(model.qpos0, (num_steps, 1)), np.zeros((num_steps, model.nv))
    qpos[:, : len(home)] = home
    palm = chain_of(workcell, workcell.palms[0]).pose(torch.tensor(home[None, :6]))[0][0].numpy()
    for step in range(10, num_steps):
        share = min((step - 10) / (catch - 10), 1.0)
        qpos[step, OBJECT_POS] = (1.0 - share) * qpos[0, OBJECT_POS] + share * palm
        qvel[step, OBJECT_VEL] = (-2.0, 0.0, 0.0)
    return RecordedThrow(
        object_name="cube_l",
        outcome="caught",
        qpos=qpos,
        qvel=qvel,
        box=np.zeros((num_steps, 4)),
        num_untested=num_steps - 10,
    )


def test_the_film_is_slow_about_the_catch():
    throw = falling(70, catch=30)
    board = film.storyboard(throw, find_workcell("ur5e_allegro"))
    assert throw.release == 10
    assert 28 <= board.catch <= 30  # within 12 cm of the palm
    assert board.steps[0] == 4.0
    assert board.steps[-1] == 69.0
    pace = np.diff(board.steps)
    assert (pace > 0.0).all()
    slow = pace[board.is_slow[:-1] & board.is_slow[1:]]
    np.testing.assert_allclose(slow, 30 / film.FPS / film.SLOW)
    assert np.median(pace[~board.is_slow[:-1]]) == pytest.approx(30 / film.FPS)
    shown = board.steps[board.is_slow]
    assert shown[0] == board.catch - 5
    assert board.catch + 6 < shown[-1] < board.catch + 7
    assert board.closeness[0] == 0.0
    assert (board.closeness[board.steps >= board.catch] == 1.0).all()
    assert board.decision == 59


@pytest.mark.usefixtures("opengl")
def test_a_still_has_path_caption_and_the_robots_view(throws: list[RecordedThrow]):
    with film.FilmRenderer(SceneCfg(), width=320) as renderer:
        strip = renderer.strip(throws[0])
    assert strip.shape == (180, 6 * 320, 3)
    last = strip[:, -320:]
    frame = last[108:176, [226, 227, 314, 315]]  # the inset has 86 x 64 px, 6 px from the corner
    assert (frame == film.INK).all()
    red, green, blue = np.moveaxis(strip.astype(int), -1, 0)
    is_path = (red > 180) & (green > 110) & (blue < 90)
    counts = [is_path[:, i : i + 320].sum() for i in range(0, 6 * 320, 320)]
    assert counts[0] < 5
    assert min(counts[3:]) > 30
    assert (np.abs(last[-16:-8, 20:60].astype(int) - film.BAD).sum(axis=-1) < 20).mean() > 0.2  # it is a miss


@pytest.mark.slow
def test_a_grid_has_all_throws(throws: list[RecordedThrow], opengl: None, tmp_path: Path):
    numbers: list[int] = []
    path = tmp_path / "grid.mp4"
    count = film.write_throws(path, throws, SceneCfg(), on_throw=numbers.append)
    with av.open(str(path)) as container:
        shapes = {frame.to_ndarray(format="rgb24").shape for frame in container.decode(video=0)}
    assert shapes == {(270, 960, 3)}
    assert numbers == [0, 1]
    boards = [film.storyboard(throw, find_workcell("ur5e_allegro")) for throw in throws]
    assert count == max(len(board.steps) for board in boards) + film.LAST_PICTURES - 1
