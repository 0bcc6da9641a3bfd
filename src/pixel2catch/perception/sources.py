"""Where images come from: a video, a bag of ROS 2 or a camera, all as ticks of the control clock."""

from collections.abc import Generator, Iterator
from dataclasses import dataclass
from pathlib import Path

import av
from av.error import FFmpegError

from pixel2catch.errors import PerceptionError
from pixel2catch.perception.cameras import is_camera, live_ticks, open_camera
from pixel2catch.perception.finder import CameraFrame
from pixel2catch.perception.ticks import Tick, on_control_clock

BAG_SUFFIXES = (".mcap", ".db3")


@dataclass(frozen=True, kw_only=True)
class SourceCfg:
    """Where to find images.

    Attributes:
        name: A video file; the folder, .mcap or .db3 file of a bag; or the number or device of a camera.
        topic: The topic of a bag's images; None for the only one.
        joint_states: The topic of a bag's joint states.
    """

    name: str
    topic: str | None = None
    joint_states: str = "/joint_states"


def ticks_of(cfg: SourceCfg, notes: list[str]) -> Generator[Tick, None, None]:
    """Yield what a controller would get in every control step.

    Args:
        cfg: Where to find images.
        notes: Gets what is wrong with the source, and yet no reason to stop.

    Raises:
        PerceptionError: If there is no such source, or no image in it; the message says what to do.
    """
    if is_camera(cfg.name):
        return live_ticks(open_camera(cfg.name), notes)
    return on_control_clock(_recorded(cfg, notes), notes)


def _recorded(cfg: SourceCfg, notes: list[str]) -> Iterator[CameraFrame]:
    """The images of a file or folder."""
    path = Path(cfg.name)
    if not path.exists():
        raise PerceptionError(
            f"there is no '{path}'; a source is a video file, a rosbag2, or a camera: its number or "
            "/dev/videoN."
        )
    if path.suffix in BAG_SUFFIXES or path.is_dir():
        return _bag_frames(path, cfg, notes)
    return video_frames(path, notes)


def _bag_frames(path: Path, cfg: SourceCfg, notes: list[str]) -> Iterator[CameraFrame]:
    """The images of a bag; only here its library is needed."""
    try:
        from pixel2catch.perception.rosbag_images import bag_frames
    except ModuleNotFoundError as error:
        raise PerceptionError(
            f"{path}: reading bags needs {error.name}: pip install 'pixel2catch[perception]'."
        ) from None
    return bag_frames(path, cfg.topic, cfg.joint_states, notes)


def video_frames(path: Path, notes: list[str]) -> Iterator[CameraFrame]:
    """Yield the images of a video file with their own stamps; a damaged file ends where the damage begins.

    Args:
        path: The file.
        notes: Gets where a damaged file ended, and why.

    Raises:
        PerceptionError: If this is no video, or none of its images can be read.
    """
    num_frames, stamp = 0, 0.0
    try:
        with av.open(str(path)) as container:
            if not container.streams.video:
                raise PerceptionError(f"{path} has no video stream; give a video file.")
            period = 1.0 / float(container.streams.video[0].average_rate or 30)
            for frame in container.decode(video=0):
                stamp = float(frame.time) if frame.time is not None else stamp + period
                yield CameraFrame(image=frame.to_ndarray(format="rgb24"), stamp=stamp)
                num_frames += 1
    except FFmpegError as error:
        if not num_frames:
            raise PerceptionError(f"{path} cannot be read as a video: {error.strerror}.") from error
        notes.append(f"the video is damaged after {num_frames} images: {error.strerror}.")
