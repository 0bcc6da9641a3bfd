"""Which throws an arm can reach that knows the throw from its release on.

A throw is reachable if, at some time of its flight, a palm can be within `NEAR` of the object and face it,
with every joint of its arm driven within its speed and acceleration since the release, before the object
has passed the robot. Hand, sight, policy, and lower speeds near the ends of a joint's travel do not count.
"""

from functools import cache
from math import cos, radians
from operator import attrgetter

import numpy as np
import torch
from scipy.spatial import KDTree
from torch import Tensor

from pixel2catch.batches import Flags
from pixel2catch.envs.episode import Episode
from pixel2catch.envs.world import rotation_matrix
from pixel2catch.mdp.terminations import DROP_HEIGHT, DROP_X
from pixel2catch.mdp.throws import flight_path, flight_time
from pixel2catch.robots.geometry import WorkcellGeometry
from pixel2catch.robots.workcell import WorkcellSpec
from pixel2catch.scene.constants import CONTROL_DT

NUM_POSES = 100_000  #: Drawn positions of each arm. Source: ours, four times as many change a rate by 1 %.
NEAR = 0.06  #: Largest distance of a palm from the object's centre [m]. Source: ours, 8 cm count as reached.
FACING = cos(radians(60.0))  #: Least cosine between a palm's normal and the object's motion. Source: ours.
LONGEST = 1.0  #: Longest time of a motion of the arm [s]. Source: ours.
NUM_TIMES = 48  #: Times of a flight that are looked at. Source: ours.


def motion_time(angle: Tensor, speed: Tensor, acceleration: Tensor) -> Tensor:
    """Return the shortest time [s] of a motion by an angle [rad] from rest to rest, within limits."""
    ramp = speed / acceleration
    return torch.where(angle > ramp * speed, angle / speed + ramp, 2.0 * (angle / acceleration).sqrt())


@cache
def _palm_places(workcell: WorkcellSpec) -> tuple[KDTree, np.ndarray, np.ndarray]:
    """Return places of palms [m], their normals, and the times of the motions from the start [s].

    Positions of the joints are drawn; those in which the arm is in the table are left out.
    """
    generator, geometry = torch.Generator().manual_seed(0), WorkcellGeometry(workcell)
    limits = attrgetter("home", "lower", "upper", "velocity_limit", "acceleration_limit")
    joints = [(*limits(joint), joint.damping / joint.stiffness) for joint in workcell.joints]
    home, lower, upper, speed, acceleration, lag = torch.tensor(joints).T[:, None]
    rows = []
    for i, palm in enumerate(workcell.palms):
        draws = torch.rand(NUM_POSES, len(workcell.joints), generator=generator)
        way = speed * LONGEST * torch.rand(NUM_POSES, 1, generator=generator)  # short motions, too, are many
        first, last = torch.maximum(lower, home - way), torch.minimum(upper, home + way)
        joint_pos = home.expand(NUM_POSES, -1).clone()
        joint_pos[:, palm.carriers] = (first + (last - first) * draws)[:, palm.carriers]
        time = motion_time((joint_pos - home).abs(), speed, acceleration) + lag
        time = time[:, palm.carriers].amax(dim=1) + CONTROL_DT
        pos, quat = (value[:, i] for value in geometry.palm_poses(joint_pos))
        normal = rotation_matrix(quat) @ torch.tensor(palm.spec.normal)
        is_clear = geometry.depth_in_table(joint_pos)[:, i] <= 0.0
        rows.append(torch.cat((pos, normal, time[:, None]), dim=1)[is_clear])
    pos, normal, time = np.split(torch.cat(rows).double().numpy(), (3, 6), axis=1)
    return KDTree(pos), normal, time[:, 0]


def is_reachable(episode: Episode, workcell: WorkcellSpec) -> Flags:
    """Return which throws of episodes the arms of a work cell can reach."""
    throw = episode.throw
    drag = torch.zeros_like(throw.pos[:, 0]) if episode.drag is None else episode.drag
    duration = flight_time(throw.lin_vel, DROP_HEIGHT - throw.pos[:, 2])
    path = flight_path(throw.pos, throw.lin_vel, drag, duration, episode.side_force, NUM_TIMES).cpu().double()
    steps = duration.cpu().double() / (len(path) - 1)
    tree, normals, times = _palm_places(workcell)
    found = []
    for points, step in zip(path.transpose(0, 1).numpy(), steps.tolist(), strict=True):
        motion = np.gradient(points, axis=0)
        motion /= np.linalg.norm(motion, axis=1, keepdims=True)
        found.append(
            any(
                bool(((times[near] <= k * step) & (normals[near] @ -motion[k] >= FACING)).any())
                for k, near in enumerate(tree.query_ball_point(points, NEAR))
                if points[k, 0] >= DROP_X
            )
        )
    return torch.tensor(found)
