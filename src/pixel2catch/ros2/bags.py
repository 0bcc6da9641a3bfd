"""Recordings of ROS 2 (rosbag2: MCAP or SQLite), read message by message. Needs rosbags."""

import heapq
import shutil
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from copy import copy
from dataclasses import dataclass
from functools import partial
from itertools import accumulate
from operator import itemgetter
from pathlib import Path
from tempfile import TemporaryDirectory
from types import ModuleType, SimpleNamespace
from typing import TYPE_CHECKING, Any

from pixel2catch.errors import InvalidValueError, PerceptionError, Pixel2CatchError
from pixel2catch.files import LONGEST_REASON, MOST_YAML, parse_yaml, read_text, reading
from pixel2catch.installation import install_command

if TYPE_CHECKING:
    from rosbags.interfaces import Connection
    from rosbags.rosbag2 import Reader
    from rosbags.rosbag2.storage_mcap import ChunkInfo

BAG_SUFFIXES, PACKED_SUFFIXES, METADATA = (".mcap", ".db3"), (".zstd", ".zst"), "metadata.yaml"
OTHER_PROFILES = ("", "ros1")  #: Profiles of MCAP files, beside ros2. Source: MCAP registry.

MOST_CHUNK = 2**26  #: Largest unpacked chunk of an MCAP file [bytes]. Source: ours.
MOST_AT_ONCE = 2**28  #: Largest sum of chunks whose times overlap: all are unpacked together. Source: ours.
MOST_UNPACKED = 2**35  #: Largest file that is unpacked to a temporary folder [bytes]. Source: ours.


def is_bag(path: Path) -> bool:
    """Return whether a path is a rosbag2: its folder, or its .mcap or .db3 file, perhaps compressed."""
    file = path.with_suffix("") if path.suffix in PACKED_SUFFIXES else path
    return file.suffix in BAG_SUFFIXES or (path / METADATA).exists()


@contextmanager
def opened_bag(
    path: Path, error: type[Pixel2CatchError] = PerceptionError, extra: str = "perception"
) -> "Iterator[Reader]":
    """Open a bag (`is_bag`). Channels of other encodings beside those of ROS 2 (JSON, Protobuf) are left out.

    Raises `error`, also where rosbags (`extra`) is missing.
    """
    try:
        from rosbags.rosbag2 import Reader, reader, storage_mcap
    except ModuleNotFoundError as missing:
        raise error(f"{path}: reading bags needs {missing.name}; {install_command(extra)}.") from None
    no_definition = storage_mcap.get_msgdef(None)  # types are those of `messages.STORE`
    unpack = partial(_unpacked_zstd, size=MOST_CHUNK)  # `decode` refuses a message that is longer
    read_bytes = storage_mcap.read_bytes
    in_mcap = {
        "DECOMPRESSORS": {**storage_mcap.DECOMPRESSORS, "lz4": _unpacked_lz4, "zstd": _unpacked_zstd},
        "get_msgdef": lambda schema: no_definition,
        "read_string": lambda file: _text(file.tell() == 0, read_bytes(file)),
    }
    in_reader = {"zstd": SimpleNamespace(open=vars(reader)["zstd"].open, decompress=unpack)}
    try:
        _require_files(path)
        is_part = path.is_file() and (path.parent / METADATA).is_file()
        whole = _description(path.parent) if is_part else {}
        if len(files := whole.get("relative_file_paths", ())) > 1 and path.name in files:
            warnings.warn(f"{path} alone is read, one of the {len(files)} files of a bag", stacklevel=3)
        if whole.get("compression_mode", "").lower() == "message":
            raise InvalidValueError(f"its messages are compressed, as {METADATA} says; give its folder")
        with _replaced(storage_mcap, in_mcap), _replaced(reader, in_reader), _opened(Reader, path) as bag:
            for storage in getattr(bag.storage, "storages", [bag.storage]):
                _require_chunks(getattr(storage, "chunks", ()))
            others = sorted({str(each.ext[0]) for each in bag.connections} - {"cdr"})
            bag.connections[:] = [each for each in bag.connections if "cdr" in each.ext]
            if others and not bag.connections:
                problem = (
                    f"its channels have the encoding {', '.join(others)}, but only cdr, of ROS 2, is read"
                )
                raise InvalidValueError(f"{problem}; convert it, from ROS 1 with 'rosbags-convert'")
            yield bag
    except Pixel2CatchError as known:
        reason = str(known).removesuffix(".")
        raise known if isinstance(known, error) else error(f"{path}: {reason}.") from known
    except Exception as damage:
        reason = str(damage)[:LONGEST_REASON]
        fix = "try 'mcap recover' for a file that was cut off, 'ros2 bag reindex' for a folder, or one file"
        raise error(f"{path}: not a readable rosbag2 ({reason}); {fix}.") from damage


@contextmanager
def _opened(reader: "type[Reader]", path: Path) -> "Iterator[Reader]":
    """Open a bag, after a file that is compressed as a whole is unpacked to a temporary folder."""
    with TemporaryDirectory() as folder:
        file = path
        if path.suffix in PACKED_SUFFIXES:
            from rosbags.rosbag2.storage_mcap import zstd

            file = Path(folder, path.stem)
            with zstd.open(path) as packed, file.open("wb") as unpacked:
                shutil.copyfileobj(packed, unpacked)
        with reader(file) as bag:
            yield bag


def _text(is_first: bool, content: bytes) -> str:
    """Return a text of an MCAP file; a schema of Protobuf is none. Any profile, the first, counts."""
    text = content.decode(errors="replace")
    return "ros2" if is_first and text in OTHER_PROFILES else text


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
    files, compression = [path], "file" if path.suffix in PACKED_SUFFIXES else ""
    if path.is_dir():
        content = _description(path)
        for topic in content["topics_with_message_count"]:
            if isinstance(qos := topic["topic_metadata"].get("offered_qos_profiles"), str):
                parse_yaml(qos)
        compression = content.get("compression_mode", "").lower()
        files = [path / Path(name).name for name in content["relative_file_paths"]]
    for file in files:
        if file.exists() and not file.is_file():
            raise InvalidValueError(f"'{file}' is no file")
        if compression == "file" and _unpacked_size(file) > MOST_UNPACKED:
            raise InvalidValueError(f"'{file}' unpacks to more than {MOST_UNPACKED:,} bytes; split it")


def _description(folder: Path) -> dict[str, Any]:
    with reading("description", folder / METADATA, "Write it anew by 'ros2 bag reindex'."):
        return parse_yaml(read_text(folder / METADATA, MOST_YAML))["rosbag2_bagfile_information"]


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
        raise InvalidValueError(f"its chunks may have {MOST_CHUNK:,} bytes each, {MOST_AT_ONCE:,} together")


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
