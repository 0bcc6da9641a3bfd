"""Slow motions of the robot, and paths to a pose without collisions."""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Float64
from scipy.interpolate import BPoly
from scipy.sparse.csgraph import dijkstra

from pixel2catch.errors import DeploymentError, UnknownNameError
from pixel2catch.ros2.profile import Profile
from pixel2catch.scene.distances import RULES, Distances
from pixel2catch.servo.limits import Joints, ServoLimits
from pixel2catch.servo.link import JointTargets
from pixel2catch.servo.workspace import note_inside
from pixel2catch.workcells import find_workcell

Poses = Float64[np.ndarray, "poses joints"]

OPEN = 0.1  #: Distance of a finger from its start pose up to which it is open [rad]. Source: ours.
GRIP = 0.1  #: Angle by which closed fingers close further to hold an object [rad]. Source: ours.
PEAK = 1.875  #: Largest speed over mean speed of a motion from rest to rest, a polynomial of degree 5.
SHORTEST = 1e-3  #: Least time between two poses [s].
STEP = 0.04  #: Largest motion of a joint between two poses that are checked [rad]. Source: ours.
NEAR = 0.25  #: Motion from the start or the goal in which their own distances are enough [rad]. Source: ours.
LEAST_DISTANCE = 0.003  #: Distance at the start or the goal that counts as contact [m]. Source: ours.
NUM_BETWEEN = 200  #: Number of poses over which a path may lead. Source: ours.
DETOUR = 0.5  #: Length by which each intermediate pose must shorten a path [rad]. Source: ours.


@dataclass(frozen=True, kw_only=True, eq=False)
class Motion:
    """Joint targets by time."""

    #: Targets [rad] by the time since the start [s], before it and after the end.
    at: Callable[[float], Joints]
    duration: float  #: [s]

    @classmethod
    def along(cls, poses: Poses, speed: Joints) -> "Motion":
        """Return the fastest motion over poses [rad], at rest in each; no joint exceeds its speed [rad/s]."""
        durations = PEAK * np.max(np.abs(np.diff(poses, axis=0)) / speed, axis=1)
        times = np.cumsum([0.0, *np.maximum(durations, SHORTEST)])
        curve = BPoly.from_derivatives(times, [(pose, 0.0 * pose, 0.0 * pose) for pose in poses])
        return cls(at=lambda time: curve(np.clip(time, 0.0, times[-1])), duration=float(times[-1]))


def blind_targets(joint_pos: Joints, now: float) -> JointTargets:
    """Return targets of a planned motion [rad], as new as if there were an image now [s]."""
    return JointTargets(
        joint_pos_target=joint_pos, target_stamp=now, image_stamp=now, box_stamp=now, is_planned=True
    )


class PathFinder:
    """Finds paths that keep their distance from the table, the robot itself and other arms."""

    def __init__(self, profile: Profile, limits: ServoLimits, share: float) -> None:
        """Build the model of the work cell; motions have a share of the speed that the limits permit."""
        self._workcell = workcell = find_workcell(profile.workcell)
        self.home = np.array([joint.home for joint in workcell.joints])  #: The start pose [rad].
        self._places, self._joints = profile.places, limits.joints
        self._distances, self._space = Distances(workcell), limits.workspace.space
        self._speed = share * limits.joint_records["even_speed"]
        self.is_arm = limits.joint_records["is_arm"]  #: Whether each joint is an arm's.

    def pose_over(self, name: str) -> Joints:
        """Return the pose over a place of the profile [rad], with an open hand; "" is the start pose."""
        if name and name not in self._places:
            raise UnknownNameError("place", name, self._places)
        angles = self._places[name].joints if name else {}
        return np.array([angles.get(joint.name, joint.home) for joint in self._workcell.joints])

    def motion(self, start: Joints, goal: Joints) -> Motion:
        """Return the motion of the arm to a goal, where the hand opens [rad]; raise as `path` does.

        On the way the fingers keep their positions; those that are not open close by `GRIP`.
        """
        fingers = start - self.home
        grip = np.where(self.is_arm | (np.abs(fingers) < OPEN), 0.0, GRIP * np.sign(fingers))
        held, opened = start + grip, np.where(self.is_arm, goal, self.home)
        poses = self.path(held, np.where(self.is_arm, goal, held))
        return Motion.along(np.array([*poses, opened]), self._speed)

    def path(self, start: Joints, goal: Joints) -> Poses:
        """Return the poses of a path [rad], straight or over few poses; raise DeploymentError without one."""
        for name, pose in (("the robot's pose", start), ("the goal", goal)):
            if reason := self.refusal(pose):
                raise DeploymentError(f"no motion: {name} is not allowed, {reason}. Move the robot by hand.")
        shape, rng = (NUM_BETWEEN, len(start)), np.random.default_rng(0)
        between = np.where(rng.random(shape) < 0.5, start, goal)  # some joints before the others
        between[::2] = rng.uniform(self._joints.lower, self._joints.upper, shape)[::2]
        between[:, ~self.is_arm] = start[~self.is_arm]
        poses = np.array([start, goal, *(pose for pose in between if not self.refusal(pose))])
        lengths = np.abs(poses[:, None] - poses).max(axis=-1) + DETOUR
        while True:
            _, before = dijkstra(lengths, indices=0, return_predecessors=True)
            way = [1]
            while way[0] > 0:
                way.insert(0, int(before[way[0]]))
            if way[0] < 0:
                far = int(np.abs(goal - start).argmax())
                raise DeploymentError(
                    "no motion: no path without a collision was found, and "
                    f"{self._workcell.joint_names[far]} is {abs(goal[far] - start[far]):.1f} rad from its "
                    "goal. Move the robot by hand."
                )
            for one, other in pairwise(way):
                if not self._is_free(poses[one], poses[other], poses[:2]):
                    lengths[one, other] = lengths[other, one] = np.inf
                    break
            else:
                return poses[way]

    def refusal(self, pose: Joints) -> str:
        """Return why the robot cannot be in a pose; empty if it can."""
        lower, upper = self._joints.lower, self._joints.upper
        off = np.maximum(lower - pose, pose - upper) - self._joints.start_error
        if off.max() > 0.0:
            i = int(off.argmax())
            name = self._workcell.joint_names[i]
            return f"{name} is at {pose[i]:.2f} rad, beyond {lower[i]:.2f} to {upper[i]:.2f}"
        if not self._are_inside(pose[None]).all():
            return "hand or elbow are outside the workspace"
        for found in self._distances.at(pose)[:2]:
            if found.distance < LEAST_DISTANCE:
                return f"{' and '.join(found.bodies)} are {1e3 * found.distance:.0f} mm apart"
        return ""

    def _are_inside(self, poses: Poses) -> Bool[np.ndarray, " poses"]:
        are_inside = np.zeros(len(poses), dtype=bool)
        note_inside(self._space, np.ascontiguousarray(poses[:, self._space.columns]), are_inside)
        return are_inside

    def _is_free(self, one: Joints, other: Joints, ends: Poses) -> bool:
        """Return whether the straight line between two poses is free; near the ends their distances count."""
        line = np.linspace(one, other, int(np.ceil(np.abs(other - one).max() / STEP)) + 1)
        near = np.abs(line[:, None] - ends)[..., self.is_arm].max(axis=-1) < NEAR
        own = np.array([self.nearest(end) for end in ends]) - 1e-3
        margins = np.array([rule.margin for rule in RULES[:2]])
        least = np.minimum(margins, np.where(near[..., None], own, np.inf).min(axis=1))
        is_inside = bool(self._are_inside(line).all())
        return is_inside and all(
            (self.nearest(pose) >= row).all() for pose, row in zip(line, least, strict=True)
        )

    def nearest(self, pose: Joints) -> Float64[np.ndarray, " 2"]:
        """Return the distances of the robot to the table, and of arms to the robot [m], in a pose [rad]."""
        return np.array([found.distance for found in self._distances.at(pose)[:2]])
