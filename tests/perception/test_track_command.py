"""`pixel2catch track` on the painted throw: as a video, as a bag, and on what is none."""

import _thread
import csv
import json
import threading
import time
from itertools import islice
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
from filmed import CAMERA, HEIGHT, HELD, NUM_EMPTY, PATH, WIDTH, box_at, compressed, jpeg, save_video, throw

from domains import PATIENCE
from pixel2catch.camera.camera_file import CameraFile
from pixel2catch.cli.main import main
from pixel2catch.cli.track import SUMMARY, TABLE, VIDEO
from pixel2catch.mdp.observations import PIXEL_FEATURES
from pixel2catch.perception.sightings import COLUMNS, HEADER
from pixel2catch.scene.constants import CONTROL_DT
from ros_bags import save_bag

AT = ["--at", f"{HELD * CONTROL_DT:.3f}"]
RED = ["--segmenter", "color", "--color", "340", "20"]


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the video, the bag and the camera."""
    folder = tmp_path_factory.mktemp("filmed")
    pictures = list(throw())
    save_video(folder / "throw.mp4", pictures)
    save_bag(folder / "bag", [compressed(step, jpeg(picture)) for step, picture in enumerate(pictures)])
    CameraFile(camera=CAMERA).save(folder / "camera.json")
    return folder


def track(files: Path, source: str, out: Path, *args: str) -> tuple[dict[str, Any], list[dict[str, str]]]:
    """Run the command; return its summary and its table."""
    options = ["--camera", str(files / "camera.json"), "--out", str(out), *args]
    assert main(["track", str(files / source), *options]) == 0
    with open(out / TABLE, newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert tuple(rows[0]) == COLUMNS
    return json.loads((out / SUMMARY).read_text()), rows


def numbers(rows: list[dict[str, str]], *names: str) -> np.ndarray:
    return np.array([[float(row[name]) for name in names] for row in rows])


@pytest.mark.parametrize("source", ["throw.mp4", "bag"])
@pytest.mark.parametrize("options", [[*AT, "--box", *box_at(HELD)], RED], ids=["background", "color"])
def test_the_object_is_followed(source: str, options: list[str], files: Path, tmp_path: Path):
    """In the very image that was meant; a row has times, the box, its features, and durations."""
    summary, rows = track(files, source, tmp_path / "new" / "out", *options)
    assert summary["num_steps"] == len(rows) == len(PATH)
    assert not summary["notes"]
    first = HELD if AT[1] in options else NUM_EMPTY
    seen, steps = rows[first:], np.arange(first, len(PATH))[:, None]
    assert {row["verdict"] for row in rows[:first]} == {"no prompt"}
    assert {row["verdict"] for row in seen} == {"seen"}
    np.testing.assert_allclose(numbers(seen, "time"), steps * CONTROL_DT, atol=1e-3)
    np.testing.assert_allclose(np.diff(numbers(seen, "stamp"), axis=0), CONTROL_DT, atol=1e-3)
    box = numbers(seen, "xmin", "ymin", "xmax", "ymax")
    assert np.abs(0.5 * (box[:, :2] + box[:, 2:]) - PATH[first:]).max() < 3.0
    now = np.hstack((0.5 * (box[:, :2] + box[:, 2:]), box[:, 2:] - box[:, :2]))
    features = np.hstack((now / (2 * (WIDTH, HEIGHT)), np.diff(now, axis=0, prepend=now[:1])))
    np.testing.assert_allclose(numbers(seen, *PIXEL_FEATURES), features, rtol=1e-4, atol=1e-5)
    parts = numbers(seen, "segment_ms", "box_ms").sum(axis=1, keepdims=True)
    assert ((parts > 0.0) & (parts <= numbers(seen, "total_ms"))).all()
    with av.open(str(tmp_path / "new" / "out" / VIDEO)) as video:
        pictures = [frame.to_ndarray(format="rgb24") for frame in video.decode(video=0)]
    assert len(pictures) == len(PATH)
    assert pictures[0].shape == (HEADER + CAMERA.height, CAMERA.width, 3)


def interrupt_once_there(file: Path) -> None:
    """Do what Ctrl-C does, a moment after a file has come into being."""
    end = time.monotonic() + PATIENCE
    while not file.exists() and time.monotonic() < end:
        time.sleep(0.01)
    time.sleep(0.05)
    _thread.interrupt_main()


def test_ctrl_c_leaves_whole_files(files: Path, tmp_path: Path):
    long = save_video(tmp_path / "long.mp4", 20 * list(islice(throw(), 10)))
    out = tmp_path / "out"
    threading.Thread(target=interrupt_once_there, args=(out / TABLE,), daemon=True).start()
    summary, rows = track(files, str(long), out, *RED)
    assert summary["notes"] == ["stopped by Ctrl-C."]
    assert 0 < summary["num_steps"] < 200
    with av.open(str(out / VIDEO)) as video:
        num_pictures = sum(1 for _ in video.decode(video=0))
    assert num_pictures == len(rows) == summary["num_steps"]
