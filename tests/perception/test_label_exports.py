"""Label files of other programs; how each was made: exports/README.md."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from filmed import save_video

from pixel2catch.errors import InvalidValueError
from pixel2catch.perception.labels import Labels, load_labels

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
    assert labels.at(4 / 30.0) == labels.images[1]


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


def test_a_file_of_this_package_needs_no_video(tmp_path: Path):
    content = {"format_version": 1, "video": "a.mp4", "width": 64, "height": 48, "rate": 30.0, "images": []}
    (tmp_path / "labels.json").write_text(json.dumps(content))
    assert load_labels(tmp_path / "labels.json", tmp_path / "none.mp4").width == 64


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
        (
            "label_studio.json",
            '"was_cancelled": false',
            '"was_cancelled": true',
            "0 annotations of throw.mp4",
        ),
        ("label_studio.json", '"annotations"', '"labels"', "annotations"),
    ],
)
def test_a_bad_export_is_refused(name: str, old: str, new: str, words: str, video: Path, tmp_path: Path):
    (tmp_path / name).write_text((EXPORTS / name).read_text().replace(old, new))
    with pytest.raises(InvalidValueError, match=words):
        load_labels(tmp_path / name, video)
