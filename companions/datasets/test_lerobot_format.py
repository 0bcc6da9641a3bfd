"""The files of a data set, with numbers by hand."""

import json
from pathlib import Path

import av
import numpy as np
import pytest
from pyarrow import parquet

import pixel2catch as p2c
from lerobot_format import ACTION, IMAGES, STATE, write_dataset

UR5E_ALLEGRO = p2c.find_workcell("ur5e_allegro")
NUM_JOINTS = len(UR5E_ALLEGRO.joints)
COLORS = ((200, 0, 0), (0, 200, 0), (0, 0, 200))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Episodes of two steps and of one, with pictures of one colour."""
    folder = tmp_path_factory.mktemp("lerobot") / "data set"
    pictures = [np.full((48, 64, 3), color, np.uint8) for color in COLORS]
    cup = ("Catch the cup.", columns(1.0, 3.0), pictures[:2])
    ball = ("Catch the ball.", columns(-2.0), pictures[2:])
    assert write_dataset(folder, UR5E_ALLEGRO, [cup, ball]) == (2, 3)
    return folder


def columns(*values: float) -> dict[str, np.ndarray]:
    rows = np.repeat(np.array(values)[:, None], NUM_JOINTS, axis=1)
    is_last = np.arange(len(values)) == len(values) - 1
    return {STATE: rows, ACTION: -rows, "next.reward": np.array(values), "next.done": is_last}


def test_every_control_step(folder: Path) -> None:
    table = parquet.read_table(folder / "data/chunk-000/file-000.parquet")
    assert str(table.schema.field(STATE).type) == f"fixed_size_list<element: float>[{NUM_JOINTS}]"
    found = table.to_pydict()
    assert [row[0] for row in found[STATE]] == [1.0, 3.0, -2.0]
    assert [row[-1] for row in found[ACTION]] == [-1.0, -3.0, 2.0]
    assert found["timestamp"] == pytest.approx([0.0, 1 / 30, 0.0])
    expected = {
        "next.done": [False, True, True],
        "frame_index": [0, 1, 0],
        "index": [0, 1, 2],
        "episode_index": [0, 0, 1],
        "task_index": [0, 0, 1],
    }
    assert {name: found[name] for name in expected} == expected


def test_episodes_and_tasks(folder: Path) -> None:
    episodes = parquet.read_table(folder / "meta/episodes/chunk-000/file-000.parquet").to_pydict()
    tasks = ["Catch the cup.", "Catch the ball."]
    expected = {"length": [2, 1], "tasks": [[task] for task in tasks], "dataset_from_index": [0, 2]}
    assert {name: episodes[name] for name in expected} == expected
    assert episodes[f"videos/{IMAGES}/from_timestamp"] == pytest.approx([0.0, 2 / 30])
    assert episodes[f"videos/{IMAGES}/to_timestamp"] == pytest.approx([2 / 30, 3 / 30])
    table = parquet.read_table(folder / "meta/tasks.parquet")
    assert table.to_pydict() == {"task_index": [0, 1], "__index_level_0__": tasks}
    assert json.loads(table.schema.metadata[b"pandas"])["index_columns"] == ["__index_level_0__"]


def test_statistics_by_hand(folder: Path) -> None:
    """Of 1, 3 and -2: mean 2/3, variance (1 + 49 + 64) / 27."""
    statistics = json.loads((folder / "meta/stats.json").read_text())
    assert {name: values[0] for name, values in statistics["next.reward"].items()} == pytest.approx(
        {"min": -2.0, "max": 3.0, "mean": 2 / 3, "std": (114 / 27) ** 0.5, "count": 3}
    )
    colors = statistics[IMAGES]  # the first image of either episode counts
    assert np.shape(colors["mean"]) == (3, 1, 1)
    assert np.ravel(colors["mean"]) == pytest.approx([100 / 255, 0.0, 100 / 255])
    assert colors["count"] == [2]


def test_description(folder: Path) -> None:
    info = json.loads((folder / "meta/info.json").read_text())
    assert (info["codebase_version"], info["fps"], info["robot_type"]) == ("v3.0", 30, UR5E_ALLEGRO.name)
    assert [info[f"total_{name}"] for name in ("episodes", "frames", "tasks")] == [2, 3, 2]
    features = {name: (each["dtype"], each["shape"]) for name, each in info["features"].items()}
    assert features[STATE] == ("float32", [NUM_JOINTS])
    assert features[IMAGES] == ("video", [48, 64, 3])
    assert features["next.done"] == ("bool", [1])
    for path in (info["video_path"], info["data_path"]):
        assert (folder / path.format(video_key=IMAGES, chunk_index=0, file_index=0)).exists()


def test_images_come_at_the_times_of_their_steps(folder: Path) -> None:
    with av.open(str(folder / "videos" / IMAGES / "chunk-000/file-000.mp4")) as video:
        frames = list(video.decode(video=0))
    assert [frame.time for frame in frames] == pytest.approx([0.0, 1 / 30, 2 / 30], abs=1e-4)
    for frame, color in zip(frames, COLORS, strict=True):
        assert np.abs(frame.to_ndarray(format="rgb24").mean(axis=(0, 1)) - color).max() < 8
