"""How right the boxes of the segmenters are on rendered video: a furnished room, a thrower, blur and noise.

The shipped policy moves the robot by boxes from geometry. Every throw is filmed in a room of its own, and
every segmenter watches the same images: once as they are, once with the object gone for a part of its flight.

nice python benchmarks/perception_on_video.py --throws 20 --out results.json
"""

import json
import multiprocessing
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, replace
from typing import Any

from peers import follow, methods, parser_of
from rendered_throws import NEAR_HAND, FilmCfg, ThrowFilm, moments, truths

from pixel2catch.camera.image import Image
from pixel2catch.evaluation.box_scores import Score, reacquisition, summary
from pixel2catch.evaluation.loading import load_policy, task_of
from pixel2catch.evaluation.protocol import EvaluationCfg, RecordedThrow, recorded_throws
from pixel2catch.files import write_atomically
from pixel2catch.perception.regions import RobotMask
from pixel2catch.scene.constants import OBJECT_POS
from pixel2catch.scene.objects import select_objects
from pixel2catch.workcells import find_workcell

HUE = (350.0, 16.0)  #: Of the object, as a person finds it who looks at its pixels [degrees].

GAP_START, GAP_IMAGES = 8, 4
"""The object is gone from so many images after its release on, for so many images."""

AFTER_REACH = 10  #: Images that are filmed after the object came near the hand.


def main() -> None:
    parser = parser_of(__doc__)
    parser.add_argument("--throws", type=int, default=20, help="of seen, and of unseen objects")
    parser.add_argument("--jobs", type=int, default=1, help="processes that watch at the same time")
    options = parser.parse_args()
    chosen = options.methods.split(",") if options.methods else ["background", "color"]
    policy, method = load_policy(None)
    filming = FilmCfg(scene=task_of(policy).scene)
    report: dict[str, Any] = {"throws": options.throws, "seed": options.seed, "film": asdict(filming)}
    scores: dict[str, list[Score]] = {}
    waits: dict[str, list[int | None]] = {}
    for number, group in enumerate(("seen", "unseen")):
        objects, seed = select_objects(group), options.seed + number
        cfg = EvaluationCfg(objects=objects, num_envs=options.throws, trials=1, seed=seed)
        takes = recorded_throws(replace(cfg, task=task_of(policy)), policy, method)
        rooms = [replace(filming, room=i) for i in range(options.throws)]
        with ProcessPoolExecutor(options.jobs, mp_context=multiprocessing.get_context("spawn")) as pool:
            every = pool.map(watch, takes, rooms, [chosen] * options.throws)
            for i, watched in enumerate(every):
                for name, (rows, wait) in watched.items():
                    scores.setdefault(f"{name}, {group}", []).extend(rows)
                    waits.setdefault(f"{name}, {group}", []).append(wait)
                print(f"{group}: throw {i + 1} of {options.throws}", flush=True)
    report["scores"] = {name: summary(rows) for name, rows in scores.items()}
    report["images_until_found_after_gap"] = waits
    text = json.dumps(report, indent=1)
    print(text)
    if options.out:
        write_atomically({options.out: text.encode()})


def watch(take: RecordedThrow, cfg: FilmCfg, names: list[str]) -> dict[str, tuple[list[Score], int | None]]:
    """What each segmenter makes of a throw: scores, and images until it is found again after a gap.

    The object is not found again where there is None.
    """
    states = moments(take)
    first = next(i for i, moment in enumerate(states) if moment.time > 0.0) + GAP_START
    with ThrowFilm(cfg, take.object_name, states[0].qpos[OBJECT_POS], cfg.room) as film:
        shots = list(film.lead_in(states[0]))
        gapped = [shot.image for shot in shots]
        num_near = 0
        for i, moment in enumerate(states):
            shots.append(film.shot(moment))
            is_hidden = first <= i < first + GAP_IMAGES
            gapped.append((film.shot(moment, is_empty=True) if is_hidden else shots[-1]).image)
            num_near += num_near > 0 or shots[-1].palm_distance < NEAR_HAND
            if num_near > AFTER_REACH:
                break
    known = truths(shots)
    back = cfg.num_held + first + GAP_IMAGES - 1  # among the images after the one in which a person points
    robot = RobotMask(find_workcell(cfg.scene.workcell))

    def scores(name: str, images: list[Image]) -> list[Score]:
        return follow(methods(HUE, robot)[name](), images, known, cfg.room)

    images = [shot.image for shot in shots]
    return {name: (scores(name, images), reacquisition(scores(name, gapped), back)) for name in names}


if __name__ == "__main__":
    main()
