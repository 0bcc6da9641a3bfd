"""Replay recorded flights of a thrown object, and print how many of them a policy catches.

Reads the data sets of github.com/JIAjindou/Feedback-neural-network, folder irregular_object: 30 flights of
an empty bottle thrown by a person, 21 for training and 9 for testing, with acceleration, position and
velocity at 1 kHz. Each flight is fitted by gravity, quadratic drag and a sideways force, taken back to a
height of 1 m, and turned towards the robot. `aimed`: each falls through a point of the paper's catch volume.
`thrown`: all keep their places to each other, and their mean falls through its middle.

python benchmarks/recorded_flights.py Training_dataset.mat --policies catch_alone+fit --camera people
"""

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
import tyro
from scipy.integrate import solve_ivp
from scipy.io import loadmat
from scipy.optimize import least_squares
from tyro.conf import Positional

from pixel2catch.devices import uniform
from pixel2catch.envs import catch_env
from pixel2catch.envs.episode import Episode, draw_episode
from pixel2catch.evaluation.loading import load_policy, task_of
from pixel2catch.evaluation.metrics import wilson_interval
from pixel2catch.evaluation.protocol import EvaluationCfg, evaluate
from pixel2catch.evaluation.reach import is_reachable
from pixel2catch.mdp.throws import ThrowCfg
from pixel2catch.scene.constants import GRAVITY
from pixel2catch.scene.objects import SEEN
from pixel2catch.workcells import find_workcell

RELEASE_HEIGHT, CATCH_HEIGHT = 1.0, 1.0  #: Heights of the release and of the aim [m].
STEP = 10  #: Every tenth sample of 1 ms is fitted.


def motion(_: float, state: np.ndarray, drag: float, side: float) -> np.ndarray:
    """Rates of position and velocity under gravity, drag and a sideways force [1/m]."""
    velocity = state[3:]
    speed, level = np.linalg.norm(velocity), np.hypot(*velocity[:2])
    across = np.array((-velocity[1], velocity[0], 0.0)) / level
    acceleration = speed * (side * speed * across - drag * velocity) - (0.0, 0.0, GRAVITY)
    return np.concatenate((velocity, acceleration))


@dataclass(frozen=True, kw_only=True)
class Flight:
    """A fitted flight from its release; x is along its mean direction, away from the thrower."""

    speed: np.ndarray  #: Velocity at the release: along, across, up [m/s].
    drag: float  #: Deceleration over the square of the speed [1/m].
    side: float  #: Sideways acceleration over the square of the speed [1/m].
    start: np.ndarray  #: Place of the release in the recording, level [m].
    end: np.ndarray  #: Place at which it falls through the catch height, likewise [m].
    error: float  #: Root mean square distance of the fit from the recording [m].


def fitted(record: np.ndarray) -> Flight:
    """Fit one recording: rows of acceleration, position and velocity at 1 kHz."""
    place, times = record[::STEP, 3:6], 1e-3 * STEP * np.arange(len(record[::STEP]))

    def residuals(x: np.ndarray) -> np.ndarray:
        found = solve_ivp(motion, (0.0, times[-1]), x[:6], t_eval=times, args=tuple(x[6:]), max_step=0.02)
        return (found.y[:3].T - place).ravel()

    best = least_squares(residuals, np.concatenate((record[0, 3:9], (0.1, 0.0))))
    start, drag, side = best.x[:6], *best.x[6:]

    def crossing(height: float, until: float) -> np.ndarray:
        def reaches(_: float, state: np.ndarray, *__: float) -> float:
            return float(state[2] - height)

        reaches.terminal, reaches.direction = True, -1.0  # type: ignore[attr-defined]
        path = solve_ivp(motion, (0.0, until), start, args=(drag, side), events=reaches, max_step=0.02)
        return path.y_events[0][0]

    release, end = crossing(RELEASE_HEIGHT, -2.0), crossing(CATCH_HEIGHT, 2.0)
    error = float(np.sqrt(3.0 * np.mean(best.fun**2)))
    return Flight(speed=release[3:], drag=drag, side=side, start=release[:2], end=end[:2], error=error)


def episodes(flights: list[Flight], *, is_aimed: bool) -> Any:
    """Return a function that draws episodes with one of the flights in each."""
    mean = np.mean([each.speed[:2] / np.hypot(*each.speed[:2]) for each in flights], axis=0)
    middle = np.mean([each.end for each in flights], axis=0)
    heading = np.arctan2(mean[1], mean[0])
    turn = np.pi - heading  # the mean direction becomes -x
    rotation = np.array(((np.cos(turn), -np.sin(turn)), (np.sin(turn), np.cos(turn))))
    rows = [
        (
            *(rotation @ (f.start - (f.end if is_aimed else middle))),
            *(rotation @ f.speed[:2]),
            f.speed[2],
            f.drag,
            f.side,
        )
        for f in flights
    ]
    table = torch.tensor(np.array(rows), dtype=torch.float32)

    def draw(cfg: Any, action_bias: Any, objects: Any, num_envs: int, generator: torch.Generator) -> Episode:
        episode = draw_episode(cfg, action_bias, objects, num_envs, generator)
        chosen = torch.randint(len(table), (num_envs,), generator=generator, device=generator.device)
        x, y, along, across, up, drag, side = table.to(generator.device)[chosen].T
        nominal = ThrowCfg()
        aim = uniform((nominal.aim_x, nominal.aim_y), num_envs, generator)
        if not is_aimed:
            aim = aim * 0.0 + torch.tensor((sum(nominal.aim_x) / 2.0, 0.0), device=aim.device)
        height = torch.full_like(x, RELEASE_HEIGHT)
        level = torch.hypot(along, across)
        sideways = torch.stack((-across / level, along / level, torch.zeros_like(x)), dim=-1)
        throw = replace(
            episode.throw,
            pos=torch.stack((aim[:, 0] + x, aim[:, 1] + y, height), dim=-1),
            lin_vel=torch.stack((along, across, up), dim=-1),
            aim=torch.cat((aim, height[:, None]), dim=-1),
        )
        return replace(episode, throw=throw, drag=drag, side_force=side[:, None] * sideways)

    return draw


def main(
    recordings: Positional[list[Path]],
    /,
    policies: list[str],
    camera: Path | None = None,
    flights: Literal["aimed", "thrown"] = "aimed",
    throws: int = 200,
    seed: int = 0,
    physics_hz: float = 240.0,
    out: Path | None = None,
) -> None:
    """Catch the flights of all recordings, drawn at random.

    Args:
        recordings: Files with a data set each.
        policies: Policies, as `evaluate` takes them.
        camera: Camera file, or the name people. Default: that of each policy.
        flights: Whether each flight falls through the catch volume, or all keep their places to each other.
        throws: Number of throws.
        seed: Seed.
        physics_hz: Physics rate.
        out: File for the results.
    """
    sets = [next(v for k, v in loadmat(file).items() if not k.startswith("__")) for file in recordings]
    found = [fitted(record) for record in np.concatenate(sets)]
    print(f"{len(found)} flights, fitted within {max(each.error for each in found) * 1e3:.0f} mm (RMS)")
    catch_env.draw_episode = episodes(found, is_aimed=flights == "aimed")
    rows = []
    for name in policies:
        rows.append(
            {"policy": name, "flights": flights} | caught_by(Path(name), camera, throws, seed, physics_hz)
        )
        print(json.dumps(rows[-1]))
    if out:
        out.write_text(json.dumps(rows, indent=1) + "\n")


def caught_by(name: Path, camera: Path | None, throws: int, seed: int, physics_hz: float) -> dict[str, Any]:
    """Return the rates of a policy over rounds of 100 throws, each with its own seed."""
    policy, method = load_policy(name)
    task = task_of(policy, physics_hz, camera=camera)
    air = replace(task.randomization, air_density=1.0, side_force=0.01)  # the recording's take their place
    task, counts, total = replace(task, randomization=air), np.zeros(4, int), 0
    while total < throws:
        cfg = EvaluationCfg(objects=SEEN, num_envs=100, trials=1, seed=seed + total, task=task)
        env = cfg.make_env(method)
        env.seed(cfg.seed)
        env.reset()
        near = is_reachable(env.episode, find_workcell(task.scene.workcell))
        record = evaluate(policy, method, cfg, env=env, is_seeded=True).record
        is_caught = record.is_success
        counts += [int(flags.sum()) for flags in (record.is_tracked, is_caught, near, is_caught & near)]
        total += cfg.num_envs
    tracked, caught, reachable, both = counts.tolist()
    return {
        "throws": total,
        "T.R.": tracked / total,
        "S.R.": caught / total,
        "interval": wilson_interval(caught, total),
        "reachable": reachable / total,
        "S.R. of reachable": both / max(reachable, 1),
    }


if __name__ == "__main__":
    tyro.cli(main)
