"""Poses of palms for given joint positions, and distances of robots from the table.

The servo keeps these distances, and training penalises commands that violate them. An arm is a set of
capsules about its links. A hand is a box that contains it at every position of its fingers. The base and the
first link stand on the table and are left out.
"""

from dataclasses import dataclass
from functools import cache
from itertools import product

import mujoco
import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from pixel2catch.robots.chain import Chain
from pixel2catch.robots.poses import pose_matrix
from pixel2catch.robots.spec import Vec3
from pixel2catch.robots.workcell import COLLISION_GROUP, PlacedPalm, WorkcellSpec, add_robots

TABLE_CLEARANCE = 0.02  #: Distance to keep from the table's top and from its sides [m]. Source: ours.

POINTS_PER_CAPSULE = 5
"""Points on the axis of a capsule that training checks. Source: ours: 9 cm apart on the longest capsule."""


@cache
def bare_model(workcell: WorkcellSpec, *, visuals: bool = False) -> mujoco.MjModel:
    """Compile the robots of a work cell alone, with or without visual geoms."""
    spec = mujoco.MjSpec()
    add_robots(spec, workcell, visuals)
    return spec.compile()


@dataclass(frozen=True, kw_only=True, eq=False)
class ArmShape:
    """Collision shape of an arm and its hand, without the first and the last link."""

    links: Int[np.ndarray, " capsules"]  #: Link of each capsule, as a row of `Chain.link_poses`.
    #: Both ends of each capsule's axis in the frame at the far end of its link, homogeneous [m].
    ends: Float[np.ndarray, "capsules 4 2"]
    radii: Float[np.ndarray, " capsules"]  #: Radii of the capsules [m].
    hand_center: Float[np.ndarray, " 3"]  #: Centre of the box about the hand, frame of the palm's site [m].
    hand_half: Float[np.ndarray, " 3"]  #: Half of the extents of that box [m].
    #: Lower and upper corners of boxes about the hand alone and about the last link, frame of the palm's site
    #: [m]; empty if the hand cannot touch its arm.
    boxes: Float[np.ndarray, "2 3 boxes"]
    #: Capsules that hand and last link can touch: those at least three joints away.
    reached: Int[np.ndarray, " some"]


def chain_of(
    workcell: WorkcellSpec,
    palm: PlacedPalm,
    device: torch.device | str = "cpu",
    dtype: torch.dtype = torch.float32,
) -> Chain:
    """Return the chain of joints that carry a palm."""
    home = [joint.home for joint in workcell.joints[palm.carriers]]
    return Chain(bare_model(workcell), palm.spec.site, home, device=device, dtype=dtype)


@cache
def first_chain(workcell: WorkcellSpec, dtype: torch.dtype = torch.float64) -> Chain:
    """Return the chain of joints that carry the first palm, on the CPU."""
    return chain_of(workcell, workcell.palms[0], dtype=dtype)


@cache
def arm_shape(workcell: WorkcellSpec, palm: PlacedPalm) -> ArmShape:
    """Read the shape of the arm that carries a palm from the model."""
    model, chain = bare_model(workcell), chain_of(workcell, palm, dtype=torch.float64)
    data = mujoco.MjData(model)
    data.qpos[:] = [joint.home for joint in workcell.joints]
    mujoco.mj_kinematics(model, data)
    poses = chain.link_poses(torch.from_numpy(data.qpos[None, palm.carriers]))[0].numpy()
    links, ends, radii = list[int](), list[np.ndarray](), list[float]()
    for link, name in enumerate(chain.joints[1:-1], start=1):
        body = int(model.jnt_bodyid[model.joint(name).id])
        for geom in np.flatnonzero(model.body_weldid[model.geom_bodyid] == model.body_weldid[body]):
            if model.geom_group[geom] == COLLISION_GROUP:
                start, end, radius = _capsule(model, data, int(geom))
                world = np.vstack((np.stack((start, end), axis=1), np.ones(2)))
                links.append(link)
                ends.append(np.linalg.inv(poses[link]) @ world)
                radii.append(radius)
    site = model.site(palm.spec.site)
    to_site = np.linalg.inv(pose_matrix(site.pos, site.quat))
    lower, upper = _box_about(to_site, palm.spec.lower, palm.spec.upper)
    boxes = np.empty((2, 3, 0))
    if palm.spec.hand:
        own = [_box_about(to_site, *corners) for corners in palm.spec.hand]
        own.append(_last_link_box(model, data, chain.joints[-1], palm))
        boxes = np.moveaxis(np.array(own), 0, -1)
    return ArmShape(
        links=np.array(links),
        ends=np.array(ends),
        radii=np.array(radii),
        hand_center=(lower + upper) / 2.0,
        hand_half=(upper - lower) / 2.0,
        boxes=boxes,
        reached=np.flatnonzero(np.array(links) < len(chain.joints) - 3),
    )


def _box_about(
    frame: Float[np.ndarray, "4 4"], lower: np.ndarray | Vec3, upper: np.ndarray | Vec3
) -> tuple[np.ndarray, np.ndarray]:
    """Transform a box by a pose; return the corners [m] of the axis-parallel box about the result."""
    corners = np.array([*product(*zip(np.asarray(lower), np.asarray(upper), strict=True))])
    corners = corners @ frame[:3, :3].T + frame[:3, 3]
    return corners.min(axis=0), corners.max(axis=0)


def _last_link_box(
    model: mujoco.MjModel, data: mujoco.MjData, joint: str, palm: PlacedPalm
) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners of the box about the last link of an arm, frame of the palm's site [m]."""
    site = data.site(palm.spec.site)
    axes, origin = site.xmat.reshape(3, 3), site.xpos
    welded = (
        model.body_weldid[model.geom_bodyid] == model.body_weldid[model.jnt_bodyid[model.joint(joint).id]]
    )
    is_before = welded & (model.geom_bodyid < model.body(palm.spec.body).id)
    boxes = []
    for geom in np.flatnonzero(is_before & (model.geom_group == COLLISION_GROUP)):
        frame = np.eye(4)
        frame[:3, :3] = axes.T @ data.geom_xmat[geom].reshape(3, 3)
        frame[:3, 3] = axes.T @ (data.geom_xpos[geom] - origin)
        middle, half = model.geom_aabb[geom].reshape(2, 3)
        boxes.append(_box_about(frame, middle - half, middle + half))
    lower, upper = zip(*boxes, strict=True)
    return np.min(lower, axis=0), np.max(upper, axis=0)


def _capsule(model: mujoco.MjModel, data: mujoco.MjData, geom: int) -> tuple[np.ndarray, np.ndarray, float]:
    """Return a capsule that contains a geom: both ends [m] in the world, and radius [m]."""
    size, center, axes = model.geom_size[geom], data.geom_xpos[geom], data.geom_xmat[geom].reshape(3, 3)
    match model.geom_type[geom]:
        case mujoco.mjtGeom.mjGEOM_CAPSULE | mujoco.mjtGeom.mjGEOM_CYLINDER:
            radius, axis, half = float(size[0]), 2, float(size[1])
        case mujoco.mjtGeom.mjGEOM_SPHERE:
            radius, axis, half = float(size[0]), 2, 0.0
        case _:  # a box, or the bounding box of another shape
            size = model.geom_aabb[geom, 3:]
            center = center + axes @ model.geom_aabb[geom, :3]
            axis = int(np.argmax(size))
            radius, half = float(np.linalg.norm(np.delete(size, axis))), float(size[axis])
    offset = half * axes[:, axis]
    return center - offset, center + offset, radius


class WorkcellGeometry:
    """Palm poses and table clearances of a work cell, on one device."""

    def __init__(self, workcell: WorkcellSpec, device: torch.device | str = "cpu") -> None:
        """Copy the constants to the device."""
        self._palms = workcell.palms
        self._chains = [chain_of(workcell, palm, device) for palm in workcell.palms]
        self._points = [_TablePoints(workcell, palm, device) for palm in workcell.palms]

    def palm_poses(
        self, joint_pos: Float[Tensor, "num_envs num_joints"]
    ) -> tuple[Float[Tensor, "num_envs num_palms 3"], Float[Tensor, "num_envs num_palms 4"]]:
        """Return position [m] and orientation (w, x, y, z) of all palms in the world, for joints [rad]."""
        poses = [
            chain.pose(joint_pos[:, palm.carriers])
            for chain, palm in zip(self._chains, self._palms, strict=True)
        ]
        pos, quat = zip(*poses, strict=True)
        return torch.stack(pos, dim=1), torch.stack(quat, dim=1)

    def depth_in_table(
        self, joint_pos: Float[Tensor, "num_envs num_joints"]
    ) -> Float[Tensor, "num_envs num_palms"]:
        """Return how deep each arm or hand box is inside the table plus `TABLE_CLEARANCE` [m].

        Checks points on the axes of the capsules and the corners of the hand box. A box edge that crosses an
        edge of the table between two corners is missed; the servo checks the whole box.
        """
        depths = [
            points.depth(chain.link_poses(joint_pos[:, palm.carriers]))
            for chain, palm, points in zip(self._chains, self._palms, self._points, strict=True)
        ]
        return torch.stack(depths, dim=1)


class _TablePoints:
    """Checked points of an arm, and the table enlarged by the radius at each point."""

    def __init__(self, workcell: WorkcellSpec, palm: PlacedPalm, device: torch.device | str) -> None:
        shape, table = arm_shape(workcell, palm), workcell.table
        shares = np.linspace(0.0, 1.0, POINTS_PER_CAPSULE)
        along = shape.ends[:, :, 0, None] + shares * (shape.ends[:, :, 1] - shape.ends[:, :, 0])[..., None]
        corners = shape.hand_center + shape.hand_half * np.array([*product((-1.0, 1.0), repeat=3)])
        num_corners, num_joints = len(corners), palm.carriers.stop - palm.carriers.start
        points = np.concatenate(
            (along.swapaxes(1, 2).reshape(-1, 4), np.column_stack((corners, np.ones(num_corners))))
        )
        links = np.append(np.repeat(shape.links, POINTS_PER_CAPSULE), [num_joints - 1] * num_corners)
        radii = np.append(np.repeat(shape.radii, POINTS_PER_CAPSULE), np.zeros(num_corners))
        around = radii[:, None] + TABLE_CLEARANCE
        *center, top = table.center

        def to_device(values: object) -> Tensor:
            return torch.as_tensor(np.array(values), dtype=torch.float32, device=device)

        self._links = torch.as_tensor(links.astype(np.int64), device=device)
        self._points, self._middle = to_device(points), to_device(center)
        self._reach, self._top = to_device(np.array(table.size) / 2.0 + around), to_device(top + around[:, 0])

    def depth(self, poses: Float[Tensor, "num_envs num_links 4 4"]) -> Float[Tensor, " num_envs"]:
        place = (poses[:, self._links, :3] * self._points[:, None]).sum(dim=-1)
        is_over = ((place[..., :2] - self._middle).abs() < self._reach).all(dim=-1)
        depth = (self._top - place[..., 2]).clamp(min=0.0)
        return torch.where(is_over, depth, 0.0).amax(dim=-1)
