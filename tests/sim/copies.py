"""Set-ups for the contract test: four copies of the scene, each with an object of its own."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from paper_robot import JOINTS
from pixel2catch.envs.world import MASS_POWER
from pixel2catch.scene.scene import ObjectTable, SceneCfg, build_model, object_table
from pixel2catch.sim.factory import make_simulation
from pixel2catch.sim.simulation import Simulation
from pixel2catch.sim.warp import WarpSimulation

NUM_ENVS = 4
NUM_JOINTS = len(JOINTS)
HOME = torch.tensor([joint.home for joint in JOINTS], dtype=torch.float64)
IN_THE_AIR = (1.5, 0.0, 1.5)
ON_TABLE = (-0.25, 0.2, 0.81)
ON_FLOOR = (1.5, 0.0, 0.0)
SCENE = SceneCfg()
TABLE: ObjectTable = object_table(SCENE)
BODY = TABLE.indices.body
CONTACT_FIELDS = ("geom_friction", "geom_solref")
GAIN_FIELDS = ("actuator_gainprm", "actuator_biasprm")
STATE = ("qpos", "qvel", "ctrl", "qacc_warmstart", "xfrc_applied", "qfrc_applied")


def object_fields(simulation: Simulation) -> list[str]:
    """Model fields that depend on the object and that the back end has."""
    return [name for name in TABLE.fields if simulation.can_expand(name)]


def changed_fields(simulation: Simulation) -> list[str]:
    """Every model field that differs between environments."""
    return [*object_fields(simulation), *CONTACT_FIELDS, *GAIN_FIELDS]


def make(backend: str, num_envs: int = NUM_ENVS) -> Simulation:
    """One of the back ends, on the model as the catching environment uses it."""
    model = build_model(replace(SCENE, object_restitution=0.0) if backend == "drake" else SCENE)
    model.dof_frictionloss[:NUM_JOINTS] = 0.0
    if backend == "warp":
        return WarpSimulation(model, num_envs, "cpu")
    return make_simulation(model, num_envs, "cpu", "mujoco" if backend == "batch" else backend)


def restart(simulation: Simulation) -> None:
    """The robot at its start, a cube hovering in the air, every model field as compiled."""
    for name in changed_fields(simulation):
        field = simulation.expand(name)
        default = torch.as_tensor(np.array(getattr(simulation.model, name)))
        field.copy_(default.view(field.shape[1:]).expand_as(field))
    for name in STATE:
        simulation.bind(name).zero_()
    simulation.bind("qpos")[:, :NUM_JOINTS] = HOME.to(simulation.dtype)
    simulation.bind("ctrl")[:] = HOME.to(simulation.dtype)
    place(simulation, IN_THE_AIR)


def place(simulation: Simulation, pos: Sequence[float] | Tensor) -> None:
    """The objects upright and at rest, at one position or at one each."""
    pose = torch.zeros(simulation.num_envs, 7, dtype=simulation.dtype)
    pose[:, :3] = torch.as_tensor(pos)
    pose[:, 3] = 1.0
    simulation.bind("qpos")[:, TABLE.indices.qpos] = pose
    simulation.bind("qvel")[:, TABLE.indices.dofs] = 0.0
    simulation.forward()


def give(
    simulation: Simulation, names: Sequence[str], mass_scale: Sequence[float] = (1.0,) * NUM_ENVS
) -> None:
    """Another object for each copy, with everything that depends on its mass."""
    scale = torch.tensor(mass_scale)
    chosen = [TABLE.names.index(name) for name in names]
    for name in object_fields(simulation):
        rows = torch.as_tensor(TABLE.fields[name][chosen])
        if name in MASS_POWER:
            rows = rows * (scale ** MASS_POWER[name]).view(-1, *(1,) * (rows.ndim - 1))
        field = simulation.expand(name)[:, TABLE.indices.rows(name)]
        field.copy_(rows.to(field.dtype).view(field.shape))
    simulation.forward()


def set_contact(simulation: Simulation, name: str, values: Tensor) -> None:
    """Leading numbers of `geom_friction` or `geom_solref` of the objects, one row for each copy."""
    field = simulation.expand(name)[:, TABLE.indices.geoms, : values.shape[1]]
    field.copy_(values[:, None].to(field.dtype).expand_as(field))


def push(simulation: Simulation, velocity: Sequence[float]) -> None:
    simulation.bind("qvel")[:, TABLE.indices.dofs] = torch.tensor(velocity, dtype=simulation.dtype)
    simulation.forward()


def run(simulation: Simulation, num_steps: int) -> None:
    for _ in range(num_steps):
        simulation.step()


def object_pos(simulation: Simulation) -> Tensor:
    """Positions of the objects (num_envs, 3) [m], float64."""
    return simulation.bind("xpos")[:, BODY].double()


def object_vel(simulation: Simulation) -> Tensor:
    """Linear and angular velocities of the objects (num_envs, 6), float64."""
    return simulation.bind("qvel")[:, TABLE.indices.dofs].double()
