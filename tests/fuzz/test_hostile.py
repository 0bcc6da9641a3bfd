"""Harmful files: each is refused before it costs time or memory."""

import io
import json
import os
import re
import struct
import tracemalloc
import zipfile
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path

import cv2
import mujoco
import numpy as np
import pytest
from jaxtyping import config
from rosbags.rosbag2 import CompressionMode
from valid import ARM, KINDS, PIXELS, checkpoint, untrained

from pixel2catch.arrays import read_arrays
from pixel2catch.cli.main import main
from pixel2catch.errors import InvalidValueError, PerceptionError, Pixel2CatchError
from pixel2catch.evaluation.loading import load_policy
from pixel2catch.files import MOST_JSON, read_bytes, read_json_object
from pixel2catch.identification.recording import ARRAYS, Recording, Trajectory
from pixel2catch.learning.checkpoint import Checkpoint
from pixel2catch.learning.experiment import require_run
from pixel2catch.perception.calibration.lens import read_image
from pixel2catch.policy.contract import method_of
from pixel2catch.policy.onnx_policy import to_onnx
from pixel2catch.robots.workcell import read_mjcf
from pixel2catch.ros2 import bags, messages
from pixel2catch.ros2.profile import Profile
from ros_bags import TYPES, save_bag

COMMANDS = {
    "evaluate --dynamics {}": ".json",
    "evaluate {}": ".onnx",
    "deploy --dry-run --profile {}": ".yaml",
    "identify {} --robot ur5e --out {out}": ".npz",
    "identify {}  --robot ur5e --out {out}": ".mcap",
    "track {} --out {out}": ".mp4",
    "calibrate views.csv --intrinsics {} --out {out}": ".yaml",
    "calibrate {} --intrinsics lens.yaml --out {out}": ".csv",
    "record {} --out {out}": ".npz",
    "train --resume --out {}": "",
    "--import {} evaluate": ".py",
}
"""Commands that read a file, and how its name ends."""
PLACES: dict[str, Callable[[Path], object]] = {
    "words": lambda file: file.write_text("hello\nworld"),
    "folder": lambda file: file.mkdir(),
    "pipe": os.mkfifo,
    "loop": lambda file: file.symlink_to(file),
    "endless": lambda file: file.symlink_to("/dev/zero"),
}
"""Contents in the place of a file."""


@pytest.mark.parametrize("line", COMMANDS)
def test_what_is_not_a_file_of_the_kind_is_refused(line: str, tmp_path: Path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "views.csv").write_text("image\n1.png\n")
    for number, (what, make) in enumerate(PLACES.items()):
        file = tmp_path / f"file_{number}{COMMANDS[line]}"
        make(file)
        monkeypatch.setenv("PIXEL2CATCH_IMPORT", "")
        try:
            status = main([word.format(file, out=tmp_path / "out") for word in line.split()])
        except SystemExit as error:
            status = error.code
        assert status == 2, what
        assert "error" in capsys.readouterr().err.lower()
    assert not (tmp_path / "out").exists()


def naming(folder: Path, workcell: str) -> Iterator[tuple[Path, Callable[[Path], object]]]:
    """Write each kind of file that names a work cell, with this name; yield it and what reads it."""
    policy, text, profile = untrained(workcell), json.dumps(workcell), KINDS["profile"].write(folder)
    policy.save(folder / "policy")
    yield folder / "policy", load_policy
    (folder / "policy.onnx").write_bytes(to_onnx(policy))
    yield folder / "policy.onnx", load_policy
    yield checkpoint(folder, workcell), lambda file: method_of(Checkpoint.load(file, "cpu").contract)
    profile.write_text(re.sub("(?m)^workcell:.*", f"workcell: {text}", profile.read_text()))
    yield profile, Profile.load
    content = json.loads(KINDS["run"].write(folder).read_text())
    content["env"]["scene"]["workcell"] = workcell
    (folder / "config.json").write_text(json.dumps(content))
    yield folder, require_run
    header = np.array(json.dumps({"format_version": 1, "workcell": workcell}))
    np.savez(folder / "path.npz", header=header, joints=np.array(ARM), times=0.0, positions=0.0)
    yield folder / "path.npz", Trajectory.load


def test_a_file_does_not_choose_what_python_runs(tmp_path: Path):
    """Its work cell is a name; a path of a Python file is none, even if the file is there."""
    (tmp_path / "own.py").write_text("raise SystemExit('it ran')")
    for file, read in naming(tmp_path, str(tmp_path / "own.py")):
        with pytest.raises(Pixel2CatchError, match=r"work cell .*--import FILE\.py"):
            read(file)


def test_an_archive_is_not_unpacked_if_it_is_too_large(tmp_path: Path):
    with zipfile.ZipFile(tmp_path / "bomb.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("q.npy", bytes(200 * 2**20))
    assert (tmp_path / "bomb.npz").stat().st_size < 2**20
    tracemalloc.start()
    try:
        with pytest.raises(InvalidValueError):
            read_arrays(tmp_path / "bomb.npz", ["q"])
        assert tracemalloc.get_traced_memory()[1] < 2**22
    finally:
        tracemalloc.stop()


def npy(shape: str = "(3, 6)", kind: str = "<f8", data: bytes = bytes(144)) -> bytes:
    """An .npy file that says something of its data."""
    header = f"{{'descr': '{kind}', 'fortran_order': False, 'shape': {shape}}}\n".encode()
    return b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header + data


SHAPES = ("(1000000000000000,)", "(-1,)", "(3, 6", "(2147483648, 2147483648)")
DTYPES = ("|O", "<c16", "<U4000000", "<M8[s]", "|V8", "f8,i4")
TEXTS = (npy("(1,)", "<U1", b"\0\xd8\0\0"), npy("(70_000,)", "<U1", bytes(280_000)))  # no character; too long
ARCHIVED = (*map(npy, SHAPES), *(npy(kind=kind) for kind in DTYPES), *TEXTS, npy()[:-1], b"")


@pytest.mark.parametrize("content", ARCHIVED, ids=range(len(ARCHIVED)))
def test_an_array_without_numbers_or_short_texts_is_refused(content: bytes, tmp_path: Path):
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        archive.writestr("q.npy", content)
    with pytest.raises(InvalidValueError):
        read_arrays(tmp_path / "a.npz", ["q"])


def test_an_archive_that_numpy_did_not_pack_is_refused(tmp_path: Path):
    with zipfile.ZipFile(tmp_path / "a.npz", "w", zipfile.ZIP_BZIP2) as archive:
        archive.writestr("q.npy", npy())
    with pytest.raises(InvalidValueError, match="packed in another way"):
        read_arrays(tmp_path / "a.npz", ["q"])


def test_a_recording_with_another_array_in_the_place_of_any_is_refused(tmp_path: Path):
    config.update("jaxtyping_disable", True)  # as for users
    file = KINDS["recording"].write(tmp_path)
    valid, texts = read_arrays(file, ARRAYS), map(np.array, ("{", "\ud800", 70_000 * "x"))
    for other in (
        *texts,
        *(np.zeros(shape, kind) for shape in ((), 0, (5, 5)) for kind in ("f8", "i1", "?")),
    ):
        for name in valid:
            np.savez(file, allow_pickle=False, **(valid | {name: other}))
            with pytest.raises(Pixel2CatchError):
                Recording.load(file)


def test_an_image_is_not_unpacked_if_it_is_too_large(tmp_path: Path):
    """Its header says 20,000 x 20,000."""
    data = bytearray(cv2.imencode(".png", PIXELS)[1].tobytes())
    data[16:24] = struct.pack(">II", 20_000, 20_000)
    (tmp_path / "bomb.png").write_bytes(data)
    with pytest.raises(PerceptionError):
        read_image(tmp_path / "bomb.png")
    message = messages.encode(
        messages.COMPRESSED_IMAGE, messages.header(0.0), "png", np.frombuffer(data, np.uint8)
    )
    assert messages.unpacked_image(messages.decode(message, messages.COMPRESSED_IMAGE).data.tobytes()) is None


@pytest.mark.parametrize(
    "text", ["ffconcat version 1.0\nfile a.mp4\n", "#EXTM3U\n#EXTINF:1,\na.mp4\n#EXT-X-ENDLIST\n"]
)
def test_a_video_names_no_other_file(text: str, tmp_path: Path):
    KINDS["mp4"].write(tmp_path).rename(tmp_path / "a.mp4")
    (tmp_path / "list.mp4").write_text(text)
    with pytest.raises(PerceptionError):
        KINDS["mp4"].read(tmp_path / "list.mp4")


def packed_bag(path: Path, size: int, mode: CompressionMode = CompressionMode.STORAGE) -> Path:
    """Write a bag with one message of zeros, compressed."""
    save_bag(path, [("/text", 0, TYPES[messages.TEXT]("\0" * size))], mode=mode)
    return next(path.glob("bag.mcap*"))


def test_large_chunks_of_a_bag_are_not_unpacked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    file = packed_bag(tmp_path / "bag", 2**21)
    for limit in ("MOST_CHUNK", "MOST_AT_ONCE"):
        with monkeypatch.context() as patch:
            patch.setattr(bags, limit, 2**20)
            with pytest.raises(PerceptionError, match=r"too large|together"), bags.opened_bag(file):
                pass
    monkeypatch.setattr(bags, "_require_chunks", lambda chunks: None)
    monkeypatch.setattr(bags, "MOST_CHUNK", 2**20)
    with pytest.raises(PerceptionError, match="Chunk size mismatch"), bags.opened_bag(file) as reader:
        list(reader.messages())


def test_a_large_bag_is_not_unpacked_to_the_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    packed_bag(tmp_path / "bag", 2**20, CompressionMode.FILE)
    monkeypatch.setattr(bags, "MOST_UNPACKED", 2**19)
    with pytest.raises(PerceptionError, match="unpacks to more than"), bags.opened_bag(tmp_path / "bag"):
        pass


def test_a_large_message_of_a_bag_is_not_unpacked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    packed_bag(tmp_path / "bag", 2**21, CompressionMode.MESSAGE)
    monkeypatch.setattr(bags, "MOST_CHUNK", 2**20)
    with bags.opened_bag(tmp_path / "bag") as reader:
        assert [len(data) for *_, data in reader.messages()] == [2**20 + 1]


def test_an_alias_bomb_is_refused(tmp_path: Path):
    names = "abcdefghij"
    bomb = "a: &a [x]\n" + "".join(f"{b}: &{b} [*{a}, *{a}, *{a}]\n" for a, b in pairwise(names))
    (tmp_path / "lab.yaml").write_text(bomb)
    with pytest.raises(Pixel2CatchError):
        Profile.load(tmp_path / "lab.yaml")


def test_networks_of_a_billion_neurons_take_no_memory(tmp_path: Path):
    file = KINDS["policy"].write(tmp_path)
    for hidden in ([10**9], [8192] * 16):
        file.write_text(json.dumps(json.loads(file.read_text()) | {"hidden": hidden}))
        with pytest.raises(Pixel2CatchError):
            KINDS["policy"].read(file)


def test_a_mesh_of_many_points_takes_little_memory(tmp_path: Path):
    """All points against all would be 3 GB."""
    from pixel2catch.scene import meshes

    rng = np.random.default_rng(0)
    points, faces = rng.random((20_000, 3)), rng.integers(1, 20_001, (10_000, 3))
    text = io.StringIO()
    np.savetxt(text, points, "v %.6f %.6f %.6f")
    np.savetxt(text, faces, "f %d %d %d")
    (tmp_path / "dust.obj").write_text(text.getvalue())
    tracemalloc.start()
    try:
        meshes._read(tmp_path / "dust.obj")
        assert tracemalloc.get_traced_memory()[1] < 200 * 2**20
    finally:
        tracemalloc.stop()


def test_a_file_may_be_as_long_as_its_bound(tmp_path: Path):
    file = tmp_path / "a.json"
    file.write_text('{"a": 1}'.ljust(MOST_JSON))
    assert read_json_object(file) == {"a": 1}
    file.write_text('{"a": 1}'.ljust(MOST_JSON + 1))
    with pytest.raises(InvalidValueError):
        read_json_object(file)
    with pytest.raises(InvalidValueError):
        read_bytes(Path("/dev/zero"), 10)


@pytest.mark.parametrize(
    "content",
    [
        "<mujoco>" + 20_001 * "<a/>" + "</mujoco>",
        '<mujoco><worldbody><replicate count="9999999"/></worldbody></mujoco>',
        '<mujoco><include file="/dev/zero"/></mujoco>',
        '<!DOCTYPE a [<!ENTITY b "c">]><mujoco>&b;</mujoco>',
        '<mujoco><worldbody><geom class="c%p-%p" size="1"/></worldbody></mujoco>',
        '<mujoco><worldbody><geom name="%n" size="1"/></worldbody></mujoco>',
    ],
)
def test_a_harmful_model_is_refused_before_mujoco_reads_it(content: str, tmp_path: Path, monkeypatch):
    monkeypatch.setattr(mujoco.MjSpec, "from_file", None)
    file = tmp_path / "robot.xml"
    file.write_text(content)
    with pytest.raises(InvalidValueError):
        read_mjcf(file)
