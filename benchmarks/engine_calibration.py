"""Is it the policy or the engine? What each engine does to one and the same model before a policy is judged.

* flight: an L-shaped block spins freely for 0.8 s: its way against the parabola of semi-implicit steps, and
  how much its angular momentum changed.
* motion: all joints of the arm, or of the hand, get a step and a sine of 0.1 rad: the largest difference from
  MuJoCo's joint positions at 600 Hz.
* rebound: a ball and a cube hit the floor at 1 and 4 m/s, or at 2 m/s and as fast along it, impacts spread
  evenly over a step: mean and deviation of the speed after over the speed before, upwards.
* roll: a ball meets the floor at 2 m/s and as fast along it, with friction 1: mean and deviation of its spin
  over that with which it rolls, as it must by Coulomb's law.
* rest: how deep a cube lies in the floor after 0.5 s, and how fast it creeps on a slope of 20°.
* slide: the way of a cube at 1 m/s over v² / (2 mu g).
* hop: how fast a cube rises that is put on the floor with 1 m/s along it; by Coulomb's law it does not.
* grip: a cube lies in the hand, which closes; how often a pull of three times its weight leaves it there, and
  the deepest overlap with the hand.

Run: python benchmarks/engine_calibration.py
"""

import math
import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from itertools import product

import numpy as np
import torch
import tyro
from torch import Tensor

from pixel2catch.reports import markdown
from pixel2catch.robots.allegro import HAND
from pixel2catch.robots.ur5e import ARM
from pixel2catch.scene.objects import OBJECTS
from pixel2catch.scene.scene import SceneCfg, build_model, object_table
from pixel2catch.sim.batch import BatchSimulation
from pixel2catch.sim.drake import DrakeCopy
from pixel2catch.sim.engine import EngineCopy, EngineSimulation
from pixel2catch.sim.physx import PhysxCopy
from pixel2catch.sim.rigid_world import RigidWorld
from pixel2catch.sim.simulation import Simulation

HOME = torch.tensor([joint.home for joint in (*ARM.joints, *HAND.joints)], dtype=torch.float64)
ARM_JOINTS, HAND_JOINTS = slice(0, len(ARM.joints)), slice(len(ARM.joints), len(HOME))
ALL_JOINTS = slice(0, len(HOME))
GRAVITY = 9.81
ASIDE = (2.0, 1.0)  # a place on the floor that the robot does not reach
PALM_NORMAL = (0.20791, 0.0, 0.97815)
GRIP_SPOT = (0.4787, 0.1333, 1.4293)  # 45 mm over the palm, 30 mm from its middle towards the fingers
GRIP = (*(1.2,) * 9, 0.0, 0.0, 0.5, 0.5)  # how far the fingers and the thumb close [rad]
SPREAD = 0.006  # sideways, either way [m]
PULL = 2.0  # three times the cube's weight [N]
HELD_DISTANCE = 0.1  # from the palm [m]
NUM_PHASES = 8  # impacts within a step

TABLE = object_table(SceneCfg())
BODY = TABLE.indices.body


@dataclass(frozen=True, kw_only=True)
class Engine:
    """An engine with its settings at a rate."""

    name: str
    hz: float = 600.0
    make_copy: Callable[[RigidWorld], EngineCopy] | None = None  # MuJoCo without

    def make(
        self,
        object_name: str = "cube_s",
        num_envs: int = 1,
        *,
        restitution: float = 0.0,
        friction: float = 1.0,
    ) -> Simulation:
        """Copies of the robot at its start with one object."""
        scene = SceneCfg(physics_hz=self.hz, object_restitution=restitution, object_friction=friction)
        model = build_model(scene, object_name)
        model.dof_frictionloss[ALL_JOINTS] = 0.0
        if self.make_copy is None:
            made: Simulation = BatchSimulation(model, num_envs, 1)
        else:
            made = EngineSimulation(model, num_envs, self.make_copy)
        made.bind("qpos")[:, ALL_JOINTS] = HOME
        made.bind("ctrl")[:] = HOME
        place(made, (*ASIDE, 1.0))
        return made


def place(
    simulation: Simulation, pos: tuple[float, ...] | Tensor, vel: tuple[float, ...] = (0.0,) * 6
) -> None:
    """The objects upright, at one position or at one each, with linear and angular speed."""
    pose = torch.zeros(simulation.num_envs, 7, dtype=torch.float64)
    pose[:, :3], pose[:, 3] = torch.as_tensor(pos), 1.0
    simulation.bind("qpos")[:, TABLE.indices.qpos] = pose
    simulation.bind("qvel")[:, TABLE.indices.dofs] = torch.tensor(vel, dtype=torch.float64)
    simulation.forward()


def half_height(name: str) -> float:
    """How high an upright object's centre is over what it lies on [m]."""
    return -min(float(part.vertices[:, 2].min()) for part in OBJECTS[name].parts)


def flight(engine: Engine, duration: float = 0.8) -> tuple[float, float]:
    """Largest distance from the parabola [mm]; change of the angular momentum over its size."""
    simulation = engine.make("l_block")
    start, velocity, spin = np.array((*ASIDE, 1.0)), np.array((-3.0, 0.3, 4.0)), (4.0, 6.0, 8.0)
    place(simulation, tuple(start), (*velocity, *spin))
    row, steps, dt = TABLE.names.index("l_block"), round(duration * engine.hz), 1.0 / engine.hz
    inertia = np.diag(TABLE.fields["body_inertia"][row, 0])

    def momentum() -> np.ndarray:
        rotation = simulation.bind("xmat")[0, BODY].numpy().reshape(3, 3)
        return rotation @ inertia @ simulation.bind("qvel")[0, TABLE.indices.dofs].numpy()[3:]

    before, distance = momentum(), 0.0
    for step in range(1, steps + 1):
        simulation.step()
        expected = start + velocity * step * dt
        expected[2] -= 0.5 * GRAVITY * step * (step + 1) * dt**2
        distance = max(distance, float(np.abs(simulation.bind("xpos")[0, BODY].numpy() - expected).max()))
    return 1e3 * distance, float(np.linalg.norm(momentum() - before) / np.linalg.norm(before))


def joint_path(engine: Engine, joints: slice, command: Callable[[float], float], duration: float) -> Tensor:
    """Positions of the joints at every control step [rad], while a command of time is added to the start."""
    simulation = engine.make()
    path = []
    for step in range(round(duration * engine.hz)):
        target = HOME.clone()
        target[joints] += command(step / engine.hz)
        simulation.bind("ctrl")[:] = target
        simulation.step()
        if (step + 1) % round(engine.hz / 30.0) == 0:
            path.append(simulation.bind("qpos")[0, ALL_JOINTS].clone())
    return torch.stack(path)


COMMANDS: dict[str, Callable[[float], float]] = {
    "step": lambda _: 0.1,
    "sine": lambda time: 0.1 * math.sin(2.0 * math.pi * time),
}


def motion(engine: Engine, joints: slice, command: str, duration: float = 1.2) -> float:
    """Largest difference from MuJoCo's path [mrad]."""
    paths = [
        joint_path(each, joints, COMMANDS[command], duration) for each in (engine, Engine(name="mujoco"))
    ]
    return 1e3 * float((paths[0] - paths[1]).abs().max())


def impact(engine: Engine, object_name: str, speed: float, restitution: float, along: float) -> Tensor:
    """Velocities (step, phase, 6) of objects that meet the floor with friction 1, spread over a step."""
    simulation = engine.make(object_name, NUM_PHASES, restitution=restitution)
    pos = torch.tensor((*ASIDE, half_height(object_name) + 0.03)).repeat(NUM_PHASES, 1)
    pos[:, 2] += torch.arange(NUM_PHASES) / NUM_PHASES * speed / engine.hz
    place(simulation, pos, (along, 0.0, -speed, 0.0, 0.0, 0.0))
    velocities = []
    for _ in range(round(engine.hz * (0.06 / speed + 0.03))):
        simulation.step()
        velocities.append(simulation.bind("qvel")[:, TABLE.indices.dofs].clone())
    return torch.stack(velocities)


def rebound(
    engine: Engine, object_name: str, speed: float, restitution: float, along: float = 0.0
) -> tuple[float, float]:
    """Mean and deviation of the speed after over the speed before an impact, `along` the floor left out."""
    seen = impact(engine, object_name, speed, restitution, along)[:, :, 2]
    ratio = -seen.amax(dim=0) / seen.amin(dim=0)
    return float(ratio.mean()), float(ratio.std())


def roll(engine: Engine, restitution: float, speed: float = 2.0) -> tuple[float, float]:
    """Mean and deviation of a ball's spin after an oblique impact over that of rolling.

    An impulse m v / (1 + m r² / I) along the floor ends the slip, less than mu m (1 + e) v, and leaves the
    angular speed v / (r + I / (m r)).
    """
    ball, radius = OBJECTS["sphere_l"], half_height("sphere_l")
    spin = impact(engine, "sphere_l", speed, restitution, speed)[:, :, 3:].norm(dim=2).amax(dim=0)
    ratio = spin * (radius + ball.inertia[1] / (ball.mass * radius)) / speed
    return float(ratio.mean()), float(ratio.std())


def resting_depth(engine: Engine) -> float:
    """How deep a cube lies in the floor after half a second [µm]."""
    simulation = engine.make()
    height = half_height("cube_s")
    place(simulation, (*ASIDE, height))
    for _ in range(round(0.5 * engine.hz)):
        simulation.step()
    return 1e6 * (height - float(simulation.bind("xpos")[0, BODY, 2]))


def slide(engine: Engine, friction: float, speed: float = 1.0) -> float:
    """The way of a cube on the floor over that of Coulomb's friction."""
    simulation = engine.make(friction=friction, restitution=0.0)
    place(simulation, (*ASIDE, half_height("cube_s")), (speed, 0.0, 0.0, 0.0, 0.0, 0.0))
    expected = speed**2 / (2.0 * friction * GRAVITY)
    for _ in range(round((speed / (friction * GRAVITY) + 0.1) * engine.hz)):
        simulation.step()
    return (float(simulation.bind("xpos")[0, BODY, 0]) - ASIDE[0]) / expected


def hop(engine: Engine, friction: float, speed: float = 1.0) -> float:
    """Largest speed upwards [m/s] of a cube that begins to slide on the floor."""
    simulation = engine.make(friction=friction, restitution=0.0)
    place(simulation, (*ASIDE, half_height("cube_s")), (speed, 0.0, 0.0, 0.0, 0.0, 0.0))
    fastest = 0.0
    for _ in range(round(0.05 * engine.hz)):
        simulation.step()
        fastest = max(fastest, float(simulation.bind("qvel")[0, TABLE.indices.dofs][2]))
    return fastest


def creep(engine: Engine) -> float:
    """Speed of a cube that friction 1 holds on a slope of 20° [mm/s]: its weight pulls along the floor."""
    simulation = engine.make(restitution=0.0)
    place(simulation, (*ASIDE, half_height("cube_s")))
    pull = float(simulation.model.body_mass[BODY]) * GRAVITY * math.tan(math.radians(20.0))
    simulation.bind("xfrc_applied")[:, BODY, 0] = pull
    positions = []
    for _ in range(2):
        for _ in range(round(0.5 * engine.hz)):
            simulation.step()
        positions.append(float(simulation.bind("xpos")[0, BODY, 0]))
    return 1e3 * (positions[1] - positions[0]) / 0.5


def grip(engine: Engine, num_envs: int = 8) -> tuple[float, float]:
    """Share of cubes in the closed hand that a pull away from the palm leaves there for a second.

    Then their deepest overlap with anything [mm].
    """
    simulation = engine.make("cube_l", num_envs, restitution=0.0)
    normal = torch.tensor(PALM_NORMAL, dtype=torch.float64)
    shifts = torch.linspace(-SPREAD, SPREAD, num_envs, dtype=torch.float64)[:, None]
    place(simulation, torch.tensor(GRIP_SPOT, dtype=torch.float64) + shifts * torch.tensor((0.0, 1.0, 0.0)))
    closed = torch.tensor(GRIP, dtype=torch.float64)
    touch, deepest = int(simulation.model.sensor("object_any").adr[0]), 0.0
    for step in range(round(1.8 * engine.hz)):
        time = step / engine.hz
        simulation.bind("ctrl")[:, HAND_JOINTS] = HOME[HAND_JOINTS] + min(2.0 * time, 1.0) * closed
        simulation.bind("xfrc_applied")[:, BODY, :3] = (PULL if time > 0.8 else 0.0) * normal
        simulation.step()
        deepest = max(deepest, -float(simulation.bind("sensordata")[:, touch + 1].min()))
    palm = simulation.bind("site_xpos")[:, simulation.model.site("palm").id]
    distance = (simulation.bind("xpos")[:, BODY] - palm).norm(dim=1)
    return float((distance < HELD_DISTANCE).double().mean()), 1e3 * deepest


RATES = (600.0, 660.0, 1200.0)
RESTITUTIONS = (0.0, 0.1, 0.25, 0.5)


mujoco, physx = partial(Engine, name="mujoco"), partial(Engine, name="physx", make_copy=PhysxCopy)
drake = partial(Engine, name="drake", make_copy=DrakeCopy)
ENGINES = [make(hz=hz) for make in (mujoco, physx, drake) for hz in RATES]


def main(only: str = "") -> None:
    """Print the tables, of engines whose names begin with `only`."""
    laws, rebounds = list[dict[str, str]](), list[dict[str, str]]()
    for each in (each for each in ENGINES if each.name.startswith(only)):
        of_engine = {"engine": each.name, "Hz": f"{each.hz:g}"}
        is_inelastic, (way, change), (held, deepest) = each.make_copy is DrakeCopy, flight(each), grip(each)
        law = of_engine | {"flight mm": f"{way:.2f}", "momentum": f"{change:.3f}"}
        for part, joints in (("arm", ARM_JOINTS), ("hand", HAND_JOINTS)):
            law[f"{part} step, sine mrad"] = ", ".join(f"{motion(each, joints, n):.2f}" for n in COMMANDS)
        law["rest µm"] = f"{resting_depth(each):.0f}"
        law["slide 0.5, 1"] = f"{slide(each, 0.5):.2f}, {slide(each, 1.0):.2f}"
        law["hop 0.5, 1"] = f"{hop(each, 0.5):.2f}, {hop(each, 1.0):.2f}"
        rolled = [roll(each, e) for e in ((0.0,) if is_inelastic else (0.0, 0.25))]
        law["roll 0, 0.25"] = ", ".join(f"{mean:.2f} ± {deviation:.2f}" for mean, deviation in rolled)
        law |= {"creep mm/s": f"{creep(each):.2f}", "grip %, mm": f"{100 * held:.0f}, {deepest:.1f}"}
        laws.append(law)
        for name, (speed, along) in product(("sphere_l", "cube_l"), ((1.0, 0.0), (4.0, 0.0), (2.0, 2.0))):
            row = of_engine | {"object, m/s down, along": f"{name}, {speed:g}, {along:g}"}
            for e in RESTITUTIONS[:1] if is_inelastic else RESTITUTIONS:
                row[f"e = {e:g}"] = "{:.2f} ± {:.2f}".format(*rebound(each, name, speed, e, along))
            rebounds.append(row)
        print(f"{each.name}, {each.hz:g} Hz: done", file=sys.stderr)
    print(markdown(laws), markdown(rebounds), sep="\n", end="")


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
