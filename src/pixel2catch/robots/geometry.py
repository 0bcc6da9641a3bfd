"""Kinematics of arms, poses of palms, distances of robots from the table, speeds near the ends of a travel.

The matrix of joint i is K + cos(q) C + sin(q) S. A pose is the product of these homogeneous matrices. No call
copies between host and device or branches on a value, so kinematics work inside CUDA graphs.

The servo keeps these distances and speeds. Training keeps the speeds, and penalises commands that violate the
distances. An arm is a set of capsules about its links. A hand is a box that contains it at every position of
its fingers. The base and the first link stand on the table and are left out.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from itertools import accumulate, product
from typing import Any, no_type_check

import mujoco
import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from pixel2catch.batches import Joints, Quaternions, Scalars, Vectors
from pixel2catch.errors import InvalidValueError, UnknownNameError
from pixel2catch.robots.poses import pose_matrix, pose_of, rotation_matrix
from pixel2catch.robots.spec import JointSpec, Vec3
from pixel2catch.robots.workcell import COLLISION_GROUP, PlacedPalm, WorkcellSpec, add_robots

TABLE_CLEARANCE = 0.02  #: Distance to keep from the table's top and from its sides [m]. Source: ours.

POINTS_PER_CAPSULE = 5
"""Points on the axis of a capsule that training checks. Source: ours: 9 cm apart on the longest capsule."""

AXIS_WEIGHT = 0.15  #: Weight of the deviation of an axis against that of a point [m]. Source: ours.
END_MARGIN = 1e-3  #: Distance of commands from where an interface allows no speed [rad]. Source: ours.
DAMPING = 1e-3  #: Weight of a step against the error that remains [m²/rad²]. Source: ours.

Batch = Float[Tensor, "num_envs _"]


class Chain:
    """The hinges between the world and a site, from base to tip."""

    def __init__(
        self, workcell: WorkcellSpec, site: str, device: torch.device | str, dtype: torch.dtype
    ) -> None:
        self.joints, matrices = _read_chain(bare_model(workcell), site)
        names = workcell.joint_names
        for joint in self.joints:
            if joint not in names:
                raise UnknownNameError(f"joint that moves the site '{site}'", joint, names)
        self.columns = [names.index(joint) for joint in self.joints]  #: Columns of its joints.
        home = [workcell.joints[column].home for column in self.columns]
        #: K, C and S of each joint, multiplied by the fixed transforms between joints.
        self.matrices = torch.as_tensor(matrices, dtype=dtype, device=device)
        self._products = torch.as_tensor(_product_maps(), dtype=dtype, device=device)
        self.side = torch.ones(4, dtype=dtype, device=device)
        _, start = self.pose(torch.tensor([home], dtype=dtype, device=device))
        #: Sign convention: of q and -q, return the one with a positive product with this quaternion, the
        #: orientation at the start pose with its largest entry negative. Differs: paper and release return
        #: w >= 0; w is 0 at the start pose, where noise would flip all four entries.
        self.side = -start[0] * start[0, start[0].abs().argmax()].sign()

    def link_poses(self, joint_pos: Joints) -> Float[Tensor, "num_envs num_joints 4 4"]:
        """Return the world frame at the far end of each link; the last one is the site's."""
        return torch.stack([*accumulate(self.transforms(joint_pos).unbind(dim=1), _multiply)], dim=1)

    def pose(self, joint_pos: Joints) -> tuple[Vectors, Quaternions]:
        """Return position [m] and orientation (w, x, y, z) of the site in the world, for joints [rad]."""
        transforms = [*self.transforms(joint_pos).unbind(dim=1)]
        while len(transforms) > 3:  # multiply in pairs: fewer dependent kernels
            whole, rest = len(transforms) // 2 * 2, transforms[len(transforms) // 2 * 2 :]
            left, right = torch.stack(transforms[0:whole:2], 1), torch.stack(transforms[1:whole:2], 1)
            transforms = [*_multiply(left, right).unbind(dim=1), *rest]
        *_, pose = accumulate(transforms, _multiply)
        return pose[:, :3, 3], self._quaternion(pose)

    def transforms(self, joint_pos: Joints) -> Float[Tensor, "num_envs num_joints 4 4"]:
        """Return the transform over each joint and its link."""
        constant, cosine, sine = self.matrices.unbind(0)
        angle = joint_pos[..., None, None]
        return constant + torch.cos(angle) * cosine + torch.sin(angle) * sine

    def _quaternion(self, pose: Float[Tensor, "num_envs 4 4"]) -> Quaternions:
        """Convert the rotation by the row of 4 q qᵀ with the largest diagonal entry."""
        products = (self._products * pose.reshape(-1, 1, 1, 16)).sum(-1)
        diagonal = products.diagonal(dim1=-2, dim2=-1)
        largest = diagonal.argmax(-1, keepdim=True)
        row = products.gather(1, largest[..., None].expand(-1, 1, 4)).squeeze(1)
        quat = row / (2.0 * diagonal.gather(1, largest).sqrt())
        side = (quat * self.side).sum(dim=-1, keepdim=True)
        return torch.where(side < 0, -quat, quat)


def _read_chain(model: mujoco.MjModel, site: str) -> tuple[tuple[str, ...], np.ndarray]:
    """Return the names of the joints that move a site, and K, C, S: (3, num_joints, 4, 4)."""
    end = model.site(site)
    body, after = int(end.bodyid[0]), pose_matrix(end.pos, end.quat)
    names, afters, axes = list[str](), list[np.ndarray](), list[np.ndarray]()
    while body:
        first, count = int(model.body_jntadr[body]), int(model.body_jntnum[body])
        if count > 1 or (count and model.jnt_type[first] != mujoco.mjtJoint.mjJNT_HINGE):
            raise InvalidValueError(f"body '{model.body(body).name}' may have one hinge, and no other joint.")
        if count:
            place = pose_matrix(model.jnt_pos[first], (1.0, 0.0, 0.0, 0.0))
            names.append(model.joint(first).name)
            afters.append(np.linalg.inv(place) @ after)
            axes.append(model.jnt_axis[first])
            after = place
        after = pose_matrix(model.body_pos[body], model.body_quat[body]) @ after
        body = int(model.body_parentid[body])
    leading = [np.eye(4)] * (len(names) - 1) + [after]
    parts = [
        [before @ part @ following for part in _turning(axis)]
        for before, axis, following in zip(leading, axes, afters, strict=True)
    ]
    return tuple(reversed(names)), np.stack(parts[::-1], axis=1)


def _turning(axis: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return K, C, S of Rodrigues' formula: the rotation about an axis is K + cos C + sin S."""
    constant, cosine, sine = np.zeros((4, 4)), np.zeros((4, 4)), np.zeros((4, 4))
    x, y, z = axis
    constant[:3, :3], constant[3, 3] = np.outer(axis, axis), 1.0
    cosine[:3, :3] = np.eye(3) - np.outer(axis, axis)
    sine[:3, :3] = ((0.0, -z, y), (z, 0.0, -x), (-y, x, 0.0))
    return constant, cosine, sine


def _product_maps() -> np.ndarray:
    """Return the products 4 q_i q_j as linear maps of the entries of a homogeneous matrix: (4, 4, 16)."""
    table, unit = np.zeros((4, 4, 4, 4)), np.eye(4)
    for i, j in product(
        range(4), repeat=2
    ):  # half the second derivatives of the rotation, which is quadratic
        both = rotation_matrix(unit[i] + unit[j])
        table[i, j, :3, :3] = (both - rotation_matrix(unit[i]) - rotation_matrix(unit[j])) / 2.0
    table[range(4), range(4), 3, 3] = 1.0
    return table.reshape(4, 4, 16)


def _multiply(left: Tensor, right: Tensor) -> Tensor:
    """Multiply matrices (..., 4, 4) elementwise, as matrix units would reduce the precision."""
    return (left.unsqueeze(-1) * right.unsqueeze(-3)).sum(-2)


@cache
def bare_model(workcell: WorkcellSpec, *, visuals: bool = False) -> mujoco.MjModel:
    """Compile the robots of a work cell alone, with or without visual geoms."""
    spec = mujoco.MjSpec()
    add_robots(spec, workcell, visuals)
    return spec.compile()


def pose_and_slopes(
    chain: Chain, joint_pos: Batch
) -> tuple[Float[Tensor, "num_envs 4 4"], Float[Tensor, "num_envs _ 4 4"]]:
    """Return the pose of a chain's site in the world, and its derivative by each joint [rad]."""
    _, cosine, sine = chain.matrices
    cos, sin = joint_pos.cos()[..., None, None], joint_pos.sin()[..., None, None]
    links, turns = chain.transforms(joint_pos).unbind(1), (cos * sine - sin * cosine).unbind(1)
    unit = torch.eye(4).to(joint_pos).expand_as(links[0])
    before = [unit, *accumulate(links, torch.matmul)]
    after = [unit, *accumulate(reversed(links), lambda right, left: left @ right)][-2::-1]
    slopes = [a @ turn @ b for a, turn, b in zip(before[:-1], turns, after, strict=True)]
    return before[-1], torch.stack(slopes, dim=1)


def joints_reaching(
    chain: Chain,
    joint_pos: Batch,
    limits: Float[Tensor, "2 _"],
    point: Batch,
    axis: Batch | None = None,
    local_axis: Float[Tensor, " 3"] | None = None,
    num_steps: int = 8,
) -> Batch:
    """Return joints within limits [rad] that bring a site to a point [m], and its `local_axis` to an axis.

    The search starts at `joint_pos`. A joint with equal limits stays.
    """
    is_free = (limits[1] > limits[0])[:, None]
    for _ in range(num_steps):
        pose, slopes = pose_and_slopes(chain, joint_pos)
        error, slope = point - pose[:, :3, 3], slopes[..., :3, 3]
        if axis is not None and local_axis is not None:
            turned = axis - pose[:, :3, :3] @ local_axis
            error = torch.cat((error, AXIS_WEIGHT * turned), dim=-1)
            slope = torch.cat((slope, AXIS_WEIGHT * slopes[..., :3, :3] @ local_axis), dim=-1)
        joint_pos = (joint_pos + damped_step(is_free * slope, error, DAMPING)).clamp(*limits)
    return joint_pos


def damped_step(slope: Float[Tensor, "num_envs _ _"], error: Batch, damping: float) -> Batch:
    """Return the step of k joints that reduces an error, by damped least squares."""
    normal = slope @ slope.transpose(1, 2) + damping * torch.eye(slope.shape[1]).to(slope)
    return torch.linalg.solve(normal, (slope @ error[..., None])[..., 0])


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
    reached: Int[np.ndarray, " some"]  #: Capsules at least three joints away, which the hand can touch.


@cache
def chain_of(
    workcell: WorkcellSpec,
    palm: PlacedPalm,
    device: torch.device | str = "cpu",
    dtype: torch.dtype = torch.float64,
) -> Chain:
    """Return the chain of joints that carry a palm."""
    return Chain(workcell, palm.spec.site, device, dtype)


@cache
def arm_shape(workcell: WorkcellSpec, palm: PlacedPalm) -> ArmShape:
    """Read the shape of the arm that carries a palm from the model."""
    model, chain = bare_model(workcell), chain_of(workcell, palm)
    data = mujoco.MjData(model)
    data.qpos[:] = [joint.home for joint in workcell.joints]
    mujoco.mj_kinematics(model, data)
    poses = chain.link_poses(torch.from_numpy(data.qpos[None, palm.carriers]))[0].numpy()
    capsules = [
        (link, np.linalg.inv(poses[link]) @ ends, radius)
        for link, joint in enumerate(chain.joints[1:-1], start=1)
        for ends, radius in (_capsule(model, data, geom) for geom in _geoms_on(model, joint))
    ]
    links, ends, radii = (np.array(each) for each in zip(*capsules, strict=True))
    site = model.site(palm.spec.site)
    to_site = np.linalg.inv(pose_matrix(site.pos, site.quat))
    lower, upper = _box_about(to_site, palm.spec.lower, palm.spec.upper)
    boxes = np.empty((2, 3, 0))
    if palm.spec.hand:
        own = [_box_about(to_site, *corners) for corners in palm.spec.hand]
        own.append(_last_link_box(model, data, chain.joints[-1], palm))
        boxes = np.moveaxis(np.array(own), 0, -1)
    return ArmShape(
        links=links,
        ends=ends,
        radii=radii,
        hand_center=(lower + upper) / 2.0,
        hand_half=(upper - lower) / 2.0,
        boxes=boxes,
        reached=np.flatnonzero(links < len(chain.joints) - 3),
    )


def _geoms_on(model: mujoco.MjModel, joint: str) -> list[int]:
    """Return the collision geoms that a joint moves and no later one."""
    body = model.body_weldid[model.jnt_bodyid[model.joint(joint).id]]
    is_on = model.body_weldid[model.geom_bodyid] == body
    return np.flatnonzero(is_on & (model.geom_group == COLLISION_GROUP)).tolist()


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
    own, boxes = model.body(palm.spec.body).id, []
    for geom in (each for each in _geoms_on(model, joint) if model.geom_bodyid[each] < own):
        turn = axes.T @ data.geom_xmat[geom].reshape(3, 3)
        frame = pose_of(axes.T @ (data.geom_xpos[geom] - origin), turn)
        middle, half = model.geom_aabb[geom].reshape(2, 3)
        boxes.append(_box_about(frame, middle - half, middle + half))
    lower, upper = zip(*boxes, strict=True)
    return np.min(lower, axis=0), np.max(upper, axis=0)


def _capsule(model: mujoco.MjModel, data: mujoco.MjData, geom: int) -> tuple[np.ndarray, float]:
    """Return a capsule that contains a geom: both ends [m], homogeneous, in the world, and radius [m]."""
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
    return np.vstack((np.stack((center - offset, center + offset), axis=1), np.ones(2))), radius


class WorkcellGeometry:
    """Palm poses and table clearances of a work cell, on one device."""

    def __init__(self, workcell: WorkcellSpec, device: torch.device | str = "cpu") -> None:
        self._arms = [
            (
                palm.carriers,
                chain_of(workcell, palm, device, torch.float32),
                _TablePoints(workcell, palm, device),
            )
            for palm in workcell.palms
        ]

    def palm_poses(
        self, joint_pos: Joints
    ) -> tuple[Float[Tensor, "num_envs num_palms 3"], Float[Tensor, "num_envs num_palms 4"]]:
        """Return position [m] and orientation (w, x, y, z) of all palms in the world, for joints [rad]."""
        poses = [chain.pose(joint_pos[:, columns]) for columns, chain, _ in self._arms]
        pos, quat = zip(*poses, strict=True)
        return torch.stack(pos, dim=1), torch.stack(quat, dim=1)

    def depth_in_table(self, joint_pos: Joints) -> Float[Tensor, "num_envs num_palms"]:
        """Return how deep each arm or hand box is inside the table plus `TABLE_CLEARANCE` [m].

        Checks points on the axes of the capsules and the corners of the hand box. A box edge that crosses an
        edge of the table between two corners is missed; the servo checks the whole box.
        """
        poses = [(points, chain.link_poses(joint_pos[:, columns])) for columns, chain, points in self._arms]
        return torch.stack([points.depth(each) for points, each in poses], dim=1)


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

    def depth(self, poses: Float[Tensor, "num_envs num_links 4 4"]) -> Scalars:
        place = (poses[:, self._links, :3] * self._points[:, None]).sum(dim=-1)
        is_over = ((place[..., :2] - self._middle).abs() < self._reach).all(dim=-1)
        depth = (self._top - place[..., 2]).clamp(min=0.0)
        return torch.where(is_over, depth, 0.0).amax(dim=-1)


@no_type_check  # a check in tests would wrap it, and the servo could not compile it
def speed_to_end(distance: Any, slope: Any, base: Any) -> Any:
    """Return the largest speed [rad/s] of a command's step dt towards an end of the travel.

    The distance d to where the interface allows none is 0 or more [rad]; after the step, the rest r is on
    speed = √(slope r + offset²) - offset. There, commands brake by less than slope / 2 [rad/s²].
    """
    return (base * base + slope * distance) ** 0.5 - base


def travel_columns(joints: Sequence[JointSpec], acceleration: np.ndarray, dt: float) -> dict[str, np.ndarray]:
    """Return what `speed_to_end` needs of joints with these accelerations [rad/s²], in steps dt [s].

    At `low_end` and `high_end`, the interface allows no speed [rad]. A slope is that of the acceleration
    where the interface expects more deceleration: speeds are lower there than it allows.
    """
    lower, upper, deceleration, offset = np.array([joint.travel for joint in joints]).T
    slope = 2.0 * np.minimum(deceleration, acceleration)
    rest, base = offset**2 / slope + END_MARGIN, offset + 0.5 * slope * dt
    return {"low_end": lower + rest, "high_end": upper - rest, "end_slope": slope, "end_base": base}
