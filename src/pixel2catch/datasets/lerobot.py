"""A writer of LeRobot data sets: format 3.0, as its class `LeRobotDataset` loads them. Needs pyarrow.

The package `lerobot` (0.4.4) is no dependency: it needs older versions of PyTorch and PyAV than this package.

FOLDER/meta/info.json, stats.json      features and their statistics
FOLDER/meta/tasks.parquet              the tasks in words
FOLDER/meta/episodes/...               length and task of every episode
FOLDER/data/chunk-000/file-000.parquet all control steps
FOLDER/videos/KEY/chunk-000/...        the images of all episodes, one after the other
"""

import json
from collections.abc import Iterable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pixel2catch.camera.boxes import PIXEL_FEATURES
from pixel2catch.camera.image import Pixels
from pixel2catch.files import json_text, require_free_folder
from pixel2catch.rendering.video import VideoWriter
from pixel2catch.robots.workcell import WorkcellSpec
from pixel2catch.scene.constants import CONTROL_DT

STATE = "observation.state"  #: Measured joint positions [rad].
ACTION = "action"  #: Joint targets of the policy [rad].
SEEN = "observation.environment_state"  #: Newest box of the object [px], and its pixel features.
AGE = "observation.box_age"  #: Age of that box [control steps]; in simulation only.
REWARD = "next.reward"  #: Sum of the agents' rewards; in simulation only.
DONE = "next.done"  #: Whether the episode ends with this step.
SUCCESS = "next.success"  #: Whether it ends with a catch; in simulation only.
IMAGES = "observation.images.rgb"  #: Image of the robot's camera.

FPS = round(1.0 / CONTROL_DT)  #: Control steps per second.
FILE = "chunk-000/file-000"  #: Name of the only file of data, of episodes, and of images.
VIDEO = f"videos/{IMAGES}/{FILE}.mp4"
IMAGE_AXES = ("height", "width", "channels")
PATTERN = "chunk-{chunk_index:03d}/file-{file_index:03d}"  #: Pattern of such names in the format.
TASK_NAMES = "__index_level_0__"  #: Column that pandas reads as the names of the rows.
GOP = 2  #: Images from one that is stored whole to the next, for random access. Source: LeRobot.
SAMPLED = (5, 16)  #: Statistics use every 5th image, and every 16th row and column. Source: ours.


@dataclass(frozen=True, kw_only=True)
class Episode:
    """Control steps, at least one."""

    task: str  #: In words.
    columns: Mapping[str, np.ndarray]  #: Numbers or booleans by feature, (num_steps, size).
    images: Iterable[Pixels] = ()  #: One for each step, or none.


def write_dataset(folder: Path, workcell: WorkcellSpec, episodes: Iterable[Episode]) -> tuple[int, int]:
    """Write a data set of a work cell's robots into a new or empty folder.

    Images are written at once, everything else at the end. All episodes have the same features.

    Returns:
        The number of episodes, and of control steps.

    Raises:
        InvalidValueError: The folder is not empty or cannot be made.
    """
    require_free_folder(folder)
    written, samples, shape = list[Episode](), list[np.ndarray](), list[int]()
    with ExitStack() as stack:
        video: VideoWriter | None = None
        for episode in episodes:
            written.append(episode)
            for number, image in enumerate(episode.images):
                if video is None:
                    video = stack.enter_context(VideoWriter(_placed(folder, VIDEO), fps=FPS, gop=GOP))
                    shape = list(image.shape)
                video.write(image)
                every, stride = SAMPLED
                if number % every == 0:
                    samples.append(image[::stride, ::stride].reshape(-1, 3))
    tasks = list(dict.fromkeys(episode.task for episode in written))
    columns = _columns(written, tasks)
    features = {name: (str(column.dtype), list(column.shape[1:])) for name, column in columns.items()}
    statistics = {name: _statistics(column) for name, column in columns.items()}
    if samples:
        features[IMAGES] = ("video", shape)
        shares = _statistics(np.concatenate(samples) / 255.0)  # of full brightness, (3, 1, 1)
        statistics[IMAGES] = {name: [[[value]] for value in values] for name, values in shares.items()}
        statistics[IMAGES]["count"] = [len(samples)]
    _write_tables(folder, columns, written, tasks, has_video=bool(samples))
    counts = {"episodes": len(written), "frames": len(columns["index"]), "tasks": len(tasks)}
    info = _info(workcell, features, counts, has_video=bool(samples))
    for name, content in (("info", info), ("stats", statistics)):
        (folder / "meta" / f"{name}.json").write_text(json_text(content))
    return counts["episodes"], counts["frames"]


def _placed(folder: Path, name: str) -> Path:
    """Return the path of a file, whose folder is made."""
    path = folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    return path


def _columns(episodes: Sequence[Episode], tasks: Sequence[str]) -> dict[str, np.ndarray]:
    """Return every feature over all steps, (num_steps, size)."""
    lengths = [len(episode.columns[DONE]) for episode in episodes]
    frame = np.concatenate([np.arange(length) for length in lengths])
    columns = {
        "timestamp": (frame / FPS).astype(np.float32),
        "frame_index": frame,
        "episode_index": np.repeat(np.arange(len(episodes)), lengths),
        "index": np.arange(len(frame)),
        "task_index": np.repeat([tasks.index(each.task) for each in episodes], lengths),
    }
    for name in episodes[0].columns:
        values = np.concatenate([each.columns[name] for each in episodes])
        columns[name] = values if values.dtype == bool else values.astype(np.float32)
    return {name: values.reshape(len(frame), -1) for name, values in columns.items()}


def _write_tables(
    folder: Path,
    columns: Mapping[str, np.ndarray],
    episodes: Sequence[Episode],
    tasks: Sequence[str],
    *,
    has_video: bool,
) -> None:
    import pyarrow
    from pyarrow import parquet

    rows, begin = list[dict[str, Any]](), 0
    files = ["data", "meta/episodes", *([f"videos/{IMAGES}"] if has_video else [])]
    for number, episode in enumerate(episodes):
        end = begin + len(episode.columns[DONE])
        row: dict[str, Any] = {"episode_index": number, "tasks": [episode.task], "length": end - begin}
        row |= {f"{file}/{kind}_index": 0 for file in files for kind in ("chunk", "file")}
        row |= {"dataset_from_index": begin, "dataset_to_index": end}
        times = {f"{files[-1]}/from_timestamp": begin / FPS, f"{files[-1]}/to_timestamp": end / FPS}
        rows.append(row | times if has_video else row)
        begin = end
    steps = {
        name: pyarrow.FixedSizeListArray.from_arrays(values.reshape(-1), values.shape[1])
        if values.shape[1] > 1
        else values[:, 0]
        for name, values in columns.items()
    }
    names = pyarrow.table({"task_index": np.arange(len(tasks)), TASK_NAMES: tasks})
    for name, table in {
        f"data/{FILE}": pyarrow.table(steps),
        f"meta/episodes/{FILE}": pyarrow.Table.from_pylist(rows),
        "meta/tasks": names.replace_schema_metadata({"pandas": json.dumps(PANDAS)}),
    }.items():
        parquet.write_table(table, _placed(folder, f"{name}.parquet"))


INDEX = {"name": None, "field_name": TASK_NAMES, "pandas_type": "unicode", "numpy_type": "object"}
PANDAS = {"index_columns": [TASK_NAMES], "columns": [INDEX], "pandas_version": "2.0.0"}
"""Metadata of the table of tasks, from which pandas takes the names of the rows."""


def _info(
    workcell: WorkcellSpec,
    features: Mapping[str, tuple[str, list[int]]],
    counts: Mapping[str, int],
    *,
    has_video: bool,
) -> dict[str, Any]:
    seen = ["xmin", "ymin", "xmax", "ymax", *PIXEL_FEATURES]
    names = {STATE: workcell.joint_names, ACTION: workcell.joint_names, SEEN: seen, IMAGES: IMAGE_AXES}
    return {f"total_{name}": count for name, count in counts.items()} | {
        "codebase_version": "v3.0",
        "robot_type": workcell.name,
        "chunks_size": 1000,
        "data_files_size_in_mb": 100,
        "video_files_size_in_mb": 200,
        "fps": FPS,
        "splits": {"train": f"0:{counts['episodes']}"},
        "data_path": f"data/{PATTERN}.parquet",
        "video_path": f"videos/{{video_key}}/{PATTERN}.mp4" if has_video else None,
        "features": {
            name: {"dtype": kind, "shape": shape, "names": names.get(name)}
            for name, (kind, shape) in features.items()
        },
    }


def _statistics(column: np.ndarray) -> dict[str, list[Any]]:
    values = column.astype(np.float64)
    found = {name: getattr(values, name)(axis=0).tolist() for name in ("min", "max", "mean", "std")}
    return found | {"count": [len(values)]}
