"""Write data sets in LeRobot's format 3.0, as its class `LeRobotDataset` loads them. Needs pyarrow.

The package `lerobot` (0.4.4) is not needed: it needs older versions of PyTorch and PyAV than pixel2catch.

FOLDER/meta/info.json, stats.json      features and their statistics
FOLDER/meta/tasks.parquet              the tasks in words
FOLDER/meta/episodes/...               length and task of every episode
FOLDER/data/chunk-000/file-000.parquet all control steps
FOLDER/videos/KEY/chunk-000/...        the images of all episodes, one after the other
"""

import json
from collections.abc import Iterable, Mapping, Sequence
from contextlib import ExitStack
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
import pyarrow
from pyarrow import parquet

import pixel2catch as p2c

STATE = "observation.state"  #: Measured joint positions [rad].
ACTION = "action"  #: Joint targets of the policy [rad].
SEEN = "observation.environment_state"  #: Newest box of the object [px], and its pixel features.
AGE = "observation.box_age"  #: Age of that box [control steps]; in simulation only.
REWARD = "next.reward"  #: Sum of the agents' rewards; in simulation only.
DONE = "next.done"  #: Whether the episode ends with this step.
SUCCESS = "next.success"  #: Whether it ends with a catch; in simulation only.
IMAGES = "observation.images.rgb"  #: Image of the robot's camera.

FPS = round(1.0 / p2c.constants.CONTROL_DT)  #: Control steps per second.
FILE = "chunk-000/file-000"  #: Name of the only file of data, of episodes, and of images.
VIDEO = f"videos/{IMAGES}/{FILE}.mp4"
PATTERN = "chunk-{chunk_index:03d}/file-{file_index:03d}"  #: Pattern of such names in the format.
TASK_NAMES = "__index_level_0__"  #: Column that pandas reads as the names of the rows.
GOP = 2  #: Images from one that is stored whole to the next, for random access. Source: LeRobot.
INDEX = {"name": None, "field_name": TASK_NAMES, "pandas_type": "unicode", "numpy_type": "object"}
PANDAS = {"index_columns": [TASK_NAMES], "columns": [INDEX], "pandas_version": "2.0.0"}
"""Metadata of the table of tasks, from which pandas takes the names of the rows."""
SAMPLED = (5, 16)  #: Statistics use every 5th image, and every 16th row and column. Source: ours.


Episode = tuple[str, Mapping[str, np.ndarray], Iterable[np.ndarray]]
"""A task in words, numbers or booleans by feature, (num_steps, size), and an image for each step, or none.

Images have a height and a width that are even, and three bytes for each pixel: (height, width, 3).
"""


def write_dataset(folder: Path, workcell: p2c.WorkcellSpec, episodes: Iterable[Episode]) -> tuple[int, int]:
    """Write a data set of a work cell's robots into a new or empty folder.

    Images are written at once, everything else at the end. All episodes have the same features, and steps.

    Returns:
        The number of episodes, and of control steps.

    Raises:
        OSError: The folder has files, or cannot be made.
    """
    require_free_folder(folder)
    tasks, parts, images = list[str](), list[Mapping[str, np.ndarray]](), _Images(folder)
    with images:
        for task, columns, pictures in episodes:
            tasks.append(task)
            parts.append(columns)
            images.add(pictures)
    lengths = np.array([len(part[DONE]) for part in parts])
    joined = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    columns = _columns(joined, lengths, tasks)
    _write_tables(folder, columns, _episodes(lengths, tasks, has_video=bool(images.samples)), tasks)
    features = {name: (str(column.dtype), list(column.shape[1:])) for name, column in columns.items()}
    statistics = {name: _statistics(column) for name, column in columns.items()}
    if images.samples:
        features[IMAGES], statistics[IMAGES] = ("video", images.shape), images.statistics()
    contents = {"info": _info(workcell, features, lengths, tasks), "stats": statistics}
    for name, content in contents.items():
        (folder / "meta" / f"{name}.json").write_text(json.dumps(content, indent=2, default=int))
    return len(parts), int(lengths.sum())


def require_free_folder(folder: Path) -> None:
    """Make a folder; raise OSError if it has files, or cannot be made."""
    folder.mkdir(parents=True, exist_ok=True)
    if any(folder.iterdir()):
        raise FileExistsError(f"'{folder}' has files; give another --out, or empty it")


class _Images(ExitStack):
    """The video of a data set, and the pixels of some of its images."""

    def __init__(self, folder: Path) -> None:
        super().__init__()
        self._path, self._stream = folder / VIDEO, None
        self.shape = list[int]()
        self.samples = list[np.ndarray]()  #: Of each image that counts in the statistics, (num_pixels, 3).

    def add(self, images: Iterable[np.ndarray]) -> None:
        """Write the images of an episode."""
        every, stride = SAMPLED
        for number, image in enumerate(images):
            if self._stream is None:
                self.shape = list(image.shape)
                self._stream = self._opened()
            self._container.mux(self._stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
            if number % every == 0:
                self.samples.append(image[::stride, ::stride].reshape(-1, 3))

    def _opened(self) -> Any:
        """Open the video, which this context completes."""
        self._path.parent.mkdir(parents=True)
        self._container = self.enter_context(av.open(str(self._path), "w"))
        stream: Any = self._container.add_stream("libx264", rate=Fraction(FPS), options={"g": str(GOP)})
        stream.height, stream.width, _ = self.shape
        stream.pix_fmt = "yuv420p"
        self.callback(lambda: self._container.mux(stream.encode()))
        return stream

    def statistics(self) -> dict[str, Any]:
        """Return statistics of shares of full brightness, (3, 1, 1); images are counted."""
        shares = _statistics(np.concatenate(self.samples) / 255.0)
        shaped = {name: np.reshape(values, (-1, 1, 1)).tolist() for name, values in shares.items()}
        return shaped | {"count": [len(self.samples)]}


def _columns(
    joined: Mapping[str, np.ndarray], lengths: np.ndarray, tasks: Sequence[str]
) -> dict[str, np.ndarray]:
    """Return every feature over all steps, (num_steps, size)."""
    frame, names = np.concatenate([np.arange(length) for length in lengths]), list(dict.fromkeys(tasks))
    columns = {
        "timestamp": (frame / FPS).astype(np.float32),
        "frame_index": frame,
        "episode_index": np.repeat(np.arange(len(lengths)), lengths),
        "index": np.arange(len(frame)),
        "task_index": np.repeat([names.index(task) for task in tasks], lengths),
    }
    for name, values in joined.items():
        columns[name] = values if values.dtype == bool else values.astype(np.float32)
    return {name: values.reshape(len(frame), -1) for name, values in columns.items()}


def _episodes(lengths: np.ndarray, tasks: Sequence[str], *, has_video: bool) -> dict[str, Any]:
    """Return the columns of the table of episodes."""
    end, zeros = np.cumsum(lengths), np.zeros(len(lengths), dtype=int)
    begin = end - lengths
    table = {"episode_index": np.arange(len(lengths)), "tasks": [[task] for task in tasks], "length": lengths}
    table |= {"dataset_from_index": begin, "dataset_to_index": end}
    files = ["data", "meta/episodes", *([f"videos/{IMAGES}"] if has_video else [])]
    table |= {f"{file}/{kind}_index": zeros for file in files for kind in ("chunk", "file")}
    times = {f"{files[-1]}/from_timestamp": begin / FPS, f"{files[-1]}/to_timestamp": end / FPS}
    return table | times if has_video else table


def _write_tables(
    folder: Path, columns: Mapping[str, np.ndarray], episodes: Mapping[str, Any], tasks: Sequence[str]
) -> None:
    names = list(dict.fromkeys(tasks))
    named = pyarrow.table({"task_index": np.arange(len(names)), TASK_NAMES: names})
    flat = {name: pyarrow.array(values.reshape(-1)) for name, values in columns.items()}
    sizes = {name: values.shape[1] for name, values in columns.items()}
    rows = pyarrow.FixedSizeListArray.from_arrays
    steps = {name: each if sizes[name] == 1 else rows(each, sizes[name]) for name, each in flat.items()}
    tables = {
        f"data/{FILE}": pyarrow.table(steps),
        f"meta/episodes/{FILE}": pyarrow.table(episodes),
        "meta/tasks": named.replace_schema_metadata({"pandas": json.dumps(PANDAS)}),
    }
    for name, table in tables.items():
        path = folder / f"{name}.parquet"
        path.parent.mkdir(parents=True, exist_ok=True)
        parquet.write_table(table, path)


def _info(
    workcell: p2c.WorkcellSpec,
    features: Mapping[str, tuple[str, list[int]]],
    lengths: np.ndarray,
    tasks: Sequence[str],
) -> dict[str, Any]:
    joints, seen = workcell.joint_names, ["xmin", "ymin", "xmax", "ymax", *p2c.PIXEL_FEATURES]
    names = {STATE: joints, ACTION: joints, SEEN: seen, IMAGES: ("height", "width", "channels")}
    return {
        "codebase_version": "v3.0",
        "robot_type": workcell.name,
        "total_episodes": len(lengths),
        "total_frames": lengths.sum(),
        "total_tasks": len({*tasks}),
        "chunks_size": 1000,
        "data_files_size_in_mb": 100,
        "video_files_size_in_mb": 200,
        "fps": FPS,
        "splits": {"train": f"0:{len(lengths)}"},
        "data_path": f"data/{PATTERN}.parquet",
        "video_path": f"videos/{{video_key}}/{PATTERN}.mp4" if IMAGES in features else None,
        "features": {
            name: {"dtype": kind, "shape": shape, "names": names.get(name)}
            for name, (kind, shape) in features.items()
        },
    }


def _statistics(column: np.ndarray) -> dict[str, list[Any]]:
    values = column.astype(np.float64)
    found = {name: getattr(values, name)(axis=0).tolist() for name in ("min", "max", "mean", "std")}
    return found | {"count": [len(values)]}
