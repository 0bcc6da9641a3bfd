"""Differences between the package's model of a robot and makers' models: axes, tips, masses, surfaces.

python benchmarks/maker_difference.py ur5e.urdf allegro_left.urdf
"""

import sys

import mujoco
import numpy as np
from jaxtyping import Float
from numpy import ndarray

from pixel2catch.reports import markdown
from pixel2catch.robots.maker import Surface, add_maker_bodies, maker_parts
from pixel2catch.robots.poses import rotation_matrix, sphere_points
from pixel2catch.robots.workcell import WorkcellSpec, add_robots
from pixel2catch.workcells import find_workcell

NUM_POSES = 200  #: Compared joint positions, drawn within the limits.
NUM_DIRECTIONS = 2000  #: Directions in which surfaces are compared, 2 to 3° apart.

Rows = list[dict[str, str]]


def differences(workcell: WorkcellSpec, files: tuple[str, ...], surface: Surface) -> tuple[Rows, Rows]:
    """Return rows of differences of the whole robot, and of every body of the makers' models."""
    ours, theirs = _robots(workcell), _robots(workcell, files, surface)
    parts = maker_parts(workcell, files, surface)
    whole = [
        {
            "what": f"axes of {name}, at most",
            "difference": f"{1e3 * p.distance:.2f} mm, {1e3 * p.angle:.2f} mrad",
        }
        for (_, name), p in parts.items()
    ]
    low, high = np.array([(joint.lower, joint.upper) for joint in workcell.joints]).T
    positions = np.random.default_rng(0).uniform(low, high, (NUM_POSES, len(low)))
    worst = np.max([_at(ours, theirs, pos) for pos in positions], axis=0)
    names = ("places of tips and palms", "their directions", "gravity torques", "inertias of joints")
    units, scales = ("mm", "mrad", "N·m", "%"), (1e3, 1e3, 1.0, 100.0)
    whole += [
        {"what": f"{name}, at most", "difference": f"{scale * value:.2f} {unit}"}
        for name, unit, scale, value in zip(names, units, scales, worst, strict=True)
    ]
    bodies = [prefix + body for (prefix, _), part in parts.items() for body in part.bodies]
    return whole, [_body(ours, theirs, name) for name in bodies]


def _robots(
    workcell: WorkcellSpec, files: tuple[str, ...] = (), surface: Surface = "collision"
) -> mujoco.MjModel:
    spec = mujoco.MjSpec()
    add_robots(spec, workcell, visuals=False)
    if files:
        add_maker_bodies(spec, workcell, files, surface)
    model = spec.compile()
    model.body_gravcomp[:] = 0.0
    return model


def _at(
    ours: mujoco.MjModel, theirs: mujoco.MjModel, joint_pos: Float[ndarray, " num_joints"]
) -> tuple[float, float, float, float]:
    """Return the largest differences of sites [m, rad], torques [N·m] and relative joint inertias."""
    found = []
    for model in (ours, theirs):
        data = mujoco.MjData(model)
        data.qpos[:] = joint_pos
        mujoco.mj_forward(model, data)
        inertia = np.zeros((model.nv, model.nv))
        mujoco.mj_fullM(model, data, inertia)
        found.append((data.site_xpos, data.site_xmat.reshape(-1, 3, 3), data.qfrc_bias, np.diag(inertia)))
    places, turns, torques, inertias = zip(*found, strict=True)
    cosines = (np.einsum("nij,nij->n", *turns) - 1.0) / 2.0
    return (
        float(np.linalg.norm(places[0] - places[1], axis=1).max()),
        float(np.arccos(np.clip(cosines, -1.0, 1.0)).max()),
        float(np.abs(torques[0] - torques[1]).max()),
        float(np.abs(inertias[0] / inertias[1] - 1.0).max()),
    )


def _body(ours: mujoco.MjModel, theirs: mujoco.MjModel, name: str) -> dict[str, str]:
    ids = [model.body(name).id for model in (ours, theirs)]
    masses = [1e3 * model.body_mass[i] for model, i in zip((ours, theirs), ids, strict=True)]
    away = np.linalg.norm(ours.body_ipos[ids[0]] - theirs.body_ipos[ids[1]])
    reaches = [reach(model, i) for model, i in zip((ours, theirs), ids, strict=True)]
    row = {"body": name, "mass, ours [g]": f"{masses[0]:.1f}", "maker's [g]": f"{masses[1]:.1f}"}
    row["centre [mm]"] = f"{1e3 * away:.1f}"
    gap = 1e3 * np.abs(reaches[0] - reaches[1])
    return row | {"surface, mean [mm]": f"{gap.mean():.1f}", "at most [mm]": f"{gap.max():.1f}"}


def reach(model: mujoco.MjModel, body: int) -> Float[ndarray, " num_directions"]:
    """Return how far the shapes of a body reach in each direction of its frame [m]; NaN without shapes.

    The largest difference between two bodies is the Hausdorff distance of their convex hulls.
    """
    ways = sphere_points(NUM_DIRECTIONS)
    found = []
    for geom in np.flatnonzero((model.geom_bodyid == body) & (model.geom_contype != 0)).tolist():
        turned = ways @ rotation_matrix(model.geom_quat[geom])
        found.append(ways @ model.geom_pos[geom] + _support(model, geom, turned))
    return np.max(found, axis=0) if found else np.full(len(ways), np.nan)


def _support(model: mujoco.MjModel, geom: int, ways: Float[ndarray, "some 3"]) -> Float[ndarray, " some"]:
    """Return how far a shape reaches from its centre, in directions of its own frame [m]."""
    kinds, (a, b, _) = mujoco.mjtGeom, model.geom_size[geom]
    flat, up = np.hypot(ways[:, 0], ways[:, 1]), np.abs(ways[:, 2])
    match mujoco.mjtGeom(model.geom_type[geom]):
        case kinds.mjGEOM_MESH:
            first = model.mesh_vertadr[model.geom_dataid[geom]]
            count = model.mesh_vertnum[model.geom_dataid[geom]]
            return (ways @ model.mesh_vert[first : first + count].T).max(axis=1)
        case kinds.mjGEOM_BOX:
            return np.abs(ways) @ model.geom_size[geom]
        case kinds.mjGEOM_CYLINDER:
            return a * flat + b * up
        case kinds.mjGEOM_CAPSULE:
            return a + b * up
        case kinds.mjGEOM_SPHERE:
            return np.full(len(ways), a)
        case _:
            return np.linalg.norm(ways * model.geom_size[geom], axis=1)  # an ellipsoid


if __name__ == "__main__":
    for table in differences(find_workcell("ur5e_allegro"), tuple(sys.argv[1:]), "collision"):
        print(markdown(table))
