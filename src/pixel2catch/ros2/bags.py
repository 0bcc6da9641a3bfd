"""Recordings of ROS 2 (rosbag2: MCAP or SQLite), read message by message. Needs rosbags."""

import heapq
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from copy import copy
from dataclasses import dataclass
from functools import partial
from itertools import accumulate
from operator import itemgetter
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np

from pixel2catch.errors import InvalidValueError, PerceptionError, Pixel2CatchError, RecordingError
from pixel2catch.files import LONGEST_REASON, MOST_YAML, parse_yaml, read_text
from pixel2catch.installation import install_command

if TYPE_CHECKING:
    from rosbags.interfaces import Connection
    from rosbags.rosbag2 import Reader
    from rosbags.rosbag2.storage_mcap import ChunkInfo

BAG_SUFFIXES, METADATA = (".mcap", ".db3"), "metadata.yaml"

MOST_CHUNK = 2**26  #: Largest unpacked chunk of an MCAP file [bytes]. Source: ours.
MOST_AT_ONCE = 2**28  #: Largest sum of chunks whose times overlap: all are unpacked together. Source: ours.
MOST_UNPACKED = 2**35  #: Largest file that is unpacked to a temporary folder [bytes]. Source: ours.


def is_bag(path: Path) -> bool:
    """Return whether a path is a rosbag2: its folder, or its .mcap or .db3 file."""
    return path.suffix in BAG_SUFFIXES or (path / METADATA).exists()


@contextmanager
def opened_bag(
    path: Path, error: type[Pixel2CatchError] = PerceptionError, extra: str = "perception"
) -> "Iterator[Reader]":
    """Open a bag: its folder, .mcap or .db3 file. Channels that are not CDR (JSON, Protobuf) are left out.

    Raises `error`, also where rosbags (`extra`) is missing.
    """
    try:
        from rosbags.rosbag2 import Reader, reader, storage_mcap
    except ModuleNotFoundError as missing:
        raise error(f"{path}: reading bags needs {missing.name}; {install_command(extra)}.") from None
    no_definition = storage_mcap.get_msgdef(None)  # types are those of `messages.STORE`
    read_bytes = storage_mcap.read_bytes  # a schema of Protobuf is no text
    unpack = partial(_unpacked_zstd, size=MOST_CHUNK)  # `decode` refuses a message that is longer
    in_mcap = {
        "DECOMPRESSORS": {**storage_mcap.DECOMPRESSORS, "lz4": _unpacked_lz4, "zstd": _unpacked_zstd},
        "get_msgdef": lambda schema: no_definition,
        "read_string": lambda file: read_bytes(file).decode(errors="replace"),
    }
    in_reader = {"zstd": SimpleNamespace(open=vars(reader)["zstd"].open, decompress=unpack)}
    try:
        _require_files(path)
        with _replaced(storage_mcap, in_mcap), _replaced(reader, in_reader), Reader(path) as bag:
            for storage in getattr(bag.storage, "storages", [bag.storage]):
                _require_chunks(getattr(storage, "chunks", ()))
            bag.connections[:] = [each for each in bag.connections if "cdr" in each.ext]
            yield bag
    except Pixel2CatchError as known:
        raise known if isinstance(known, error) else error(f"{path}: {known}.") from known
    except Exception as damage:
        reason = str(damage)[:LONGEST_REASON]
        fix = "try 'mcap recover' for a file that was cut off, 'ros2 bag reindex' for a folder"
        raise error(f"{path}: not a readable rosbag2 ({reason}); {fix}.") from damage


@contextmanager
def _replaced(module: ModuleType, values: dict[str, Any]) -> Iterator[None]:
    """Give names of a module other values, while a bag is open; rosbags has no other way to limit sizes."""
    before = {name: vars(module)[name] for name in values}
    vars(module).update(values)
    try:
        yield
    finally:
        vars(module).update(before)


def _require_files(path: Path) -> None:
    """Refuse files whose opening may block, that become too large unpacked, and complex descriptions."""
    files, is_packed = [path], False
    if path.is_dir():
        content = parse_yaml(read_text(path / METADATA, MOST_YAML))["rosbag2_bagfile_information"]
        for topic in content["topics_with_message_count"]:
            if isinstance(qos := topic["topic_metadata"].get("offered_qos_profiles"), str):
                parse_yaml(qos)
        is_packed = content.get("compression_mode", "").lower() == "file"
        files = [path / Path(name).name for name in content["relative_file_paths"]]
    for file in files:
        if file.exists() and not file.is_file():
            raise InvalidValueError(f"'{file}' is no file")
        if is_packed and _unpacked_size(file) > MOST_UNPACKED:
            raise InvalidValueError(f"'{file}' unpacks to more than {MOST_UNPACKED:,} bytes; split it")


def _unpacked_size(file: Path) -> int:
    from rosbags.rosbag2.storage_mcap import zstd

    with zstd.open(file) as content:
        while content.tell() <= MOST_UNPACKED and content.read(2**24):
            pass
        return content.tell()


def _require_chunks(chunks: "Sequence[ChunkInfo]") -> None:
    sizes = [(each.message_start_time, 0, each.uncompressed_size) for each in chunks]
    sizes += [(each.message_end_time, 1, -each.uncompressed_size) for each in chunks]
    most = max(accumulate(size for *_, size in sorted(sizes)), default=0)
    if most > MOST_AT_ONCE or any(each.uncompressed_size > MOST_CHUNK for each in chunks):
        raise InvalidValueError(
            f"its chunks are too large; at most {MOST_CHUNK:,} bytes each are read, {MOST_AT_ONCE:,} together"
        )


def _unpacked_lz4(data: bytes, size: int) -> bytes:
    from lz4.frame import LZ4FrameDecompressor

    return LZ4FrameDecompressor().decompress(data, min(size, MOST_CHUNK) + 1)


def _unpacked_zstd(data: bytes, size: int) -> bytes:
    from rosbags.rosbag2.storage_mcap import zstd

    return zstd.ZstdDecompressor().decompress(data, min(size, MOST_CHUNK) + 1)


@dataclass(frozen=True, kw_only=True)
class BagMessage:
    """A message of a bag."""

    topic: str
    type: str  #: ROS type.
    received: int  #: Time of recording [ns].
    stamp: int  #: Time in its header [ns]; 0 without a header.
    content: Any  #: Result of `messages.decode`.


def decoded(reader: "Reader", connections: "list[Connection]") -> Iterator[BagMessage]:
    """Yield the messages of some connections, by their times of recording; files of a bag may overlap."""
    from pixel2catch.ros2.messages import decode

    streams = [reader.messages(connections)]
    if storages := getattr(reader.storage, "storages", ()):
        files = [copy(reader.storage) for _ in storages]
        for file, storage in zip(files, storages, strict=True):
            vars(file)["storages"] = [storage]
        streams = [file.messages(connections) for file in files]
    for connection, received, data in heapq.merge(*streams, key=itemgetter(1)):
        content = decode(data, connection.msgtype)
        sent = getattr(content, "header", None)
        yield BagMessage(
            topic=connection.topic,
            type=connection.msgtype,
            received=received,
            stamp=sent.stamp.sec * 10**9 + sent.stamp.nanosec if sent else 0,
            content=content,
        )


STATE, TRAJECTORY = "sensor_msgs/msg/JointState", "trajectory_msgs/msg/JointTrajectory"
MOTION_TYPES = (STATE, TRAJECTORY, "std_msgs/msg/Float64MultiArray")  #: Messages with joint positions.


@dataclass(frozen=True, kw_only=True)
class JointMotion:
    """The content of a message of one of `MOTION_TYPES`."""

    joints: tuple[str, ...]  #: Names in the order of the numbers; empty if the type has none.
    positions: np.ndarray  #: One number for each joint [rad].


def joint_motion(where: str, message: BagMessage) -> JointMotion:
    """Read a joint state, a trajectory of one target, or numbers without names; `where` begins an error."""
    content, kind = message.content, message.type
    if kind not in MOTION_TYPES:
        raise RecordingError(f"{where}: type {kind} is not read; record {', '.join(MOTION_TYPES)}.")
    if kind == TRAJECTORY and len(content.points) != 1:
        raise RecordingError(
            f"{where}: a trajectory of {len(content.points)} points, which a controller interpolates; "
            "record the targets that are streamed to the joints, one point in each message."
        )
    if kind == STATE and not len(content.position):
        raise RecordingError(f"{where}: a joint state without positions; record one that has them.")
    if kind == STATE:
        joints, positions = content.name, content.position
    elif kind == TRAJECTORY:
        joints, positions = content.joint_names, content.points[0].positions
    else:
        joints, positions = (), content.data
    return JointMotion(joints=tuple(joints), positions=np.asarray(positions, dtype=np.float64))
