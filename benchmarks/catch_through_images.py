"""How often the shipped policy catches with boxes from rendered images, by background subtraction.

Every throw is thrown twice: with boxes from images, and with those of training, from geometry. Images come on
the 30 Hz clock of the policy and their boxes one or two control steps late, as in training.

nice python benchmarks/catch_through_images.py --throws 100 --out results.json
"""

import argparse
import json
import multiprocessing
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from rendered_throws import FilmCfg, PerceptionRunner, RenderedDetector, film_scores

from pixel2catch.envs.catch_env import Step
from pixel2catch.envs.cfg import CatchEnvCfg
from pixel2catch.evaluation.box_scores import Score, summary
from pixel2catch.evaluation.loading import fingerprint, load_policy, task_of
from pixel2catch.evaluation.metrics import wilson_interval
from pixel2catch.evaluation.protocol import Actor, EvaluationCfg, RoundState, Trials, run_round
from pixel2catch.files import write_atomically
from pixel2catch.methods import Method
from pixel2catch.perception.background import BackgroundSubtraction
from pixel2catch.scene.objects import OBJECTS, select_objects

SENSING = ("corner_noise", "latency_steps", "joint_noise", "joint_bias", "least_visible")
"""What the report says of the sensors."""


@dataclass(frozen=True, kw_only=True)
class Pair:
    """One throw, seen through images and by geometry."""

    object_name: str
    images: Trials
    geometry: Trials
    scores: list[Score]


class Duel:
    """Throws the same throws at the same policy, with images and without."""

    def __init__(self, cfg: EvaluationCfg, film: FilmCfg, actor: Actor, method: Method) -> None:
        self._env, self._actor = cfg.make_env(method), actor
        perception = PerceptionRunner(BackgroundSubtraction(), film.scene.workcell)
        self.detector = RenderedDetector(self._env.detector, self._env.world, film, perception)
        self._env.detector = self.detector

    def throw(self, seed: int) -> Pair:
        """One throw both ways."""
        by_images = self._round(seed, through_images=True)
        scores = film_scores(self.detector.shots, self.detector.boxes)
        by_geometry = self._round(seed, through_images=False)
        name = tuple(OBJECTS)[int(by_images.record.object_id[0])]
        return Pair(object_name=name, images=by_images, geometry=by_geometry, scores=scores)

    def close(self) -> None:
        self.detector.close()
        self._env.close()

    def _round(self, seed: int, *, through_images: bool) -> Trials:
        """Nobody looks any more once the trial is decided: the policy is not asked then."""

        def watch(_: Step, state: RoundState) -> None:
            if not (state.is_running & ~state.is_testing)[0]:
                self.detector.close()

        self._env.seed(seed)
        if through_images:
            self.detector.open()
        return run_round(self._env, self._actor, watch)


def main() -> None:
    options = _options()
    begin = time.perf_counter()
    seeds = range(options.seed, options.seed + options.throws)
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(options.jobs, mp_context=context) as pool:
        parts = [seeds[i :: options.jobs] for i in range(options.jobs)]
        shares = pool.map(play, [options] * options.jobs, parts)
        pairs = [pair for share in shares for pair in share]
    task = task_of(load_policy(options.policy)[0])
    report = {
        "policy": fingerprint(options.policy),
        "objects": options.objects,
        "seed": options.seed,
        "film": asdict(filming(options, task)),
        "sensing": {name: getattr(task.sensing, name) for name in SENSING},
        **compare(pairs),
        "seconds": time.perf_counter() - begin,
    }
    print(json.dumps(report, indent=1))
    if options.out:
        write_atomically({options.out: json.dumps(report, indent=1).encode()})


def play(options: argparse.Namespace, seeds: range) -> list[Pair]:
    """Throw by seed, one after the other."""
    torch.set_num_threads(1)
    policy, method = load_policy(options.policy)
    task = task_of(policy)
    cfg = EvaluationCfg(objects=select_objects(options.objects), num_envs=1, trials=1, task=task)
    duel, pairs = Duel(cfg, filming(options, task), policy, method), []
    try:
        for seed in seeds:
            pairs.append(duel.throw(seed))
            caught = [bool(each.record.is_success[0]) for each in (pairs[-1].images, pairs[-1].geometry)]
            print(f"{seed} {pairs[-1].object_name} images, geometry: {caught}", flush=True)
    finally:
        duel.close()
    return pairs


def filming(options: argparse.Namespace, task: CatchEnvCfg) -> FilmCfg:
    return FilmCfg(scene=task.scene, room=options.room)


def compare(pairs: list[Pair]) -> dict[str, Any]:
    """Rates of both, in which throws they part, and how right the boxes were."""
    num = len(pairs)
    report: dict[str, Any] = {"throws": num}
    for name in ("images", "geometry"):
        trials = Trials.concatenate([getattr(pair, name) for pair in pairs])
        for rate, values in (
            ("tracking_rate", trials.record.is_tracked),
            ("success_rate", trials.record.is_success),
            ("verified_rate", trials.is_verified),
        ):
            count = int(values.sum())
            report[f"{name}_{rate}"] = {"rate": count / num, "interval": wilson_interval(count, num)}
    caught = [[bool(each.record.is_success[0]) for each in (pair.images, pair.geometry)] for pair in pairs]
    report["only_images"] = sum(images and not geometry for images, geometry in caught)
    report["only_geometry"] = sum(geometry and not images for images, geometry in caught)
    report["boxes"] = summary(each for pair in pairs for each in pair.scores)
    report["each"] = [
        {"object": pair.object_name, "images": images, "geometry": geometry, "boxes": flight_rate(pair)}
        for pair, (images, geometry) in zip(pairs, caught, strict=True)
    ]
    return report


def flight_rate(pair: Pair) -> float:
    """Share of the throw's images with a good box, of those in which the object is visible."""
    visible = [each for each in pair.scores if each.is_visible]
    return round(sum(each.is_good for each in visible) / max(len(visible), 1), 3)


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--policy", type=Path, help="folder or name of a policy; default: the shipped one")
    parser.add_argument("--throws", type=int, default=100)
    parser.add_argument("--objects", nargs="+", default=["seen", "unseen"])
    parser.add_argument("--seed", type=int, default=0, help="of the first throw; the next has the next")
    parser.add_argument("--jobs", type=int, default=1, help="processes that throw at the same time")
    parser.add_argument("--room", type=int, default=0, help="seed of the room")
    parser.add_argument("--out", type=Path, help="JSON file")
    return parser.parse_args()


if __name__ == "__main__":
    main()
