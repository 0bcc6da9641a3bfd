"""Label files, of this package and of other programs (exports/README.md), and `track --truth`."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from filmed import DISC, HELD, PATH, box_at, save_labels, save_video, throw

from pixel2catch.camera.camera_file import CameraFile
from pixel2catch.camera.image import Edges
from pixel2catch.cli.main import main
from pixel2catch.cli.track import SUMMARY
from pixel2catch.errors import InvalidValueError, PerceptionError
from pixel2catch.perception.labels import Label, Labels, load_labels
from pixel2catch.perception.sources import ImageFit, video_images
from pixel2catch.scene.constants import CONTROL_DT, RGB_CAMERA


def label(image: int, box: Edges | None, phase: Any = "flight") -> Label:
    return Label(image=image, time=image / 30.0, phase=phase, box=box)


LABELS = Labels(
    video="throw.mp4",
    width=320,
    height=240,
    rate=30.0,
    object="white ball",
    images=(label(3, (10.0, 20.0, 30.0, 40.0), "held"), label(5, None), label(7, (50.0, 20.0, 74.0, 44.0))),
)
HELD_ONE = {"image": 1, "time": 0.0, "phase": "held", "box": None}


def test_a_label_file_is_read_as_it_was_written_and_needs_no_video(tmp_path: Path):
    for labels in (LABELS, replace(LABELS, images=())):
        save_labels(tmp_path / "labels.json", labels)
        assert load_labels(tmp_path / "labels.json", tmp_path / "none.mp4") == labels


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"format_version": 2}, "format_version is 2"),
        ({"width": "wide"}, "width"),
        ({"images": [HELD_ONE | {"phase": "thrown"}]}, "phase"),
        ({"images": [HELD_ONE | {"box": [1.0, 2.0, 1.0, 4.0]}]}, "image 1"),
        ({"images": [HELD_ONE | {"box": [1.0, 2.0, 321.0, 4.0]}]}, "320 by 240"),
        ({"images": 2 * [HELD_ONE]}, "each once"),
    ],
)
def test_a_bad_label_file_is_refused(changes: dict[str, Any], words: str, tmp_path: Path):
    path = tmp_path / "labels.json"
    save_labels(path, LABELS)
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))
    with pytest.raises(InvalidValueError, match=words):
        Labels.load(path)


def test_an_image_of_another_shape_is_scaled_and_framed():
    fit = ImageFit(own=(1280, 720))
    assert fit.box((0.0, 0.0, 1280.0, 720.0)) == (0.0, 60.0, 640.0, 420.0)
    assert fit.box((640.0, 360.0, 642.0, 364.0)) == (320.0, 240.0, 321.0, 242.0)
    image = np.full((720, 1280, 3), 200, np.uint8)
    made = fit.image(image)
    np.testing.assert_array_equal(made, np.pad(image[:360, :640], ((60, 60), (0, 0), (0, 0))))
    other = np.zeros((100, 100, 3), np.uint8)
    assert fit.image(other) is other  # one that the stream should not have: whoever looks refuses it


def test_a_rotated_video_is_shown_upright(tmp_path: Path):
    """By a quarter turn in the track header, as telephones write it: what was above is at the right."""
    image = np.zeros((64, 128, 3), np.uint8)
    image[:16, :, 0] = 250  # red above
    path = save_video(tmp_path / "turned.mp4", [image] * 3)
    matrices = ((65536, 0, 0, 0, 65536, 0, 0, 0, 1 << 30), (0, 65536, 0, -65536, 0, 0, 0, 0, 1 << 30))
    plain, turned = (np.array(each, ">i4").tobytes() for each in matrices)
    before, header, after = path.read_bytes().partition(b"tkhd")
    path.write_bytes(before + header + after.replace(plain, turned, 1))
    upright = next(video_images(path, []))
    assert upright.pixels.shape == (128, 64, 3)
    assert upright.pixels[:, -10:, 0].mean() > 200
    assert upright.pixels[:, :40, 0].mean() < 30


@pytest.fixture(scope="module")
def wide(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The painted throw on a wider image, with labels by its own numbers."""
    folder = tmp_path_factory.mktemp("wide")
    pictures = (np.pad(each, ((0, 0), (0, 106), (0, 0)), "edge") for each in throw())
    save_video(folder / "throw.mp4", pictures)
    images = []
    for step in range(HELD, len(PATH)):
        (u, v), reach = PATH[step], DISC.radius + 0.5
        box = max(u - reach, 0.0), max(v - reach, 0.0), u + reach, v + reach
        box = box if u < 320 and v < 240 else None
        images.append(label(step, box, "held" if step < HELD + 3 else "flight"))
    save_labels(folder / "throw.json", replace(LABELS, width=426, images=tuple(images)))
    return folder


def test_track_compares_with_labels_in_the_pixels_of_the_file(wide: Path, tmp_path: Path, capsys):
    options = ["--at", f"{HELD * CONTROL_DT:.3f}", "--box", *box_at(HELD), "--segmenter", "color"]
    options += ["--color", "340", "20", "--truth", str(wide / "throw.json")]
    assert main(["track", str(wide / "throw.mp4"), "--out", str(tmp_path / "out"), *options]) == 0
    report = json.loads((tmp_path / "out" / SUMMARY).read_text())
    flight = report["truth"]["flight"]
    assert flight["images"] >= 12
    assert flight["within_5px"] > 0.8
    low, high = flight["within_5px_interval"]
    assert low < flight["within_5px"] <= high
    assert flight["error_p50"] < 3.0
    assert report["notes"][0].startswith("images of 426 by 240 px were scaled")
    assert "boxes against the labels" in capsys.readouterr().out


def test_track_refuses_camera_labels_and_box_of_another_size(wide: Path, tmp_path: Path, refusal: Any):
    CameraFile(camera=RGB_CAMERA).save(tmp_path / "camera.json")
    save_labels(tmp_path / "labels.json", replace(LABELS, images=()))
    for options, words in (
        (["--camera", str(tmp_path / "camera.json")], "(240, 426, 3)"),
        (["--truth", str(tmp_path / "labels.json")], "the labels are for images of 320 by 240 px"),
        (["--truth", "nowhere.json"], "nowhere.json"),
        (["--box", "400", "100", "500", "200"], "is not on the image of 426 by 240 px"),
    ):
        assert words in refusal("track", wide / "throw.mp4", "--out", tmp_path / "out", *options)
        assert not (tmp_path / "out").exists()


EXPORTS = Path(__file__).parent / "exports"


@pytest.fixture(scope="module")
def video(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("labels") / "throw.mp4"
    save_video(path, (np.full((180, 320, 3), 20 * i, np.uint8) for i in range(8)))
    return path


def rows(labels: Labels) -> list[tuple[int, str, Any]]:
    return [(each.image, each.phase, each.box and tuple(map(round, each.box))) for each in labels.images]


def ball(image: int) -> tuple[int, int, int, int]:
    return (20 + 10 * image, 40, 40 + 10 * image, 60)


@pytest.mark.parametrize("name", ["coco.json", "cvat_images.xml"])
def test_boxes_of_single_images(name: str, video: Path):
    labels = load_labels(EXPORTS / name, video)
    assert rows(labels) == [(2, "held", ball(2)), (4, "flight", ball(4)), (5, "flight", ball(5))]
    assert (labels.width, labels.height, labels.object) == (320, 180, "white ball")
    assert (labels.at(4 / 30.0 + 0.001), labels.at(4 / 30.0 + 0.01)) == (labels.images[1], None)


def test_nothing_is_visible_where_a_track_is_outside(video: Path):
    labels = load_labels(EXPORTS / "cvat_video.xml", video)
    assert rows(labels) == [
        (2, "held", ball(2)),
        (3, "flight", None),
        (4, "flight", None),
        (5, "flight", ball(5)),
        (6, "flight", ball(6)),
        (7, "flight", None),
    ]


def test_key_frames_of_label_studio_are_interpolated(video: Path):
    """Frames count from 1; 6.25 % of 320 px are 20, 10 % of 180 px are 18."""
    labels = load_labels(EXPORTS / "label_studio.json", video)
    assert rows(labels) == [
        (0, "held", (20, 40, 40, 60)),
        (1, "flight", (30, 36, 50, 54)),
        (2, "flight", (40, 45, 60, 72)),
        (3, "flight", (50, 54, 70, 90)),
        (4, "flight", None),
        (5, "flight", (70, 72, 90, 90)),
        (6, "flight", (70, 72, 90, 90)),
        (7, "flight", (70, 72, 90, 90)),
    ]


@pytest.mark.parametrize(
    ("name", "old", "new", "words"),
    [
        ("coco.json", '"image_id":5', '"image_id":6', "image 5 has two boxes"),
        ("coco.json", "frame_000005", "frame_000008", "image 8, the video has 8 images"),
        ("coco.json", '"occluded":false', '"rotation":12.5', "rotated by 12.5"),
        ("coco.json", "frame_000005.png", "last.png", "'last.png' has no number"),
        ("cvat_video.xml", "</annotations>", "", "no XML"),
        ("cvat_video.xml", "<annotations>", "<!DOCTYPE a><annotations>", "document type"),
        ("cvat_video.xml", 'frame="5"', 'frame="99999999"', "image 99999999, the video has 8 images"),
        ("label_studio.json", '"was_cancelled": false', '"was_cancelled": true', "0 annotations of throw"),
        ("label_studio.json", '"annotations"', '"labels"', "annotations"),
    ],
)
def test_a_bad_export_is_refused(name: str, old: str, new: str, words: str, video: Path, tmp_path: Path):
    (tmp_path / name).write_text((EXPORTS / name).read_text().replace(old, new))
    with pytest.raises(PerceptionError, match="cannot be read as a video"):
        load_labels(EXPORTS / "coco.json", tmp_path / name)
    with pytest.raises(InvalidValueError, match=words):
        load_labels(tmp_path / name, video)
