"""A writer of LeRobot data sets: format 3.0, as its class `LeRobotDataset` loads them. Needs pyarrow.

The package `lerobot` (0.4.4) is no dependency: it needs older versions of PyTorch and PyAV than this package.

FOLDER/meta/info.json, stats.json      features and their statistics
FOLDER/meta/tasks.parquet              the tasks in words
FOLDER/meta/episodes/...               length and task of every episode
FOLDER/data/chunk-000/file-000.parquet all control steps
FOLDER/videos/KEY/chunk-000/...        the images of all episodes, one after the other
"""

import json
from collections.abc import Mapping
from contextlib import AbstractContextManager
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, final

import numpy as np
from jaxtyping import UInt8

from pixel2catch.camera.boxes import PIXEL_FEATURES
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
SAMPLED = (5, 16)  #: Every so many images, rows and columns count in the images' statistics. Source: ours.

Image = UInt8[np.ndarray, "height width 3"]


@final
class DatasetWriter(AbstractContextManager["DatasetWriter"]):
    """Writes a data set step by step, images at once and everything else at the end of the context.

    All steps have the same features.
    """

    def __init__(self, folder: Path, workcell: WorkcellSpec) -> None:
        """Begin a data set of a work cell's robots, in a new or empty folder.

        Raises:
            InvalidValueError: The folder is not empty or cannot be made.
        """
        require_free_folder(folder)
        self._folder, self._robot, joints = folder, workcell.name, workcell.joint_names
        seen = ("xmin", "ymin", "xmax", "ymax", *PIXEL_FEATURES)
        self._names = {STATE: joints, ACTION: joints, SEEN: seen}
        self._steps = list[dict[str, np.ndarray]]()
        self._ends = list[int]()  # number of steps at the end of each episode
        self._tasks = list[str]()  # of each episode
        self._pixels = list[np.ndarray]()
        self._image_shape = (0, 0, 3)
        self._video: VideoWriter | None = None

    @property
    def num_episodes(self) -> int:
        """Number of ended episodes."""
        return len(self._ends)

    @property
    def num_steps(self) -> int:
        """Number of control steps."""
        return len(self._steps)

    @property
    def _begin(self) -> int:
        """Number of steps before the present episode."""
        return self._ends[-1] if self._ends else 0

    def add(self, step: Mapping[str, Any], image: Image | None = None) -> None:
        """Add a control step to the episode: numbers or booleans by feature, and an image."""
        if image is not None:
            self._add_image(image)
        self._steps.append({name: np.atleast_1d(value) for name, value in step.items()})

    def end_episode(self, task: str) -> None:
        """End an episode with its task; an episode without a step is left out."""
        if self.num_steps > self._begin:
            self._ends.append(self.num_steps)
            self._tasks.append(task)

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

    def _add_image(self, image: Image) -> None:
        path = self._folder / "videos" / IMAGES / f"{FILE}.mp4"
        if self._video is None:
            path.parent.mkdir(parents=True)
            self._video = VideoWriter(path, fps=FPS, gop=GOP)
            self._image_shape = image.shape
        self._video.write(image)
        every, stride = SAMPLED
        if (self.num_steps - self._begin) % every == 0:
            self._pixels.append(image[::stride, ::stride].reshape(-1, 3))

    def _write(self) -> None:
        import pyarrow
        from pyarrow import parquet

        if not self._ends:
            raise InvalidValueError("there is no episode to write; check that anything was thrown.")
        columns, tasks = self._columns(), list(dict.fromkeys(self._tasks))
        statistics = {name: _statistics(column) for name, column in columns.items()}
        if self._pixels:  # shares of full brightness, (3, 1, 1); images are counted
            found = _statistics(np.concatenate(self._pixels) / 255.0)
            shaped = {name: [[[value]] for value in values] for name, values in found.items()}
            statistics[IMAGES] = shaped | {"count": [len(self._pixels)]}
        names = pyarrow.table({"task_index": np.arange(len(tasks)), TASK_NAMES: tasks})
        tables = {
            f"data/{FILE}": pyarrow.table({name: _arrow(column) for name, column in columns.items()}),
            f"meta/episodes/{FILE}": pyarrow.Table.from_pylist(self._episodes()),
            "meta/tasks": names.replace_schema_metadata({"pandas": json.dumps(PANDAS)}),
        }
        for name, table in tables.items():
            path = self._folder / f"{name}.parquet"
            path.parent.mkdir(parents=True, exist_ok=True)
            parquet.write_table(table, path)
        for name, content in (("info", self._info(columns, len(tasks))), ("stats", statistics)):
            (self._folder / "meta" / f"{name}.json").write_text(json_text(content))

    def _columns(self) -> dict[str, np.ndarray]:
        """Return every feature over all ended episodes, (num_steps, size)."""
        lengths = np.diff(self._ends, prepend=0)
        episode, tasks = np.repeat(np.arange(self.num_episodes), lengths), list(dict.fromkeys(self._tasks))
        frame = np.concatenate([np.arange(length) for length in lengths])
        columns = {
            name: np.stack([step[name] for step in self._steps[: self._ends[-1]]]) for name in self._steps[0]
        }
        columns = {
            name: column if column.dtype == np.bool_ else column.astype(np.float32)
            for name, column in columns.items()
        }
        columns |= {
            "timestamp": (frame / FPS).astype(np.float32)[:, None],
            "frame_index": frame[:, None],
            "episode_index": episode[:, None],
            "index": np.arange(len(frame))[:, None],
            "task_index": np.array([tasks.index(task) for task in self._tasks])[episode][:, None],
        }
        return columns

    def _episodes(self) -> list[dict[str, Any]]:
        rows, files = list[dict[str, Any]](), ["data", "meta/episodes"]
        files += [f"videos/{IMAGES}"] if self._video else []
        for number, (begin, end, task) in enumerate(
            zip([0, *self._ends], self._ends, self._tasks, strict=False)
        ):
            row: dict[str, Any] = {"episode_index": number, "tasks": [task], "length": end - begin}
            row |= {f"{file}/{kind}_index": 0 for file in files for kind in ("chunk", "file")}
            row |= {"dataset_from_index": begin, "dataset_to_index": end}
            if self._video:
                times = {"from_timestamp": begin / FPS, "to_timestamp": end / FPS}
                row |= {f"videos/{IMAGES}/{name}": time for name, time in times.items()}
            rows.append(row)
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
            names = ["height", "width", "channels"]
            features[IMAGES] = {"dtype": "video", "shape": list(self._image_shape), "names": names}
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
