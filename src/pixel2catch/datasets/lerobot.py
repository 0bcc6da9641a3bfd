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
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pixel2catch.camera.boxes import PIXEL_FEATURES
from pixel2catch.camera.image import Pixels
from pixel2catch.errors import InvalidValueError
from pixel2catch.files import json_text, require_free_folder
from pixel2catch.rendering.video import VideoWriter
from pixel2catch.robots.workcell import WorkcellSpec
from pixel2catch.scene.constants import CONTROL_DT

if TYPE_CHECKING:
    import pyarrow

STATE = "observation.state"  #: Measured joint positions [rad].
ACTION = "action"  #: Joint targets of the policy [rad].
SEEN = "observation.environment_state"  #: Newest box of the object [px], and its pixel features.
AGE = "observation.box_age"  #: Age of that box [control steps]; in simulation only.
REWARD = "next.reward"  #: Sum of the agents' rewards; in simulation only.
DONE = "next.done"  #: Whether the episode ends with this step.
SUCCESS = "next.success"  #: Whether it ends with a catch; in simulation only.
IMAGES = "observation.images.rgb"  #: Image of the robot's camera.

VERSION = "v3.0"  #: Version of the format.
FPS = round(1.0 / CONTROL_DT)  #: Control steps per second.
FILE = "chunk-000/file-000"  #: Name of the only file of data, of episodes, and of images.
PATTERN = "chunk-{chunk_index:03d}/file-{file_index:03d}"  #: Pattern of such names in the format.
TASK_NAMES = "__index_level_0__"  #: Column that pandas reads as the names of the rows.
GOP = 2  #: Images from one that is stored whole to the next, for random access. Source: LeRobot.
SAMPLED = (5, 16)  #: Statistics use every 5th image, and every 16th row and column. Source: ours.

Step = tuple[Mapping[str, Any], Pixels | None]  #: Numbers or booleans by feature, and an image.
Episode = tuple[str, Iterable[Step]]  #: A task in words, and the control steps.


def write_dataset(folder: Path, workcell: WorkcellSpec, episodes: Iterable[Episode]) -> tuple[int, int]:
    """Write a data set of a work cell's robots into a new or empty folder.

    Images are written at once, everything else at the end. All steps have the same features. Episodes without
    a step are left out.

    Returns:
        The number of episodes, and of control steps.

    Raises:
        InvalidValueError: The folder is not empty or cannot be made, or there is no episode.
    """
    require_free_folder(folder)
    steps, ends, tasks, images = list[Mapping[str, Any]](), [0], list[str](), _Images(folder)
    with closing(images):
        for task, episode in episodes:
            for number, (step, image) in enumerate(episode):
                steps.append({name: np.atleast_1d(value) for name, value in step.items()})
                if image is not None:
                    images.add(image, number)
            if len(steps) > ends[-1]:
                ends.append(len(steps))
                tasks.append(task)
    if not tasks:
        raise InvalidValueError("there is no episode to write; check that anything was thrown.")
    columns = _columns(steps, ends, tasks)
    statistics = {name: _statistics(column) for name, column in columns.items()}
    info = _info(columns, workcell, len(tasks), len(set(tasks)))
    if images.pixels:
        info["video_path"] = f"videos/{{video_key}}/{PATTERN}.mp4"
        info["features"][IMAGES], statistics[IMAGES] = images.described()
    _write_tables(folder, columns, _episodes(ends, tasks, has_video=bool(images.pixels)), tasks)
    for name, content in (("info", info), ("stats", statistics)):
        (folder / "meta" / f"{name}.json").write_text(json_text(content))
    return len(tasks), len(steps)


class _Images:
    """The video of a data set, and the pixels of some of its images."""

    def __init__(self, folder: Path) -> None:
        self._path = folder / "videos" / IMAGES / f"{FILE}.mp4"
        self._video: VideoWriter | None = None
        self._shape: tuple[int, ...] = ()
        self.pixels = list[np.ndarray]()  #: Of each image that counts in the statistics, (num_pixels, 3).

    def add(self, image: Pixels, number: int) -> None:
        """Write an image, by its number in the episode."""
        if self._video is None:
            self._path.parent.mkdir(parents=True)
            self._video, self._shape = VideoWriter(self._path, fps=FPS, gop=GOP), image.shape
        self._video.write(image)
        every, stride = SAMPLED
        if number % every == 0:
            self.pixels.append(image[::stride, ::stride].reshape(-1, 3))

    def close(self) -> None:
        if self._video:
            self._video.close()

    def described(self) -> tuple[dict[str, Any], dict[str, list[Any]]]:
        """Return the feature, and statistics of shares of full brightness, (3, 1, 1); images are counted."""
        names = ["height", "width", "channels"]
        found = _statistics(np.concatenate(self.pixels) / 255.0)
        shaped = {name: [[[value]] for value in values] for name, values in found.items()}
        feature = {"dtype": "video", "shape": list(self._shape), "names": names}
        return feature, shaped | {"count": [len(self.pixels)]}


def _columns(
    steps: Sequence[Mapping[str, Any]], ends: Sequence[int], tasks: Sequence[str]
) -> dict[str, np.ndarray]:
    """Return every feature over all steps, (num_steps, size)."""
    lengths, names = np.diff(ends), list(dict.fromkeys(tasks))
    episode = np.repeat(np.arange(len(lengths)), lengths)
    frame = np.concatenate([np.arange(length) for length in lengths])
    stacked = {name: np.stack([step[name] for step in steps]) for name in steps[0]}
    numbers = {
        "timestamp": (frame / FPS).astype(np.float32),
        "frame_index": frame,
        "episode_index": episode,
        "index": np.arange(len(frame)),
        "task_index": np.array([names.index(task) for task in tasks])[episode],
    }
    return {
        name: column if column.dtype == np.bool_ else column.astype(np.float32)
        for name, column in stacked.items()
    } | {name: column[:, None] for name, column in numbers.items()}


def _write_tables(
    folder: Path, columns: Mapping[str, np.ndarray], episodes: list[dict[str, Any]], tasks: Sequence[str]
) -> None:
    import pyarrow
    from pyarrow import parquet

    names = list(dict.fromkeys(tasks))
    table = pyarrow.table({"task_index": np.arange(len(names)), TASK_NAMES: names})
    tables = {
        f"data/{FILE}": pyarrow.table({name: _arrow(column) for name, column in columns.items()}),
        f"meta/episodes/{FILE}": pyarrow.Table.from_pylist(episodes),
        "meta/tasks": table.replace_schema_metadata({"pandas": json.dumps(PANDAS)}),
    }
    for name, table in tables.items():
        path = folder / f"{name}.parquet"
        path.parent.mkdir(parents=True, exist_ok=True)
        parquet.write_table(table, path)


def _episodes(ends: Sequence[int], tasks: Sequence[str], *, has_video: bool) -> list[dict[str, Any]]:
    rows, files = list[dict[str, Any]](), ["data", "meta/episodes"]
    files += [f"videos/{IMAGES}"] if has_video else []
    for number, (begin, end, task) in enumerate(zip(ends[:-1], ends[1:], tasks, strict=True)):
        row: dict[str, Any] = {"episode_index": number, "tasks": [task], "length": end - begin}
        row |= {f"{file}/{kind}_index": 0 for file in files for kind in ("chunk", "file")}
        row |= {"dataset_from_index": begin, "dataset_to_index": end}
        if has_video:
            row[f"videos/{IMAGES}/from_timestamp"] = begin / FPS
            row[f"videos/{IMAGES}/to_timestamp"] = end / FPS
        rows.append(row)
    return rows


def _info(
    columns: Mapping[str, np.ndarray], workcell: WorkcellSpec, num_episodes: int, num_tasks: int
) -> dict[str, Any]:
    joints = list(workcell.joint_names)
    seen = ["xmin", "ymin", "xmax", "ymax", *PIXEL_FEATURES]
    names = {STATE: joints, ACTION: joints, SEEN: seen}
    return {
        "codebase_version": VERSION,
        "robot_type": workcell.name,
        "total_episodes": num_episodes,
        "total_frames": len(columns["index"]),
        "total_tasks": num_tasks,
        "chunks_size": 1000,
        "data_files_size_in_mb": 100,
        "video_files_size_in_mb": 200,
        "fps": FPS,
        "splits": {"train": f"0:{num_episodes}"},
        "data_path": f"data/{PATTERN}.parquet",
        "video_path": None,
        "features": {
            name: {"dtype": str(column.dtype), "shape": list(column.shape[1:]), "names": names.get(name)}
            for name, column in columns.items()
        },
    }


PANDAS = {
    "index_columns": [TASK_NAMES],
    "column_indexes": [],
    "columns": [
        {"name": name, "field_name": field, "pandas_type": kind, "numpy_type": stored, "metadata": None}
        for field, name, kind, stored in (
            ("task_index", "task_index", "int64", "int64"),
            (TASK_NAMES, None, "unicode", "object"),
        )
    ],
    "pandas_version": "2.0.0",
}
"""Metadata of the table of tasks, from which pandas takes the names of the rows."""


def _arrow(column: np.ndarray) -> "pyarrow.Array":
    """Return a column as the format stores it: rows of one number as that number."""
    import pyarrow

    values, size = pyarrow.array(column.reshape(-1)), column.shape[1]
    return values if size == 1 else pyarrow.FixedSizeListArray.from_arrays(values, size)


def _statistics(column: np.ndarray) -> dict[str, list[Any]]:
    values = column.astype(np.float64)
    found = {name: getattr(values, name)(axis=0).tolist() for name in ("min", "max", "mean", "std")}
    return found | {"count": [len(values)]}
