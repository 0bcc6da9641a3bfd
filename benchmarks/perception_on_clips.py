"""How methods to follow an object do on real clips that a person labelled: a table by clip and method.

FOLDER has videos and, beside each, its label file: throw.mp4, throw.json (docs/perception.md).

nice python benchmarks/perception_on_clips.py FOLDER --out clips.json
"""

import argparse
import json
from pathlib import Path
from typing import Any

from peers import follow, methods

from pixel2catch.camera.image import Pixels
from pixel2catch.errors import InvalidValueError
from pixel2catch.evaluation.box_scores import Score, summary
from pixel2catch.files import write_atomically
from pixel2catch.perception.labels import Labels, Truth
from pixel2catch.perception.sources import ImageFit, on_control_clock, video_images

HUES = {"red": (340.0, 20.0), "orange": (8.0, 45.0), "yellow": (42.0, 75.0), "blue": (195.0, 235.0)}
"""Hues that one would give `--color` for an object of which a label file says such a word [degrees]."""


def main() -> None:
    options = _options()
    scores: dict[str, dict[str, list[Score]]] = {}
    labelled = sorted(path for folder in options.folders for path in folder.glob("*.json"))
    for path in labelled:
        labels = Labels.load(path)
        images, truths = shown(path.parent / labels.video, labels)
        hue = next((hue for word, hue in HUES.items() if word in labels.object), None)
        for name, make in methods(hue).items():
            if options.methods and name not in options.methods.split(","):
                continue
            scores.setdefault(path.stem, {})[name] = follow(make(), images, truths, options.seed)
        print(row(path.stem, labels.object, scores[path.stem]), flush=True)
    pooled: dict[str, list[Score]] = {}
    for each in scores.values():
        for name, rows in each.items():
            pooled.setdefault(name, []).extend(rows)
    print(row("all", "", pooled))
    report = {clip: {name: summary(rows) for name, rows in each.items()} for clip, each in scores.items()}
    if options.out:
        content = json.dumps(
            {**report, "all": {name: summary(rows) for name, rows in pooled.items()}}, indent=1
        )
        write_atomically({options.out: content.encode()})


def shown(video: Path, labels: Labels) -> tuple[list[Pixels], list[Truth | None]]:
    """The images that a control loop gets of a video, each once, in the policies' size; and their truths.

    Raises:
        InvalidValueError: The labels are of no video, or of another one.
    """
    fit = ImageFit(own=(labels.width, labels.height))
    notes: list[str] = []
    images, truths, last = [], [], -1.0
    for tick in on_control_clock(video_images(video, notes), notes, fit):
        if tick.image.stamp <= last:
            continue
        last, label = tick.image.stamp, labels.at(tick.image.stamp)
        images.append(tick.image.pixels)
        truths.append(label and Truth(phase=label.phase, box=label.box and fit.box(label.box)))
    if not any(truth and truth.box for truth in truths):
        raise InvalidValueError(f"none of the labels of {labels.video} is of an image that {video} shows.")
    return images, truths


def row(clip: str, kind: str, scores: dict[str, list[Score]]) -> str:
    """One line of the table: in flight, the share within 5 px and its interval, then false boxes."""
    cells = []
    for name, rows in scores.items():
        flight: dict[str, Any] = summary(rows)["flight"]
        if not flight["images"]:
            continue
        low, high = flight["within_5px_interval"]
        share = f"{100 * flight['within_5px']:3.0f} % ({100 * low:.0f} to {100 * high:.0f})"
        cells.append(f"{name} {share} of {flight['images']}, false {flight['false_boxes']}")
    return f"{clip} ({kind}): " + "; ".join(cells)


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folders", type=Path, nargs="+", help="with videos and their labels")
    parser.add_argument("--methods", default="", help="some of them, by commas")
    parser.add_argument("--seed", type=int, default=0, help="of the error of the box that a person gives")
    parser.add_argument("--out", type=Path, help="JSON file")
    return parser.parse_args()


if __name__ == "__main__":
    main()
