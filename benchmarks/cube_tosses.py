"""Recorded tosses of a cube against the physics engines, with measured and with fitted contact parameters.

The 570 recordings are of ContactNets (Pfrommer, Halm, Posa, CoRL 2020; BSD-3), `data/tosses_processed` of its
repository: a hollow acrylic cube falls on a board; pose and speed at 148 Hz, lengths in half widths.
Position, angle: mean errors over a toss, in % of the width and in degrees; "at": of the position, after the
first touch. Rebound: rising over falling speed of the corner that touches first. Bounce: largest height of
the lowest corner after the touch; slide: way of the centre after the touch [mm].

Every third toss is held out for the table; a random search fits on the others, `--every` on fewer of each.
Lengths are scaled to the cube's height at rest; `--raw` leaves them as in published comparisons.

Run: python benchmarks/cube_tosses.py contact-nets/data/tosses_processed --hz 240 --out mujoco-240.json
"""

import json
from dataclasses import replace
from pathlib import Path
from typing import Literal

import mujoco
import numpy as np
import torch
import tyro
from mujoco import rollout
from tyro.conf import Positional

from pixel2catch.reports import circumstances
from pixel2catch.robots.poses import rotation_matrix
from pixel2catch.scene.cfg import PUSH_OUT, SceneCfg, contact_solref
from pixel2catch.scene.constants import GRAVITY
from pixel2catch.scene.objects import OBJECTS, make_object
from pixel2catch.scene.scene import build_spec
from pixel2catch.scene.shapes import box
from pixel2catch.sim.drake import DrakeCopy
from pixel2catch.sim.physx import PhysxCopy
from pixel2catch.sim.rigid_world import rigid_world
from pixel2catch.workcells import find_workcell

HALF, MASS, INERTIA = 0.0524, 0.37, 8.1e-4  # [m], [kg], [kg·m²]; source: the parameters beside the recordings
MEASURED = {"restitution": 0.125, "friction": 0.18, "push_out": PUSH_OUT}  # source: as above; push_out: ours
DATA_DT = 1.0 / 148.0
CORNERS = HALF * (2.0 * np.array([*np.ndindex(2, 2, 2)]) - 1.0)
TOUCH = 0.005  # height of a corner that touches [m]; it falls 10 mm from sample to sample
LEVER = 0.5  # cube widths for a radian, in the error that is fitted
BOUNDS = {"restitution": (0.0, 0.6), "friction": (0.05, 0.6), "push_out": (0.02, 1.0)}
TRIED = {"restitution": (0.0, 0.25, 0.5), "friction": (0.1, 0.25, 0.5, 1.0)}  # others as measured
TIMES = (0.0, 0.1, 0.2, 0.4)  # after the first touch [s]
FITTED = {"mujoco": tuple(BOUNDS), "physx": ("restitution", "friction"), "drake": ("friction",)}


def load(folder: Path, *, is_raw: bool) -> list[np.ndarray]:
    """Return tosses: rows of position [m], quaternion, speed [m/s] and angular speed in the body [rad/s]."""
    files = sorted(folder.glob("*.pt"), key=lambda file: int(file.stem))
    tosses = [torch.load(file, weights_only=True)[0, :, :13].numpy() for file in files]
    rest_height = 1.0 if is_raw else float(np.mean([toss[-1, 2] for toss in tosses]))
    for toss in tosses:
        toss[:, [0, 1, 2, 7, 8, 9]] *= HALF / rest_height
    return tosses


def make_model(hz: float, restitution: float, friction: float, push_out: float) -> mujoco.MjModel:
    """Return the package's scene with the cube as the thrown object, without robots and table."""
    cube = make_object("tossed_cube", box(*(2.0 * HALF,) * 3), mass=MASS)
    OBJECTS["tossed_cube"] = replace(cube, inertia=np.full(3, INERTIA))
    scene = SceneCfg(physics_hz=hz, object_friction=friction)
    spec = build_spec(scene, "tossed_cube")
    roots = [each.prefix + each.robot.root for each in find_workcell(scene.workcell).robots]
    for element in (*spec.sensors, *spec.actuators, *spec.excludes, *map(spec.body, (*roots, "table"))):
        spec.delete(element)
    model = spec.compile()
    is_cube = model.geom_bodyid == model.body("object").id
    model.geom_solref[is_cube] = contact_solref(restitution, model.opt.timestep, push_out)
    return model


def marks(pose: np.ndarray) -> tuple[int, dict[str, float]]:
    """Return the sample of the first touch; rebound, bounce and slide."""
    heights = pose[:, 2:3] + np.array([rotation_matrix(quat)[2] for quat in pose[:, 3:7]]) @ CORNERS.T
    touch = max(int(np.argmax(heights.min(axis=1) < TOUCH)), 2)
    way = np.diff(heights[:, int(heights[touch].argmin())])
    bounce, slide = heights[touch + 1 :].min(axis=1).max(), np.linalg.norm(pose[-1, :2] - pose[touch, :2])
    found = {"rebound": -way[touch + 1] / way[touch - 2], "bounce": 1e3 * bounce, "slide": 1e3 * slide}
    return touch, {name: float(value) for name, value in found.items()}


def compare(toss: np.ndarray, pose: np.ndarray) -> dict[str, float]:
    """Return the measures of a toss, simulated and recorded."""
    distance = 50.0 * np.linalg.norm(toss[:, :3] - pose[:, :3], axis=1) / HALF
    angle = 2.0 * np.arccos(np.abs((toss[:, 3:7] * pose[:, 3:]).sum(axis=1)).clip(max=1.0))
    touch, recorded = marks(toss)
    row = {"position": distance.mean(), "angle": np.degrees(angle.mean())}
    row |= {f"at {t} s": distance[min(touch + round(t / DATA_DT), len(toss) - 1)] for t in TIMES}
    row["fitted"] = distance.mean() / 100.0 + LEVER * angle.mean()
    return row | marks(pose)[1] | {f"recorded {name}": value for name, value in recorded.items()}


def judge(engine: str, hz: float, params: dict[str, float], tosses: list[np.ndarray]) -> dict[str, list]:
    """Return the measures of all tosses, simulated from their first samples."""
    model, copies, rows = make_model(hz, **params), {"physx": PhysxCopy, "drake": DrakeCopy}, []
    copy, dt = copies[engine](rigid_world(model)) if engine in copies else None, model.opt.timestep
    for toss in tosses:
        state = toss[0].copy()
        state[9] -= 0.5 * GRAVITY * (DATA_DT - dt)  # a backward difference over `dt`, as MuJoCo's
        path = np.tile(state[:7], (int(len(toss) * DATA_DT / dt) + 2, 1))
        if copy is None:
            start = np.append(0.0, state)
            path[1:] = rollout.rollout(model, mujoco.MjData(model), start, nstep=len(path) - 1)[0][0, :, 1:8]
        else:
            copy.set_state(state[:7], state[7:])
            for row in path[1:]:
                copy.step(np.empty(0), np.zeros(6), np.zeros((model.nbody, 6)))
                copy.read_state(row, np.empty(6))
        steps = np.arange(len(toss)) * DATA_DT / dt
        before, after, share = path[steps.astype(int)], path[steps.astype(int) + 1], (steps % 1.0)[:, None]
        after[:, 3:] *= np.sign((before[:, 3:] * after[:, 3:]).sum(axis=1, keepdims=True))
        pose = (1.0 - share) * before + share * after
        pose[:, 3:] /= np.linalg.norm(pose[:, 3:], axis=1, keepdims=True)
        rows.append(compare(toss, pose))
    return {name: [row[name] for row in rows] for name in rows[0]}


def main(
    folder: Positional[Path],
    out: Path,
    engine: Literal["mujoco", "physx", "drake"] = "mujoco",
    hz: float = 240.0,
    draws: int = 60,
    every: int = 1,
    raw: bool = False,
) -> None:
    """Fit on two thirds of the tosses; write and print what the others show."""
    tosses, rng, least = load(folder, is_raw=raw), np.random.default_rng(0), np.inf
    others, held_out = [t for i, t in enumerate(tosses) if i % 3][::every], tosses[:: 3 * every]
    best = measured = MEASURED if engine != "drake" else MEASURED | {"restitution": 0.0}
    for draw in range(draws):  # the start, then half of them anywhere, half near the best
        params = dict(best)
        for name in FITTED[engine] if draw else ():
            near = best[name] + 0.2 * (1.0 - draw / draws) * np.ptp(BOUNDS[name]) * rng.normal()
            value = near if 2 * draw > draws else rng.uniform(*BOUNDS[name])
            params[name] = float(np.clip(value, *BOUNDS[name]))
        error = np.mean(judge(engine, hz, params, others)["fitted"])
        best, least = (params, error) if error < least else (best, least)
    cells, rows = {"measured": measured, "fitted": best}, list[dict[str, object]]()
    cells |= {f"{name} {x}": measured | {name: x} for name in FITTED[engine][:2] for x in TRIED[name]}
    for name, params in cells.items():
        found = judge(engine, hz, params, held_out)
        shown = {key: [round(float(v), 3) for v in (np.mean(x), np.std(x))] for key, x in found.items()}
        rows.append({"parameters": name, **params, "tosses": len(held_out), **shown})
        print(json.dumps(rows[-1]))
    result = {"engine": engine, "hz": hz, "raw": raw, "rows": rows}
    out.write_text(json.dumps(result | {"circumstances": circumstances()}))


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
