"""`pixel2catch track`: what perception finds in a video, a rosbag or a camera, and how fast it is."""

import csv
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import chain, takewhile
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.text import Text
from tyro.conf import Positional

from pixel2catch.checks import NewFolder, NotNegative, Positive, require_only, require_used
from pixel2catch.cli.console import results_console, say
from pixel2catch.errors import InvalidValueError, PerceptionError
from pixel2catch.files import free_folder, held_folder, json_text, write_atomically
from pixel2catch.installation import needs_extra
from pixel2catch.interruption import StopRequest
from pixel2catch.perception.factory import PerceptionArgs
from pixel2catch.reports import Cells, circumstances, terminal_table
from pixel2catch.scene.constants import OBJECT_RADIUS

if TYPE_CHECKING:
    from pixel2catch.camera.image import Pixels
    from pixel2catch.evaluation.box_scores import Score
    from pixel2catch.perception.labels import Labels
    from pixel2catch.perception.sightings import Sighting
    from pixel2catch.scene.constants import CameraSpec

VIDEO, TABLE, SUMMARY = "track.mp4", "features.csv", "summary.json"  #: Files in the folder that it writes.
REPORT_SECONDS = 5.0  #: Time between two lines of progress [s].


@dataclass(frozen=True, kw_only=True)
class Track:
    """Show and record what perception finds in images.

    The object is pointed out by --box or by --color, or, without both and after a loss, by its flight. A
    camera is followed until Ctrl-C or --seconds.
    """

    #: A video file, a folder of images, a rosbag2 (its folder, .mcap or .db3), or a camera: its number or
    #: /dev/videoN. self-test: painted throws with known boxes; prints how many boxes are right.
    source: Positional[str]
    #: New or empty folder for track.mp4, features.csv and summary.json.
    out: NewFolder = field(default_factory=partial(free_folder, "track"))
    at: NotNegative = 0.0  #: When the throw begins and the object is pointed out [s after the first image].
    seconds: Positive | None = None  #: When to stop [s after the first image]. Default: at the end.
    topic: str | None = None  #: Topic of the images in a rosbag. Default: the only one.
    #: Radius of a ball of the largest object's volume [m]: much larger things are not the object.
    object_radius: Positive = OBJECT_RADIUS
    #: Labels of the video, of CVAT, Label Studio or in COCO format: compare the boxes with them, from --at
    #: on.
    truth: Path | None = None
    perception: PerceptionArgs = field(default_factory=PerceptionArgs)  #: How the object is found.

    def run(self) -> None:
        with needs_extra("perception"):
            from pixel2catch.evaluation import box_scores
            from pixel2catch.perception import sightings
            from pixel2catch.perception.labels import load_labels
            from pixel2catch.ros2.bags import is_bag

        if self.source == "self-test":
            used = ("source", "segmenter", "color", "checkpoint", "image_size", "device", "compile")
            require_only(self, used, "with self-test")
            from pixel2catch.perception.self_test import agreement

            for line in agreement(self.perception.make_segmenter(), self.perception.segmenter):
                print(line)
            return
        require_used(self, ("topic",), is_bag(Path(self.source)), "with a source that is no rosbag")
        labels = self.truth and load_labels(self.truth, Path(self.source))
        self.perception.prepare()
        notes, scores = list[str](), list[box_scores.Score]()
        camera = self.perception.camera_spec(notes)
        found = self._sightings(camera, notes, labels, scores)
        first = next(found, None)
        if first is None:
            problem = f"{self.source} has no images; name another video, rosbag2 or camera."
            raise PerceptionError(" ".join((problem, *notes)))
        end = inf if self.seconds is None else self.seconds
        with held_folder(self.out), StopRequest() as stop:
            rows = self._write(
                takewhile(lambda each: each.time <= end and not stop.is_set, chain([first], found)), camera
            )
        if stop.is_set:
            notes.append("stopped by Ctrl-C.")
        if labels and not scores:
            notes.append(f"no image from --at on is labelled: {len(labels.images)} labels were not used.")
        notes.extend(sightings.rate_notes(rows))
        source = {"source": self.source, "segmenter": self.perception.segmenter}
        truth = {"truth": box_scores.summary(scores)} if labels else {}
        summary = {**source, **sightings.summary(rows), **truth, "notes": notes}
        text = json_text(summary | {"circumstances": circumstances()})
        write_atomically({self.out / SUMMARY: text.encode()})
        _print_result(summary)
        say(f"wrote {self.out}: {VIDEO}, {TABLE}, {SUMMARY}")

    def _sightings(
        self, camera: "CameraSpec", notes: list[str], labels: "Labels | None", scores: "list[Score]"
    ) -> "Iterator[Sighting]":
        """Return what is seen, step by step; `scores` gets how right it is."""
        from pixel2catch.evaluation.box_scores import scored
        from pixel2catch.perception.regions import PlausibilityCfg
        from pixel2catch.perception.sightings import follow
        from pixel2catch.perception.sources import ImageFit, images_of, is_camera, on_control_clock
        from pixel2catch.perception.tracker import ObjectTracker

        args, own, size = self.perception, None, (camera.width, camera.height)
        if not args.camera:
            first = next(images_of(self.source, [], self.topic), None)
            own = first and (first.pixels.shape[1], first.pixels.shape[0])
        fit = ImageFit(own=own or size, size=size)
        if fit.changes:
            notes.append(
                "images of {} by {} px were scaled and framed in black to {} by {}: the table has boxes in "
                "these pixels; --box, --region and --truth are in the file's.".format(*fit.own, *size)
            )
        if labels and fit.own != (labels.width, labels.height):
            raise InvalidValueError(
                f"the labels are for images of {labels.width} by {labels.height} px ({labels.video}), "
                f"these have {fit.own[0]} by {fit.own[1]}: give the labels of this video."
            )
        args.make_prompter(replace(camera, width=fit.own[0], height=fit.own[1]))  # checks box and region
        box, region = args.box and fit.box(args.box), args.region and fit.box(args.region)
        tracker = ObjectTracker(
            args.make_segmenter(is_live=is_camera(self.source), say=say),
            replace(args, box=box, region=region).make_prompter(camera),
            camera=camera,
            limits=PlausibilityCfg.up_to(self.object_radius),
            waits=True,
        )
        ticks = on_control_clock(images_of(self.source, notes, self.topic), notes, fit)
        found = follow(ticks, tracker, self.at, camera)
        return scored(found, labels, fit, self.at, scores) if labels else found

    def _write(self, sightings: "Iterable[Sighting]", camera: "CameraSpec") -> list[dict[str, Any]]:
        """Write a picture and a row for every sighting; return the rows."""
        from pixel2catch.perception.sightings import COLUMNS, annotated
        from pixel2catch.rendering.video import write_video

        rows = list[dict[str, Any]]()
        with open(self.out / TABLE, "w", newline="", encoding="utf-8") as file:
            table = csv.DictWriter(file, COLUMNS)
            table.writeheader()

            def pictures() -> "Iterator[Pixels]":
                said = -inf
                for sighting in sightings:
                    rows.append(sighting.row())
                    table.writerow(rows[-1])
                    yield annotated(sighting, camera)
                    if time.monotonic() - said > REPORT_SECONDS:
                        said = time.monotonic()
                        say(f"{sighting.time:.1f} s: {sighting.box.verdict}")

            write_video(self.out / VIDEO, pictures())
        return rows


def _print_result(summary: dict[str, Any]) -> None:
    """Print the duration of the stages, what was found, and whether it is fast enough."""
    stages = [
        {"stage": stage, **{name: f"{took[name]:.2f}" for name in ("p50", "p95", "p99")}}
        | {"images": str(took["count"])}
        for stage, took in summary["stages_ms"].items()
    ]
    console = results_console()
    console.print(terminal_table("time of each stage [ms]", stages))
    if "truth" in summary:
        console.print(terminal_table("boxes against the labels", list(_truth_rows(summary["truth"]))))
    for line in _sentences(summary):
        console.print(Text(line))


def _truth_rows(truth: dict[str, Any]) -> Iterator[Cells]:
    """Accuracy of the boxes, by labelled phase."""
    for phase, row in truth.items():
        if row["images"] + row["hidden"]:
            low, high = row.get("within_5px_interval", (0.0, 0.0))
            yield {
                "phase": phase,
                "images": str(row["images"]),
                "within 5 px": f"{100 * row['within_5px']:.1f} %" if row["images"] else "-",
                "95 % interval": f"{100 * low:.1f} to {100 * high:.1f} %" if row["images"] else "-",
                "median error": f"{row['error_p50']:.1f} px" if "error_p50" in row else "-",
                "false boxes": str(row["false_boxes"]),
                "lost": str(row.get("losses", 0)),
                "found again": str(row.get("reacquisitions", 0)),
            }


def _sentences(summary: dict[str, Any]) -> "Iterator[str]":
    from pixel2catch.perception.foreground import REMEDIES

    counts = ", ".join(f"{verdict} {count}" for verdict, count in summary["verdicts"].items())
    yield f"{summary['num_steps']} control steps in {summary['seconds']:.1f} s: {counts}"
    remedies: dict[str, str] = {**REMEDIES}
    for doubt, count in summary["doubts"].items():
        yield f"In {count} images: {doubt}; {remedies[doubt]}."
    share = summary["seen_since_first"]
    yield (
        "The object was never seen: point it out with --box or --color, at the time --at."
        if share is None
        else f"Seen in {100 * share:.1f} % of the images since it was first seen."
    )
    yield from (f"Note: {note}" for note in summary["notes"])
    start = (
        "Fast enough: 99 % of the images took" if summary["is_fast_enough"] else "TOO SLOW: 99 % must take"
    )
    yield f"{start} less than a control step, {summary['limit_ms']:.1f} ms."
