"""How methods to follow an object do on real clips that a person labelled: a table by clip and method.

FOLDER has videos and, beside each, its label file: throw.mp4, throw.json (docs/perception.md).

nice python benchmarks/perception_on_clips.py FOLDER --out clips.json
"""

from pathlib import Path

from peers import Results, parser_of

from pixel2catch.camera.image import Image
from pixel2catch.errors import InvalidValueError
from pixel2catch.perception.labels import Labels, Truth
from pixel2catch.perception.sources import ImageFit, on_control_clock, video_images

HUES = {"red": (340.0, 20.0), "orange": (8.0, 45.0), "yellow": (42.0, 75.0), "blue": (195.0, 235.0)}
"""Hues that one would give `--color` for an object of which a label file says such a word [degrees]."""


def main() -> None:
    parser = parser_of(__doc__)
    parser.add_argument("folders", type=Path, nargs="+", help="with videos and their labels")
    options = parser.parse_args()
    results = Results(options.methods)
    for path in sorted(path for folder in options.folders for path in folder.glob("*.json")):
        labels = Labels.load(path)
        images, truths = shown(path.parent / labels.video, labels)
        hue = next((hue for word, hue in HUES.items() if word in labels.object), None)
        results.add(f"{path.stem} ({labels.object})", images, truths, hue, options.seed)
    results.report(options.out)


def shown(video: Path, labels: Labels) -> tuple[list[Image], list[Truth | None]]:
    """The images that a control loop gets of a video, each once, in the policies' size; and their truths.

    Raises:
        InvalidValueError: The labels are of no video, or of another one.
    """
    fit = ImageFit(own=(labels.width, labels.height))
    notes: list[str] = []
    images = {
        tick.image.stamp: tick.image for tick in on_control_clock(video_images(video, notes), notes, fit)
    }
    found = map(labels.at, images)
    truths = [each and Truth(phase=each.phase, box=each.box and fit.box(each.box)) for each in found]
    if not any(truth and truth.box for truth in truths):
        raise InvalidValueError(f"none of the labels of {labels.video} is of an image that {video} shows.")
    return list(images.values()), truths


if __name__ == "__main__":
    main()
