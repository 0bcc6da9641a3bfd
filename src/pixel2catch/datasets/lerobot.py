"""Writing data sets of LeRobot: format 3.0, as its class `LeRobotDataset` loads them. Needs pyarrow.

FOLDER/meta/info.json, stats.json      features and their statistics
FOLDER/meta/tasks.parquet              the tasks in words
FOLDER/meta/episodes/...               length, task and statistics of every episode
FOLDER/data/chunk-000/file-000.parquet all control steps
FOLDER/videos/KEY/chunk-000/...        the images of all episodes, one after the other
"""

import json
from collections.abc import Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, final

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
IMAGES = "observation.images.rgb"  #: What the robot's camera sees.

VERSION = "v3.0"  #: Of the format.
FPS = round(1.0 / CONTROL_DT)  #: Control steps in a second.
FILE = "chunk-000/file-000"  #: Data, episodes and images are one file each.
PATTERN = "chunk-{chunk_index:03d}/file-{file_index:03d}"  #: How the format names such files.
QUANTILES = (0.01, 0.10, 0.50, 0.90, 0.99)  #: That the statistics have.
GOP = 2  #: Images from one that is stored whole to the next: readers jump about. Source: LeRobot.
SAMPLED = (5, 16)  #: Every so many images, rows and columns count in the images' statistics. Source: ours.

Statistics = dict[str, list[Any]]


@dataclass(frozen=True, kw_only=True)
class _Episode:
    """What is remembered of an episode; its columns are by feature, (num_steps, size)."""

    task: str
    columns: dict[str, np.ndarray]
    pixels: list[np.ndarray]  #: Sampled pixels, (num_pixels, 3).

    @property
    def num_steps(self) -> int:
        return len(self.columns["index"])

    @property
    def statistics(self) -> dict[str, Statistics]:
        found = {name: _statistics(column) for name, column in self.columns.items()}
        return found | ({IMAGES: _of_images(self.pixels)} if self.pixels else {})


@final
class DatasetWriter(AbstractContextManager["DatasetWriter"]):
    """Writes a data set step by step; use it as a context manager: all but the images is written at its end.

    All steps must have the same features.
    """

    def __init__(self, folder: Path, workcell: WorkcellSpec) -> None:
        """Begin a data set of a work cell's robots, in a new or empty folder.

        Raises:
            InvalidValueError: There is something in the folder, or it cannot be made.
        """
        require_free_folder(folder)
        self._folder, self._robot, joints = folder, workcell.name, workcell.joint_names
        seen = ("xmin", "ymin", "xmax", "ymax", *PIXEL_FEATURES)
        self._names = {STATE: joints, ACTION: joints, SEEN: seen}
        self._episodes = list[_Episode]()
        self._steps = list[dict[str, np.ndarray]]()
        self._pixels = list[np.ndarray]()
        self._num_steps, self._image_shape = 0, (0, 0, 0)
        self._video: VideoWriter | None = None

    @property
    def num_episodes(self) -> int:
        """Episodes so far."""
        return len(self._episodes)

    @property
    def num_steps(self) -> int:
        """Control steps so far."""
        return self._num_steps

    def add(self, step: Mapping[str, Any], image: Pixels | None = None) -> None:
        """Add a control step to the episode: numbers or booleans by feature, and what the camera saw."""
        if image is not None:
            self._add_image(image)
        self._steps.append({name: np.atleast_1d(value) for name, value in step.items()})
        self._num_steps += 1

    def end_episode(self, task: str) -> None:
        """End an episode, in which this was to be done; one without a step is none."""
        if not self._steps:
            return
        num_steps, order = len(self._steps), np.arange(len(self._steps))[:, None]
        columns = {name: np.stack([step[name] for step in self._steps]) for name in self._steps[0]}
        tasks = list(dict.fromkeys([*(episode.task for episode in self._episodes), task]))
        columns = {
            name: column if column.dtype == np.bool_ else column.astype(np.float32)
            for name, column in columns.items()
        } | {
            "timestamp": (order / FPS).astype(np.float32),
            "frame_index": order,
            "episode_index": np.full_like(order, self.num_episodes),
            "index": order + self._num_steps - num_steps,
            "task_index": np.full_like(order, tasks.index(task)),
        }
        self._episodes.append(_Episode(task=task, columns=columns, pixels=self._pixels))
        self._steps, self._pixels = [], []

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Write everything else, unless there was an error.

        Raises:
            InvalidValueError: There was no episode.
        """
        if self._video:
            self._video.close()
        if error is None:
            self._write()

    def _add_image(self, image: Pixels) -> None:
        path = self._folder / "videos" / IMAGES / f"{FILE}.mp4"
        if self._video is None:
            path.parent.mkdir(parents=True)
            self._video = VideoWriter(path, fps=FPS, gop=GOP)
            self._image_shape = (*image.shape[:2], 3)
        self._video.write(image)
        every, stride = SAMPLED
        if len(self._steps) % every == 0:
            self._pixels.append(image[::stride, ::stride].reshape(-1, 3))

    def _write(self) -> None:
        import pyarrow
        from pyarrow import parquet

        if not self._episodes:
            raise InvalidValueError("there is no episode to write; look whether anything was thrown.")
        tasks = list(dict.fromkeys(episode.task for episode in self._episodes))
        columns = {
            name: np.concatenate([episode.columns[name] for episode in self._episodes])
            for name in self._episodes[0].columns
        }
        pixels = [each for episode in self._episodes for each in episode.pixels]
        statistics = {name: _statistics(column) for name, column in columns.items()}
        statistics |= {IMAGES: _of_images(pixels)} if pixels else {}
        tables = {
            f"data/{FILE}": pyarrow.table({name: _arrow(column) for name, column in columns.items()}),
            f"meta/episodes/{FILE}": pyarrow.Table.from_pylist(self._rows()),
            "meta/tasks": _task_table(tasks),
        }
        for name, table in tables.items():
            path = self._folder / f"{name}.parquet"
            path.parent.mkdir(parents=True, exist_ok=True)
            parquet.write_table(table, path)
        for name, content in (("info", self._info(columns, len(tasks))), ("stats", statistics)):
            (self._folder / "meta" / f"{name}.json").write_text(json_text(content))

    def _rows(self) -> list[dict[str, Any]]:
        rows, begin = list[dict[str, Any]](), 0
        for number, episode in enumerate(self._episodes):
            end = begin + episode.num_steps
            files = ("data", "meta/episodes", *([f"videos/{IMAGES}"] if self._video else []))
            row: dict[str, Any] = {"episode_index": number, "tasks": [episode.task], "length": end - begin}
            row |= {f"{file}/{kind}_index": 0 for file in files for kind in ("chunk", "file")}
            row |= {"dataset_from_index": begin, "dataset_to_index": end}
            if self._video:
                times = {"from_timestamp": begin / FPS, "to_timestamp": end / FPS}
                row |= {f"videos/{IMAGES}/{name}": time for name, time in times.items()}
            for feature, found in episode.statistics.items():
                row |= {f"stats/{feature}/{name}": values for name, values in found.items()}
            rows.append(row)
            begin = end
        return rows

    def _info(self, columns: Mapping[str, np.ndarray], num_tasks: int) -> dict[str, Any]:
        features: dict[str, Any] = {
            name: {
                "dtype": str(column.dtype),
                "shape": list(column.shape[1:]),
                "names": list(self._names.get(name, ())) or None,
            }
            for name, column in columns.items()
        }
        if self._video:
            height, width, channels = self._image_shape
            video = {"height": height, "width": width, "codec": "h264", "pix_fmt": "yuv420p", "fps": FPS}
            video |= {"channels": channels, "is_depth_map": False}
            features[IMAGES] = {
                "dtype": "video",
                "shape": [height, width, channels],
                "names": ["height", "width", "channels"],
                "info": {f"video.{name}": value for name, value in video.items()} | {"has_audio": False},
            }
        return {
            "codebase_version": VERSION,
            "robot_type": self._robot,
            "total_episodes": self.num_episodes,
            "total_frames": self.num_steps,
            "total_tasks": num_tasks,
            "chunks_size": 1000,
            "data_files_size_in_mb": 100,
            "video_files_size_in_mb": 200,
            "fps": FPS,
            "splits": {"train": f"0:{self.num_episodes}"},
            "data_path": f"data/{PATTERN}.parquet",
            "video_path": f"videos/{{video_key}}/{PATTERN}.mp4" if self._video else None,
            "features": features,
        }


def _arrow(column: np.ndarray) -> "pyarrow.Array":
    """A column as the format stores it: rows of one number are that number."""
    import pyarrow

    values, size = pyarrow.array(column.reshape(-1)), column.shape[1]
    return values if size == 1 else pyarrow.FixedSizeListArray.from_arrays(values, size)


def _statistics(column: np.ndarray) -> Statistics:
    values = column.astype(np.float64)
    found = {"min": values.min(axis=0), "max": values.max(axis=0)}
    found |= {"mean": values.mean(axis=0), "std": values.std(axis=0), "count": np.array([len(values)])}
    quantiles = np.quantile(values, QUANTILES, axis=0)
    found |= {f"q{100 * q:02.0f}": row for q, row in zip(QUANTILES, quantiles, strict=True)}
    return {name: value.tolist() for name, value in found.items()}


def _of_images(pixels: list[np.ndarray]) -> Statistics:
    """Statistics of every colour as a share of the brightest, (3, 1, 1); images are counted."""
    found = _statistics(np.concatenate(pixels) / 255.0)
    shaped = {name: [[[value]] for value in values] for name, values in found.items()}
    return shaped | {"count": [len(pixels)]}


def _task_table(tasks: list[str]) -> "pyarrow.Table":
    """The tasks in words; pandas reads the words as the names of the rows."""
    import pyarrow

    index = "__index_level_0__"
    table = pyarrow.table({"task_index": np.arange(len(tasks)), index: tasks})
    kinds = {"task_index": ("task_index", "int64", "int64"), index: (None, "unicode", "object")}
    columns = [
        {"name": name, "field_name": field, "pandas_type": kind, "numpy_type": stored, "metadata": None}
        for field, (name, kind, stored) in kinds.items()
    ]
    described = {
        "index_columns": [index],
        "column_indexes": [],
        "columns": columns,
        "pandas_version": "2.0.0",
    }
    return table.replace_schema_metadata({"pandas": json.dumps(described)})
