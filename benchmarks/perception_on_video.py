"""How right the boxes of the segmenters are on rendered video: a furnished room, a thrower, blur and noise.

The shipped policy moves the robot by boxes from geometry. Every throw is filmed in a room of its own, and
every segmenter watches the same images: once as they are, once with the object gone for a part of its flight.

nice python benchmarks/perception_on_video.py --throws 20 --out results.json
"""

import argparse
import json
import multiprocessing
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from rendered_throws import (
    NEAR_HAND,
    FilmCfg,
    LabelledImage,
    PerceptionRunner,
    ThrowFilm,
    film_scores,
    moments,
)

from pixel2catch.camera.image import Box
from pixel2catch.evaluation.box_scores import GOOD, Score, reacquisition, summary
from pixel2catch.evaluation.loading import load_policy, task_of
from pixel2catch.evaluation.protocol import EvaluationCfg, recorded_throws
from pixel2catch.evaluation.recorded_throws import RecordedThrow
from pixel2catch.files import write_atomically
from pixel2catch.perception.background import BackgroundSubtraction
from pixel2catch.perception.segmenter import ColorRange, ColorThreshold, Segmenter
from pixel2catch.rendering.camera import CameraCfg, Moment
from pixel2catch.scene.constants import OBJECT_POS
from pixel2catch.scene.objects import select_objects

RED = ColorRange(hue=(350.0, 16.0))
"""What a person finds who looks at the object's pixels."""

GAP_START, GAP_IMAGES = 8, 4
"""The object is gone from so many images after its release on, for so many images."""

AFTER_REACH = 10
"""Images that are filmed after the object came near the hand."""


def segmenters() -> dict[str, Segmenter]:
    """Fresh ones, by name."""
    return {"background": BackgroundSubtraction(), "color": ColorThreshold(RED)}


def main() -> None:
    options = _options()
    policy, method = load_policy(None)
    camera = replace(CameraCfg(), exposure=options.exposure)
    filming = FilmCfg(scene=task_of(policy).scene, camera=camera, num_held=options.held)
    report: dict[str, Any] = {"throws": options.throws, "seed": options.seed, "film": asdict(filming)}
    scores: dict[str, list[Score]] = {}
    waits: dict[str, list[int | None]] = {}
    times: dict[str, list[float]] = {}
    begin = time.perf_counter()
    for number, group in enumerate(("seen", "unseen")):
        objects, seed = select_objects(group), options.seed + number
        cfg = EvaluationCfg(objects=objects, num_envs=options.throws, trials=1, seed=seed)
        takes = recorded_throws(replace(cfg, task=task_of(policy)), policy, method)
        rooms = [replace(filming, room=i) for i in range(options.throws)]
        with ProcessPoolExecutor(options.jobs, mp_context=multiprocessing.get_context("spawn")) as pool:
            every = list(pool.map(watch, takes, rooms, range(options.throws)))
        for i, (take, watched) in enumerate(zip(takes, every, strict=True)):
            for name, (rows, wait, total) in watched.items():
                scores.setdefault(f"{name}, {group}", []).extend(rows)
                waits.setdefault(f"{name}, {group}", []).append(wait)
                times.setdefault(name, []).append(total)
                good = np.mean([row.is_good for row in rows if row.is_visible])
                print(f"{group} {i} {take.object_name} {name} {good:.3f} wait {wait}", flush=True)
    report["scores"] = {name: summary(rows) for name, rows in scores.items()}
    report["gap"] = {name: gap_summary(several) for name, several in waits.items()}
    report["total_ms_p50"] = {name: 1e3 * float(np.median(several)) for name, several in times.items()}
    report["good_px"], report["seconds"] = GOOD, time.perf_counter() - begin
    print(json.dumps(report, indent=1))
    if options.out:
        write_atomically({options.out: json.dumps(report, indent=1).encode()})


def watch(take: RecordedThrow, cfg: FilmCfg, seed: int) -> dict[str, tuple[list[Score], int | None, float]]:
    """What each segmenter makes of a throw: scores, images until it is back after a gap, time of an image."""
    plain, gapped = ({name: PerceptionRunner(each) for name, each in segmenters().items()} for _ in range(2))
    shots: list[LabelledImage] = []
    seen: dict[str, list[Box]] = {name: [] for name in plain}
    seen_gapped: dict[str, list[Box]] = {name: [] for name in plain}
    states = moments(take)
    release_pos = states[0].qpos[OBJECT_POS]
    first = next(i for i, moment in enumerate(states) if moment.time > 0.0) + GAP_START
    with ThrowFilm(cfg, take.object_name, release_pos, seed) as film:
        for watcher in (*plain.values(), *gapped.values()):
            watcher.begin()
        for number, (shot, hidden) in enumerate(images(film, states, cfg, first)):
            found = {name: watcher.see(shot) for name, watcher in plain.items()}
            found_gapped = {name: watcher.see(hidden) for name, watcher in gapped.items()}
            if number < cfg.num_empty:
                continue
            shots.append(shot)
            for name in plain:
                seen[name].append(found[name])
                seen_gapped[name].append(found_gapped[name])
    back = cfg.num_held + first + GAP_IMAGES
    return {
        name: (
            film_scores(shots, seen[name]),
            reacquisition(film_scores(shots, seen_gapped[name]), back),
            float(np.median(plain[name].durations)),
        )
        for name in plain
    }


def images(
    film: ThrowFilm, states: list[Moment], cfg: FilmCfg, first: int
) -> Iterator[tuple[LabelledImage, LabelledImage]]:
    """Yield each image, and what is shown to those from whom the object is hidden for a while."""
    for shot in film.lead_in(states[0], cfg.num_empty):
        yield shot, shot
    num_near = 0
    for i, moment in enumerate(states):
        shot = film.shot(moment)
        is_hidden = first <= i < first + GAP_IMAGES
        yield shot, film.shot(moment, is_empty=True) if is_hidden else shot
        num_near += num_near > 0 or shot.palm_distance < NEAR_HAND
        if num_near > AFTER_REACH:
            return


def gap_summary(waits: list[int | None]) -> dict[str, Any]:
    """How many images after its return the object was found."""
    found = [wait for wait in waits if wait is not None]
    return {"throws": len(waits), "not_found": len(waits) - len(found), "images": sorted(found)}


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--throws", type=int, default=20, help="of seen, and of unseen objects")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--exposure", type=float, default=CameraCfg().exposure, help="[s]")
    parser.add_argument("--held", type=int, default=FilmCfg().num_held, help="images before the episode")
    parser.add_argument("--jobs", type=int, default=1, help="processes that watch at the same time")
    parser.add_argument("--out", type=Path, help="JSON file")
    return parser.parse_args()


if __name__ == "__main__":
    main()
