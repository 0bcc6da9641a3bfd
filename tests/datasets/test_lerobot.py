"""The files of a data set, with numbers by hand."""

import json
from pathlib import Path

import av
import numpy as np
import pytest
from pyarrow import parquet

from pixel2catch.datasets.lerobot import ACTION, IMAGES, STATE, Episode, write_dataset
from pixel2catch.workcells.ur5e_allegro import UR5E_ALLEGRO

NUM_JOINTS = len(UR5E_ALLEGRO.joints)
COLORS = ((200, 0, 0), (0, 200, 0), (0, 0, 200))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Episodes of two steps and of one, with pictures of one colour."""
    folder = tmp_path_factory.mktemp("lerobot") / "data set"
    pictures = [np.full((48, 64, 3), color, np.uint8) for color in COLORS]
    episodes = [
        Episode(task=task, columns=columns(values), images=images)
        for task, values, images in (
            ("Catch the cup.", [1.0, 3.0], pictures[:2]),
            ("Catch the ball.", [-2.0], pictures[2:]),
        )
    ]
    assert write_dataset(folder, UR5E_ALLEGRO, episodes) == (2, 3)
    return folder


def columns(values: list[float]) -> dict[str, np.ndarray]:
    rows = np.repeat(np.array(values)[:, None], NUM_JOINTS, axis=1)
    is_last = np.arange(len(values)) == len(values) - 1
    return {STATE: rows, ACTION: -rows, "next.reward": np.array(values), "next.done": is_last}


def test_every_control_step(folder: Path) -> None:
    table = parquet.read_table(folder / "data/chunk-000/file-000.parquet")
    assert str(table.schema.field(STATE).type) == f"fixed_size_list<element: float>[{NUM_JOINTS}]"
    rows = table.to_pylist()
    assert [row[STATE][0] for row in rows] == [1.0, 3.0, -2.0]
    assert [row[ACTION][-1] for row in rows] == [-1.0, -3.0, 2.0]
    assert [row["next.done"] for row in rows] == [False, True, True]
    assert [row["timestamp"] for row in rows] == pytest.approx([0.0, 1 / 30, 0.0])
    for name, expected in (("frame_index", [0, 1, 0]), ("index", [0, 1, 2])):
        assert [row[name] for row in rows] == expected
    for name in ("episode_index", "task_index"):
        assert [row[name] for row in rows] == [0, 0, 1]


def test_episodes_and_tasks(folder: Path) -> None:
    first, second = parquet.read_table(folder / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    assert (first["length"], second["length"]) == (2, 1)
    assert (first["tasks"], second["tasks"]) == (["Catch the cup."], ["Catch the ball."])
    assert (first["dataset_from_index"], first["dataset_to_index"]) == (0, 2)
    assert second[f"videos/{IMAGES}/from_timestamp"] == pytest.approx(2 / 30)
    assert second[f"videos/{IMAGES}/to_timestamp"] == pytest.approx(3 / 30)
    tasks = parquet.read_table(folder / "meta/tasks.parquet")
    assert tasks.to_pydict() == {
        "task_index": [0, 1],
        "__index_level_0__": ["Catch the cup.", "Catch the ball."],
    }
    assert json.loads(tasks.schema.metadata[b"pandas"])["index_columns"] == ["__index_level_0__"]


def test_statistics_by_hand(folder: Path) -> None:
    """Of 1, 3 and -2: mean 2/3, variance (1 + 49 + 64) / 27."""
    statistics = json.loads((folder / "meta/stats.json").read_text())
    reward = {name: values[0] for name, values in statistics["next.reward"].items()}
    assert (reward["min"], reward["max"], reward["count"]) == (-2.0, 3.0, 3)
    assert reward["mean"] == pytest.approx(2 / 3)
    assert reward["std"] == pytest.approx((114 / 27) ** 0.5)
    colors = statistics[IMAGES]  # the first image of either episode counts
    assert np.shape(colors["mean"]) == (3, 1, 1)
    assert np.ravel(colors["mean"]) == pytest.approx([100 / 255, 0.0, 100 / 255])
    assert colors["count"] == [2]


def test_description(folder: Path) -> None:
    info = json.loads((folder / "meta/info.json").read_text())
    assert (info["codebase_version"], info["fps"], info["robot_type"]) == ("v3.0", 30, UR5E_ALLEGRO.name)
    assert (info["total_episodes"], info["total_frames"], info["total_tasks"]) == (2, 3, 2)
    state, images = info["features"][STATE], info["features"][IMAGES]
    assert (state["dtype"], state["shape"]) == ("float32", [NUM_JOINTS])
    assert (images["dtype"], images["shape"]) == ("video", [48, 64, 3])
    assert info["features"]["next.done"] == {"dtype": "bool", "shape": [1], "names": None}
    for path in (info["video_path"], info["data_path"]):
        assert (folder / path.format(video_key=IMAGES, chunk_index=0, file_index=0)).exists()


def test_images_come_at_the_times_of_their_steps(folder: Path) -> None:
    with av.open(str(folder / "videos" / IMAGES / "chunk-000/file-000.mp4")) as video:
        frames = list(video.decode(video=0))
    assert [frame.time for frame in frames] == pytest.approx([0.0, 1 / 30, 2 / 30], abs=1e-4)
    for frame, color in zip(frames, COLORS, strict=True):
        assert np.abs(frame.to_ndarray(format="rgb24").mean(axis=(0, 1)) - color).max() < 8
