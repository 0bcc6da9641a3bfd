"""How methods to follow an object do on real clips that a person labelled: a table by clip, kind and method.

FOLDER has videos and, beside each, its label file: throw.mp4, throw.json (docs/perception.md). Its
bounces.toml, if there is one, has the first image after an object's first bounce: throw = 42.

nice python benchmarks/perception_on_clips.py FOLDER --out clips.json
"""

import io
import tomllib
from itertools import repeat
from math import inf
from pathlib import Path

import av
from peers import Images, Made, Ours, Results, Truths, methods, parser_of

from pixel2catch.camera.image import Image
from pixel2catch.errors import InvalidValueError
from pixel2catch.perception.background import BackgroundSubtraction
from pixel2catch.perception.labels import Labels, Truth
from pixel2catch.perception.sources import ImageFit, on_control_clock, video_images

LARGE = 80.0  #: Longer side of a large object [px]. Source: ours.
STRONG = "42"  #: Constant rate factor of H.264 for strong compression. Source: ours; 23 is usual.


def main() -> None:
    parser = parser_of(__doc__)
    parser.add_argument("folders", type=Path, nargs="+", help="with videos and their labels")
    options = parser.parse_args()
    results = Results(options.methods)
    for path in sorted(path for folder in options.folders for path in folder.glob("*.json")):
        labels = Labels.load(path)
        images, truths = shown(path.parent / labels.video, labels)
        made, seed = methods(None), options.seed
        kinds = kinds_of(images, truths, labels, path)
        results.add(f"{path.stem} ({labels.object})", images, truths, made, seed, kinds)
        results.add(None, compressed(images), truths, made, seed, repeat(f"H.264, crf {STRONG}"))
        untold: Made = {"background": lambda: Ours(BackgroundSubtraction(), None, is_told=False)}
        results.add(None, images, truths, untold, seed, repeat("without a prompt"))
        if labels.rate > 20.0:
            results.add(None, images[::2], truths[::2], made, seed, repeat("every second image, 12 to 15 Hz"))
    results.report(options.out)


def kinds_of(images: Images, truths: Truths, labels: Labels, path: Path) -> list[str]:
    """Return the kind of each labelled image after the first in which something is visible."""
    known = path.with_name("bounces.toml")
    bounce = tomllib.loads(known.read_text()).get(path.stem, inf) if known.exists() else inf
    kinds: list[str] = []
    for image, truth in zip(images, truths, strict=True):
        if truth and (truth.box or kinds):
            is_after = (label := labels.at(image.stamp)) is not None and label.image >= bounce
            after = "after a bounce" if is_after else "free flight"
            left, top, right, bottom = truth.box or (0.0,) * 4
            kinds.append(f"{LARGE:g} px and more" if max(right - left, bottom - top) >= LARGE else after)
    return kinds[1:]


def compressed(images: Images) -> list[Image]:
    """Return the images as strong compression leaves them."""
    file = io.BytesIO()
    with av.open(file, "w", format="mp4") as video:
        stream = video.add_stream("libx264", rate=30, options={"crf": STRONG})
        (stream.height, stream.width), stream.pix_fmt = images[0].pixels.shape[:2], "yuv420p"
        frames = [av.VideoFrame.from_ndarray(image.pixels, format="rgb24") for image in images]
        for frame in (*frames, None):
            video.mux(stream.encode(frame))
    with av.open(io.BytesIO(file.getvalue()), "r") as encoded:
        decoded = [frame.to_ndarray(format="rgb24") for frame in encoded.decode(video=0)]
    return [Image(pixels=pixels, stamp=image.stamp) for pixels, image in zip(decoded, images, strict=True)]


def shown(video: Path, labels: Labels) -> tuple[list[Image], list[Truth | None]]:
    """The images that a control loop gets of a video, each once, in the policies' size; and their truths."""
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
