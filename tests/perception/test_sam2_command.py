"""`pixel2catch track` with SAM 2 of random weights on the painted throw."""

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from filmed import HELD, PATH, box_at, save_camera, save_video, throw
from tiny_sam2 import save_tiny_sam2

from pixel2catch.cli.main import main
from pixel2catch.cli.track import SUMMARY, TABLE
from pixel2catch.scene.constants import CONTROL_DT


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """With a video, its camera, and a checkpoint that takes the whole image for the object."""
    folder = tmp_path_factory.mktemp("filmed")
    save_video(folder / "throw.mp4", throw())
    save_camera(folder / "camera.json")
    save_tiny_sam2(folder, finds_all=True)
    return folder


def track(folder: Path, out: Path, segmenter: str, *options: str) -> list[dict[str, str]]:
    """Track from the prompted image on."""
    args = ["track", str(folder / "throw.mp4"), "--camera", str(folder / "camera.json"), "--out", str(out)]
    args += ["--segmenter", segmenter, "--checkpoint", str(folder)]
    args += ["--at", f"{HELD * CONTROL_DT:.3f}", "--box", *box_at(HELD), *options]
    assert main(args) == 0
    assert json.loads((out / SUMMARY).read_text())["segmenter"] == segmenter
    with open(out / TABLE, newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))[HELD:]


def test_a_mask_of_the_whole_image_is_no_object(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    rows = track(folder, tmp_path / "out", "sam2")
    assert {row["verdict"] for row in rows} == {"too large"}
    assert "ms for an image of 64 px on cpu: " in capsys.readouterr().err


def test_background_subtraction_follows_where_sam2_goes_wrong(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    rows = track(folder, tmp_path / "out", "sam2+background")
    assert {row["verdict"] for row in rows} == {"seen"}
    edges = [[float(row[name]) for name in ("xmin", "ymin", "xmax", "ymax")] for row in rows]
    boxes = np.array(edges)
    assert np.abs(0.5 * (boxes[:, :2] + boxes[:, 2:]) - PATH[HELD:]).max() < 3.0
    assert {float(row["score"]) for row in rows} == {0.0}
    assert {(row["source"], row["doubt"]) for row in rows} == {("background", "sam2 implausible")}
    used = f"background (sam2 implausible) {len(rows)}"
    assert f"Used: {used}." in " ".join(capsys.readouterr().out.split())
