"""`pixel2catch track` with SAM 2 of random weights on the painted throw."""

import csv
import json
from pathlib import Path

import pytest
from filmed import HELD, box_at, save_camera, save_video, throw
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


def test_a_mask_of_the_whole_image_is_no_object(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    out = tmp_path / "out"
    args = ["track", str(folder / "throw.mp4"), "--camera", str(folder / "camera.json"), "--out", str(out)]
    args += ["--segmenter", "sam2", "--checkpoint", str(folder)]
    assert main([*args, "--at", f"{HELD * CONTROL_DT:.3f}", "--box", *box_at(HELD)]) == 0
    assert json.loads((out / SUMMARY).read_text())["segmenter"] == "sam2"
    with open(out / TABLE, newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))[HELD:]
    assert {row["verdict"] for row in rows} == {"too large"}
    assert "ms for an image of 64 px on cpu: " in capsys.readouterr().err
