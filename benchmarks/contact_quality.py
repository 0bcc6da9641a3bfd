"""How good is the object's contact: restitution, penetration and step cost for time steps, integrators and
flags.

Two experiments for every setting:

* drop: a sphere falls 0.4 m on the table and on the palm; the speeds before and after the first impact give
  the restitution. Drops differ in height by less than a step's travel, so that impacts fall anywhere within a
  step.
* throw: a 5 cm cube hits the open palm and fingers at 4.5 m/s, turned and shifted at random; the deepest
  contact over all physics steps of 0.15 s is its penetration. A throw tunnels when the cube is behind the
  hand at the end although it touched it in front.

Run: python benchmarks/contact_quality.py
"""

import argparse
import time
from dataclasses import dataclass

import mujoco
import numpy as np
from mujoco.batch import Batch

from pixel2catch.robots.allegro import HAND
from pixel2catch.robots.ur5e import ARM
from pixel2catch.scene.cfg import contact_solref
from pixel2catch.scene.scene import SceneCfg, build_model

RESTITUTIONS = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5)
HOME = np.array([joint.home for joint in (*ARM.joints, *HAND.joints)])
GRAVITY = 9.81


@dataclass(frozen=True)
class Setting:
    """One row of the table."""

    rate: int
    integrator: str
    speculative: bool

    def model(self, object_name: str) -> mujoco.MjModel:
        """The scene with these options."""
        model = build_model(SceneCfg(physics_hz=self.rate), object_name)
        model.opt.integrator = getattr(mujoco.mjtIntegrator, f"mjINT_{self.integrator.upper()}")
        if self.speculative:
            model.opt.enableflags |= mujoco.mjtEnableBit.mjENBL_SPECULATIVE
        return model


def set_restitution(model: mujoco.MjModel, restitution: float) -> None:
    """Write the contact parameters of the object."""
    is_part = model.geom_bodyid == model.body("object").id
    model.geom_solref[is_part] = contact_solref(restitution, model.opt.timestep)


def start(batch: Batch, pos: np.ndarray, quat: np.ndarray, vel: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Put the robot in its start pose and the object somewhere; return live positions and velocities."""
    qpos, qvel, ctrl = batch.bind("qpos"), batch.bind("qvel"), batch.bind("ctrl")
    qpos[:, :19], ctrl[:] = HOME, HOME
    qpos[:, 19:22], qpos[:, 22:26] = pos, quat
    qvel[:], qvel[:, 19:22] = 0.0, vel
    return qpos, qvel


def drop(setting: Setting, restitution: float, on: str, num_drops: int = 24) -> tuple[float, float]:
    """Mean and largest error of the restitution."""
    model = setting.model("sphere_l")
    set_restitution(model, restitution)
    surface = (-0.25, 0.2, 0.81) if on == "table" else (0.44, 0.1333, 1.3915)
    heights = 0.4 + np.linspace(0.0, 2.8 / setting.rate, num_drops, endpoint=False)
    pos = np.tile(surface, (num_drops, 1)).astype(float)
    pos[:, 2] += 0.04 + heights
    batch = Batch(model, num_drops, 2)
    _, qvel = start(batch, pos, np.array((1.0, 0, 0, 0)), np.zeros(3))
    lowest, highest = np.zeros(num_drops), np.full(num_drops, -np.inf)
    normal = np.array((0.0, 0, 1)) if on == "table" else np.array((0.20791, 0, 0.97815))
    is_hit = np.zeros(num_drops, dtype=bool)
    for _ in range(int(0.36 * setting.rate)):
        batch.step()
        speed = qvel[:, 19:22] @ normal
        lowest = np.minimum(lowest, speed)
        is_hit |= speed > lowest + 0.5
        highest = np.where(is_hit, np.maximum(highest, speed), highest)
    error = np.where(is_hit, highest, 0.0) / -lowest - restitution
    return float(error.mean()), float(np.abs(error).max())


def throw(setting: Setting, num_throws: int) -> dict[str, float]:
    """Penetration [mm], share of tunnelled throws and cost of a step [µs]."""
    model = setting.model("cube_s")
    set_restitution(model, 0.25)
    rng = np.random.default_rng(0)
    target = np.array((0.48, 0.1333, 1.39)) + rng.uniform((-0.05, -0.05, 0), (0.1, 0.05, 0), (num_throws, 3))
    direction = rng.normal((-0.6, 0.0, -1.0), 0.2, (num_throws, 3))
    vel = 4.5 * direction / np.linalg.norm(direction, axis=1, keepdims=True)
    pos = target - vel * rng.uniform(0.04, 0.05, (num_throws, 1))
    quat = rng.normal(size=(num_throws, 4))
    batch = Batch(model, num_throws, 2)
    qpos, _ = start(batch, pos, quat / np.linalg.norm(quat, axis=1, keepdims=True), vel)
    sensors = batch.bind("sensordata")
    adr = model.sensor("object_any").adr[0]
    depth, num_steps = [], int(0.15 * setting.rate)
    begin = time.perf_counter()
    for _ in range(num_steps):
        batch.step()
        depth.append(np.where(sensors[:, adr] > 0, -sensors[:, adr + 1], 0.0).clip(min=0.0))
    cost = (time.perf_counter() - begin) / num_steps / num_throws
    depths = 1e3 * np.array(depth)
    worst = depths.max(axis=0)
    settled = depths[int(0.12 * setting.rate) :].max(axis=0)
    palm = np.array((0.434, 0.1333, 1.391))
    is_behind = (qpos[:, 19:22] - palm) @ np.array((0.208, 0, 0.978)) < -0.01
    return {
        "hit": float((worst > 0).mean()),
        "mean": float(worst[worst > 0].mean()),
        "p95": float(np.percentile(worst[worst > 0], 95)),
        "worst": float(worst.max()),
        "settled": float(settled.max()),
        "tunnel": float((is_behind & (worst > 0)).mean()),
        "us": 1e6 * cost,
    }


def main() -> None:
    """Print one line per setting."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rates", type=int, nargs="+", default=[120, 240, 480])
    parser.add_argument("--integrators", nargs="+", default=["implicitfast", "discrete"])
    parser.add_argument("--throws", type=int, default=512)
    args = parser.parse_args()
    print("restitution error: mean over phases (largest) for e = " + ", ".join(map(str, RESTITUTIONS)))
    for integrator in args.integrators:
        for speculative in (False, True):
            for rate in args.rates:
                setting = Setting(rate, integrator, speculative)
                name = f"{integrator:12s} {'speculative' if speculative else '           '} {rate:4d} Hz"
                for on in ("table", "palm"):
                    errors = [drop(setting, e, on) for e in RESTITUTIONS]
                    print(name, f"{on:5s}", " ".join(f"{mean:+.2f} ({worst:.2f})" for mean, worst in errors))
                result = throw(setting, args.throws)
                print(
                    name, "throw", " ".join(f"{key} {value:.2f}" for key, value in result.items()), flush=True
                )


if __name__ == "__main__":
    main()
