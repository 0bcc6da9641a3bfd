"""The benchmarks of trackers: painted truth against pixels, and a whole run."""

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import perception_on_clips
import pytest
from composites import HEIGHT, WIDTH, Flight, Thing, film, paint, true_box
from filmed import save_labels, save_video

from pixel2catch.camera.image import Image
from pixel2catch.perception.labels import Label, Labels

ROOM = np.full((HEIGHT, WIDTH, 3), 120, np.uint8)
BALL = Thing(colors=((220, 60, 40),))
BOX = Thing(colors=((220, 60, 40), (40, 60, 220)), is_box=True)
FLIGHT = Flight(start=(150.0, 200.0), velocity=(11.0, -7.0), sizes=(9.0, 16.0), num_held=3, num_flying=8)


def changed_box(image: np.ndarray) -> np.ndarray:
    rows, columns = np.nonzero(np.abs(image.astype(int) - ROOM).max(axis=-1) > 40)
    return np.array([columns.min(), rows.min(), columns.max() + 1, rows.max() + 1])


@pytest.mark.parametrize("thing", [BALL, BOX])
@pytest.mark.parametrize("time", [-1.0, 4.0])
def test_the_true_box_is_that_of_the_painted_pixels(thing: Thing, time: float):
    """Blur adds a few pixels along the motion, half of them at each end."""
    speed = 0.0 if time < 0.0 else 12.0
    truth = true_box(thing, FLIGHT, time)
    assert truth is not None
    assert np.abs(changed_box(paint(ROOM, thing, FLIGHT, time)) - truth).max() < 1.5 + 0.125 * speed


def test_clips_in_a_folder_are_compared(tmp_path: Path, capsys, monkeypatch):
    shown = film([ROOM], BALL, FLIGHT, 20)
    save_video(tmp_path / "throw.mp4", shown.images)
    known = [(i, truth) for i, truth in enumerate(shown.truths) if truth]
    images = tuple(Label(image=i, time=i / 30.0, phase=each.phase, box=each.box) for i, each in known)
    size = {"width": WIDTH, "height": HEIGHT, "rate": 30.0}
    labels = Labels(video="throw.mp4", object="red ball", images=images, **size)
    save_labels(tmp_path / "throw.json", labels)
    (tmp_path / "bounces.toml").write_text(f"throw = {known[-2][0]}")
    out = tmp_path / "clips.out"
    arguments: list[Any] = ["", str(tmp_path), "--methods", "nearest blob,differences", "--out", str(out)]
    monkeypatch.setattr(sys, "argv", arguments)
    perception_on_clips.main()
    assert "throw (red ball)" in capsys.readouterr().out
    report = json.loads(out.read_text())
    assert set(report["all"]) == {"nearest blob", "differences"}
    assert report["throw (red ball)"]["nearest blob"]["flight"]["images"] == 7
    kinds = {
        kind: report[kind]["differences"]["flight"]["images"] for kind in ("free flight", "after a bounce")
    }
    assert kinds == {"free flight": 5, "after a bounce": 2}
    assert report["every second image, 12 to 15 Hz"]["differences"]["flight"]["images"] == 4
    assert "| all |" in out.with_suffix(".md").read_text()


def test_strong_compression_keeps_number_size_and_stamps_of_images():
    images = [Image(pixels=np.full((48, 64, 3), 40 * i, np.uint8), stamp=0.1 * i) for i in range(5)]
    decoded = perception_on_clips.compressed(images)
    assert [image.stamp for image in decoded] == [image.stamp for image in images]
    assert all(
        np.abs(a.pixels.astype(int) - b.pixels).max() < 20 for a, b in zip(decoded, images, strict=True)
    )
