"""Paths to a pose without collisions, and slow motions along them."""

from contextlib import suppress
from dataclasses import dataclass
from itertools import pairwise

import mujoco
import numpy as np
from jaxtyping import Bool, Float64
from scipy.optimize import least_squares
from scipy.sparse.csgraph import dijkstra

from pixel2catch.errors import DeploymentError, UnknownNameError
from pixel2catch.robots.geometry import bare_model
from pixel2catch.ros2.profile import Profile
from pixel2catch.scene.distances import RULES, Distances
from pixel2catch.servo.limits import Joints, ServoLimits
from pixel2catch.servo.workspace import note_inside
from pixel2catch.workcells import find_workcell

Poses = Float64[np.ndarray, "poses joints"]

OPEN = 0.1  #: Distance of a finger from its start pose up to which it is open [rad]. Source: ours.
GRIP = 0.1  #: Angle by which closed fingers close further to hold an object [rad]. Source: ours.
SHARE = 0.23  #: Speed of a motion as a share of a catch's, with a margin to a quarter. Source: ours.
PEAK = 1.875  #: Largest speed over mean speed of a motion from rest to rest, a polynomial of degree 5.
STEP = 0.04  #: Largest motion of a joint between two poses that are checked [rad]. Source: ours.
NEAR = 0.25  #: Motion from the start or the goal in which their own distances are enough [rad]. Source: ours.
LEAST_DISTANCE = 0.003  #: Distance at the start or the goal that counts as contact [m]. Source: ours.
NUM_BETWEEN = 200  #: Number of random poses over which a path may lead. Source: ours.
DETOUR = 0.5  #: Length by which each intermediate pose must shorten a path [rad]. Source: ours.
PLACE_ERROR = 0.01  #: Largest distance of the palm from a place [m]. Source: ours.
MOST_UP = -0.5  #: Vertical part of the palm's direction over a place: 30° below the horizontal. Source: ours.
NUM_STARTS = 40  #: Number of poses from which one over a place is searched. Source: ours.


@dataclass(frozen=True, kw_only=True, eq=False)
class Motion:
    """Poses [rad] that the robot reaches at rest one after the other, and their times [s]."""

    poses: Poses
    times: Float64[np.ndarray, " poses"]

    @classmethod
    def along(cls, poses: Poses, speed: Joints) -> "Motion":
        """Return the fastest motion in which no joint exceeds its speed [rad/s]."""
        durations = PEAK * np.max(np.abs(np.diff(poses, axis=0)) / speed, axis=1)
        return cls(poses=poses, times=np.cumsum([0.0, *np.maximum(durations, 1e-3)]))

    @property
    def duration(self) -> float:
        """Time from start to goal [s]."""
        return float(self.times[-1])

    @property
    def in_words(self) -> str:
        """The announcement of the motion."""
        return f"{self.duration:.0f} s of motion along {len(self.poses) - 1} straight lines of the joints."

    def at(self, time: float) -> Joints:
        """Return the pose at a time since the start [rad]; before it the start, after the end the goal."""
        after = int(np.clip(np.searchsorted(self.times, time), 1, len(self.times) - 1))
        begin, end = self.times[after - 1 : after + 1]
        share = min(max((time - begin) / (end - begin), 0.0), 1.0)
        share = share**3 * (10.0 - 15.0 * share + 6.0 * share**2)
        return self.poses[after - 1] + share * (self.poses[after] - self.poses[after - 1])


def _shortest(lengths: Float64[np.ndarray, "poses poses"]) -> list[int]:
    """Return the shortest way from the first to the second pose by lengths [rad]; empty if there is none."""
    _, before = dijkstra(lengths, indices=0, return_predecessors=True)
    way = [1]
    while way[0] > 0:
        way.insert(0, int(before[way[0]]))
    return way if way[0] == 0 else []


class PathFinder:
    """Finds paths that keep their distance from the table, the robot itself and other arms."""

    def __init__(self, profile: Profile, limits: ServoLimits) -> None:
        """Build the model of the profile's work cell."""
        self._workcell = workcell = find_workcell(profile.workcell)
        self.home = np.array([joint.home for joint in workcell.joints])  #: The start pose [rad].
        self._places, self._limits = profile.places, limits
        self._distances, self._space = Distances(workcell), limits.workspace.space
        self.is_arm = np.zeros(len(self.home), dtype=bool)  #: Whether each joint is an arm's.
        for columns in workcell.of_role("arm"):
            self.is_arm[columns] = True

    def path(self, start: Joints, goal: Joints) -> Poses:
        """Return the poses of a path [rad]: straight, else over as few poses as possible.

        Raises:
            DeploymentError: A pose is not allowed, or no path was found; nothing may move.
        """
        for name, pose in (("the robot's pose", start), ("the goal", goal)):
            if reason := self.refusal(pose):
                raise DeploymentError(
                    f"no motion: {name} is not allowed, {reason}. Move the robot by hand (free drive)."
                )
        lower, upper = self._limits.joints.lower, self._limits.joints.upper
        between = np.random.default_rng(0).uniform(lower, upper, (NUM_BETWEEN, len(start)))
        between[:, ~self.is_arm] = start[~self.is_arm]
        poses = np.array([start, goal, *(pose for pose in between if not self.refusal(pose))])
        lengths = np.abs(poses[:, None] - poses).max(axis=-1) + DETOUR
        while True:
            way = _shortest(lengths)
            if not way:
                far = int(np.abs(goal - start).argmax())
                raise DeploymentError(
                    "no motion: no path without a collision was found, and "
                    f"{self._workcell.joint_names[far]} is {abs(goal[far] - start[far]):.1f} rad from its "
                    "goal. Move the robot by hand (free drive)."
                )
            for one, other in pairwise(way):
                if not self._is_free(poses[one], poses[other], poses[:2]):
                    lengths[one, other] = lengths[other, one] = np.inf
                    break
            else:
                return poses[way]

    def refusal(self, pose: Joints) -> str:
        """Return why the robot cannot be in a pose; empty if it can."""
        joints = self._limits.joints
        off = np.maximum(joints.lower - pose, pose - joints.upper) - joints.start_error
        if off.max() > 0.0:
            worst = int(off.argmax())
            return (
                f"{self._workcell.joint_names[worst]} is at {pose[worst]:.2f} rad, beyond "
                f"{joints.lower[worst]:.2f} to {joints.upper[worst]:.2f}"
            )
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
        own = np.array([self._nearest(end) for end in ends]) - 1e-3
        margins = np.array([rule.margin for rule in RULES[:2]])
        least = np.minimum(margins, np.where(near[..., None], own, np.inf).min(axis=1))
        is_inside = self._are_inside(line).all()
        return bool(is_inside) and all(
            (self._nearest(pose) >= row).all() for pose, row in zip(line, least, strict=True)
        )

    def _nearest(self, pose: Joints) -> Float64[np.ndarray, " 2"]:
        """Return the distances of the robot to the table, and of arms to the robot [m]."""
        return np.array([found.distance for found in self._distances.at(pose)[:2]])

    def motion(self, start: Joints, goal: Joints, speed: Joints) -> Motion:
        """Return the motion of the arm to a goal, where the hand opens [rad, rad/s]; raise as `path` does.

        On the way the fingers keep their positions; those that are not open close by `GRIP`.
        """
        fingers = start - self.home
        grip = np.where(self.is_arm | (np.abs(fingers) < OPEN), 0.0, GRIP * np.sign(fingers))
        held, opened = start + grip, np.where(self.is_arm, goal, self.home)
        poses = self.path(held, np.where(self.is_arm, goal, held))
        return Motion.along(np.array([*poses, opened]), speed)

    def pose_over(self, name: str) -> Joints:
        """Return the pose over a place of the profile, with an open hand [rad].

        Raises:
            UnknownNameError: There is no such place.
            DeploymentError: The palm cannot be there.
        """
        if name not in self._places:
            raise UnknownNameError("place", name, self._places)
        pose, place = self.home.copy(), self._places[name]
        if place.palm is None:
            for joint, angle in place.joints.items():
                pose[self._workcell.joint_names.index(joint)] = angle
            return pose
        palm, model = self._workcell.palms[0], bare_model(self._workcell)
        columns, data = palm.carriers, mujoco.MjData(model)
        lower, upper = self._limits.joints.lower[columns], self._limits.joints.upper[columns]

        def frame(joint_pos: Joints) -> tuple[np.ndarray, np.ndarray]:
            data.qpos[:] = self.home
            data.qpos[columns] = joint_pos
            mujoco.mj_kinematics(model, data)
            site = data.site(palm.spec.site)
            return site.xpos, site.xmat.reshape(3, 3)

        normal = frame(self.home[columns])[1][2].copy()  # the palm faces up in the start pose

        def error(joint_pos: Joints) -> np.ndarray:
            pos, rotation = frame(joint_pos)
            return np.append(pos - place.palm, max(rotation[2] @ normal - MOST_UP, 0.0))

        starts = np.random.default_rng(0).uniform(lower, upper, (NUM_STARTS, len(lower)))
        for start in (np.clip(self.home[columns], lower, upper), *starts):
            found = least_squares(error, start, bounds=(lower, upper))
            if np.abs(found.fun).max() < PLACE_ERROR:
                pose[columns] = found.x
                with suppress(DeploymentError):
                    self.path(self.home, pose)
                    return pose
        raise DeploymentError(
            f"the palm cannot be over '{name}' at {place.palm}, facing down: give the place in the profile "
            "another position, or joints."
        )
