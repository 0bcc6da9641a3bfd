"""Simulated throws as a data set."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
import torch
from pyarrow import parquet

from pixel2catch.camera.boxes import pixel_features
from pixel2catch.cli.main import main
from pixel2catch.datasets.lerobot import ACTION, AGE, DONE, IMAGES, REWARD, SEEN, STATE, SUCCESS
from pixel2catch.datasets.throws import write_throws
from pixel2catch.evaluation.loading import load_policy, task_of
from pixel2catch.evaluation.protocol import TRIAL_STEPS, EvaluationCfg
from pixel2catch.scene.constants import RGB_CAMERA

CFG = EvaluationCfg(objects=("cube_s", "sphere_l"), num_envs=3, trials=1, seed=5)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("throws") / "out"
    policy, method = load_policy(None)
    cfg = replace(CFG, task=task_of(policy, physics_hz=120.0))
    num_throws, num_caught, num_steps = write_throws(folder, cfg, policy, method, images=False)
    episodes = steps_of(folder)
    assert (num_throws, num_steps) == (CFG.num_envs, sum(len(episode[DONE]) for episode in episodes))
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
        assert 20 < len(episode[DONE]) <= TRIAL_STEPS
        assert episode[DONE].tolist() == [False] * (len(episode[DONE]) - 1) + [True]
        assert not episode[SUCCESS][:-1].any()
        state, action = episode[STATE][:, :6], episode[ACTION][:, :6]
        lead, moved = (action - state)[:-1], (np.roll(state, -1, axis=0) - state)[:-1]
        assert (lead * moved).sum() > 0.8 * np.sqrt((lead**2).sum() * (moved**2).sum())
        box, pixels = torch.from_numpy(episode[SEEN][:, :4]), torch.from_numpy(episode[SEEN][:, 4:])
        expected = pixel_features(box[:-1], box[1:], RGB_CAMERA)
        torch.testing.assert_close(pixels[1:], expected, atol=1e-3, rtol=1e-4)
        assert (box[:, 2:] > box[:, :2]).all()
        assert (episode[AGE] >= 1.0).all()
        assert np.abs(episode[REWARD]).max() > 0.0
    tasks = parquet.read_table(folder / "meta/tasks.parquet").to_pydict()["__index_level_0__"]
    assert set(tasks) <= {f"Catch the thrown object: {name}." for name in CFG.objects}


def test_the_command_overwrites_nothing(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    options = ["export", "--format", "lerobot", "--throws", "1", "--out"]
    assert main([*options, str(tmp_path / "set")]) == 0
    assert "1 throws" in capsys.readouterr().out
    assert main([*options, str(folder)]) == 2


@pytest.mark.slow
def test_images_show_the_object_where_it_is_one_or_two_steps_later_by_its_box(
    tmp_path: Path, opengl: None
) -> None:
    args = ["--throws", "1", "--objects", "sphere_l", "--images", "--out", str(tmp_path / "out")]
    assert main(["export", "--format", "lerobot", *args]) == 0
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
