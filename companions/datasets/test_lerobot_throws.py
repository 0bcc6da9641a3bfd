"""Simulated throws as a data set."""

import sys
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
import torch
from pyarrow import parquet

import pixel2catch as p2c
from lerobot_format import ACTION, AGE, DONE, IMAGES, REWARD, SEEN, STATE, SUCCESS
from pixel2catch.rendering.renderer import find_gl_backend
from to_lerobot import main, write_throws

OBJECTS, NUM_THROWS = ("cube_s", "sphere_l"), 3


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("throws") / "out"
    policy = p2c.load_policy()
    task = p2c.task_of(policy, physics_hz=120.0)
    cfg = p2c.EvaluationCfg(objects=OBJECTS, num_envs=NUM_THROWS, seed=5, task=task)
    num_throws, num_caught, num_steps = write_throws(folder, policy, cfg, images=False)
    episodes = steps_of(folder)
    assert (num_throws, num_steps) == (NUM_THROWS, sum(len(episode[DONE]) for episode in episodes))
    assert num_caught == sum(episode[SUCCESS][-1] for episode in episodes)
    assert num_caught > 0
    return folder


def steps_of(folder: Path) -> list[dict[str, np.ndarray]]:
    """The columns of every episode."""
    rows: list[dict[str, Any]] = parquet.read_table(folder / "data/chunk-000/file-000.parquet").to_pylist()
    numbers = sorted({row["episode_index"] for row in rows})
    episodes = [[row for row in rows if row["episode_index"] == number] for number in numbers]
    return [{name: np.array([row[name] for row in each]) for name in each[0]} for each in episodes]


def test_every_step_of_the_throws(folder: Path) -> None:
    """Only the last step ends a throw; joints follow their targets; pixel features are those of the boxes."""
    for episode in steps_of(folder):
        assert 20 < len(episode[DONE]) <= p2c.CatchEnvCfg().episode.max_steps
        assert episode[DONE].tolist() == [False] * (len(episode[DONE]) - 1) + [True]
        assert not episode[SUCCESS][:-1].any()
        state, action = episode[STATE][:, :6], episode[ACTION][:, :6]
        lead, moved = (action - state)[:-1], (np.roll(state, -1, axis=0) - state)[:-1]
        assert (lead * moved).sum() > 0.8 * np.sqrt((lead**2).sum() * (moved**2).sum())
        box, pixels = torch.from_numpy(episode[SEEN][:, :4]), torch.from_numpy(episode[SEEN][:, 4:])
        expected = p2c.pixel_features(box[:-1], box[1:], p2c.constants.RGB_CAMERA)
        torch.testing.assert_close(pixels[1:], expected, atol=1e-3, rtol=1e-4)
        assert (box[:, 2:] > box[:, :2]).all()
        assert (episode[AGE] >= 1.0).all()
        assert np.abs(episode[REWARD]).max() > 0.0
    tasks = parquet.read_table(folder / "meta/tasks.parquet").to_pydict()["__index_level_0__"]
    assert set(tasks) <= {f"Catch the thrown object: {name}." for name in OBJECTS}


def run(monkeypatch: pytest.MonkeyPatch, *args: str) -> None:
    monkeypatch.setattr(sys, "argv", ["to_lerobot.py", *args])
    main()


def test_nothing_is_overwritten(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(SystemExit, match="has files"):
        run(monkeypatch, "--throws", "1", "--out", str(folder))


@pytest.mark.slow
def test_images_show_the_object_where_it_is_one_or_two_steps_later_by_its_box(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    args = ("--throws", "1", "--objects", "sphere_l", "--images", "--out", str(tmp_path / "out"))
    try:
        find_gl_backend()
    except p2c.Pixel2CatchError as error:
        pytest.skip(str(error))
    run(monkeypatch, *args)
    with av.open(str(tmp_path / "out/videos" / IMAGES / "chunk-000/file-000.mp4")) as video:
        images = [frame.to_ndarray(format="rgb24").astype(int) for frame in video.decode(video=0)]
    (episode,) = steps_of(tmp_path / "out")
    assert len(images) == len(episode[DONE])
    centers = []
    for red, green, blue in (np.moveaxis(image, -1, 0) for image in images):
        rows, columns = np.nonzero((red > 120) & (green < 0.5 * red) & (blue < 0.5 * red))
        centers.append((np.median(columns), np.median(rows)))
    boxes = 0.5 * (episode[SEEN][:, :2] + episode[SEEN][:, 2:4])
    errors = {late: np.hypot(*(np.array(centers)[:20] - boxes[late : 20 + late]).T) for late in (0, 1, 2)}
    medians = {late: float(np.median(error)) for late, error in errors.items()}
    assert min(medians[1], medians[2]) < 5.0
    assert medians[0] > min(medians[1], medians[2])
