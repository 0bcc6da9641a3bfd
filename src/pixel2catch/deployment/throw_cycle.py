"""What the robot does between throws without a person: it carries, releases, returns, and waits."""

from collections.abc import Callable
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from dataclasses import replace
from math import inf
from typing import Literal

import numpy as np
import torch

from pixel2catch.camera.pinhole import project
from pixel2catch.deployment.paths import Motion, PathFinder, blind_targets
from pixel2catch.deployment.perception import INLINE
from pixel2catch.deployment.policy_pipeline import FADE_STEPS, PolicyPipeline
from pixel2catch.robots.geometry import WorkcellGeometry
from pixel2catch.ros2.profile import Profile
from pixel2catch.scene.constants import CONTROL_DT, CameraSpec
from pixel2catch.servo.limits import Joints, ServoLimits
from pixel2catch.servo.link import RECORDER_PRIORITY, JointTargets, give_way
from pixel2catch.workcells import find_workcell

SHARE = 0.23  #: Speed of a motion as a share of a catch's, with a margin to a quarter. Source: ours.
HELD_DISTANCE = 0.12  #: Distance of a held object from the palm, across the line of sight [m]. Source: ours.
HELD_TIME = 0.4  #: Time for which an object stays at the palm that is caught [s]. Source: ours.
MISSED_TIME = 1.0  #: Time without a box after which the object is missed [s]. Source: ours.
FLIGHT = 60.0  #: Motion of the box from which the object was thrown [px]. Source: ours.
FLIGHT_TIME = 3.0  #: Time after which a thrown object is missed that is not held [s]. Source: ours.
AWAY = 0.02  #: Distance of an arm joint from which it is not in its start pose [rad]. Source: ours.


class ThrowCycle:
    """Decides like the pipeline in a throw; then moves the robot to a place and to its start pose.

    A throw that a stop interrupted counts as caught, and a motion that a stop interrupted begins again, once
    the robot is armed.
    """

    def __init__(
        self,
        pipeline: PolicyPipeline,
        profile: Profile,
        limits: ServoLimits,
        camera: CameraSpec,
        place: str,
        *,
        is_stepped: bool = False,
    ) -> None:
        """Find a path to a place, in a thread of its own, in stepped time at once; it may take a second.

        Raises UnknownNameError for an unknown place, DeploymentError if no path leads there.
        """
        self.phase: Literal["wait", "throw", "move"] = "wait"
        self.message = ""  #: The announcement of the motion.
        self.begin_waiting: Callable[[], None] = lambda: None  #: Called when the robot begins to wait.
        self._pipeline, self._camera = pipeline, camera
        own_thread = ThreadPoolExecutor(1, "paths", give_way, (RECORDER_PRIORITY,))
        self._executor: Executor = INLINE if is_stepped else own_thread
        self._geometry = WorkcellGeometry(find_workcell(profile.workcell))
        self._finder = PathFinder(profile, limits, SHARE)
        self._place = (f"to {place}", self._finder.pose_over(place))
        self._home = ("to the start pose", self._finder.home)
        self._finder.motion(self._finder.home, self._place[1])
        self._goals: list[tuple[str, Joints]] = []
        self._motion: Future[Motion] | None = None
        self._target, self._begin, self._num_rests = self._finder.home, inf, 0
        self._held_since = self._thrown = inf
        self._first = np.full(2, np.nan)

    def arm(self, joint_pos: Joints, begin: float) -> None:
        """Hold the measured pose [rad] of a robot that was armed, and move on from a time on [s]."""
        is_away = (np.abs(joint_pos - self._finder.home) > AWAY)[self._finder.is_arm].any()
        goals = [self._place, self._home] if self.phase == "throw" else self._goals
        self._go_to(goals or ([self._home] if is_away else []), begin, FADE_STEPS)
        self._target = joint_pos

    def _go_to(self, goals: list[tuple[str, Joints]], begin: float, num_rests: int = 0) -> None:
        """Begin to move to goals, from a time on [s]; wait if there are none."""
        self.phase, self._goals, self.message = "move" if goals else "wait", goals, ""
        self._begin, self._motion, self._num_rests = begin, None, num_rests

    def decide(self, joint_pos: Joints, now: float) -> JointTargets | None:
        """Return joint targets as `PolicyPipeline.decide` does; between throws there always are some."""
        targets = None if self.phase == "move" else self._pipeline.decide(joint_pos, now)
        if targets and self.phase == "wait":
            self.phase, self.message, self._begin = "throw", "", now
            self._held_since, self._thrown, self._first = inf, inf, self._pipeline.sight.center
        if self.phase == "throw":
            goals = self._goals_after(joint_pos, now)
            if not goals:
                return targets and self._ramped(targets, now)
            self._go_to(goals, now)
        if self.phase == "move":
            self._move(joint_pos, now)
        return blind_targets(self._target, now)

    def _ramped(self, targets: JointTargets, now: float) -> JointTargets:
        """Let the targets go over from the start pose to the policy's, as the servo does once it is armed."""
        share = min((now - self._begin) / ServoLimits.ramp_time, 1.0)
        target = self._target + share * (targets.joint_pos_target - self._target)
        return replace(targets, joint_pos_target=target)

    def _goals_after(self, joint_pos: Joints, now: float) -> list[tuple[str, Joints]]:
        """Return the goals after a throw; none before its end."""
        sight = self._pipeline.sight
        distance = palm_distance(self._geometry, self._camera, joint_pos, sight.center)
        self._held_since = min(self._held_since, now) if distance < HELD_DISTANCE else inf
        if np.abs(sight.center - self._first).max() > FLIGHT:
            self._thrown = min(self._thrown, now)
        if now - self._held_since >= HELD_TIME:
            return [self._place, self._home]
        is_missed = now - sight.box_stamp > MISSED_TIME or now - self._thrown > FLIGHT_TIME
        return [self._home] if is_missed else []

    def _move(self, joint_pos: Joints, now: float) -> None:
        """Come to rest, search the path to the next goal, follow it, and wait after the last one."""
        what, goal = self._goals[0]
        if self._num_rests < FADE_STEPS:
            self._num_rests += 1
            self._target = self._pipeline.rest(joint_pos)
        elif self._motion is None:
            self._motion = self._executor.submit(self._finder.motion, self._target, goal)
        elif self._motion.done():
            motion = self._motion.result()
            if not self.message:
                self.message = f"{what}: {motion.duration:.0f} s of motion."
                self._begin = max(self._begin, now)
            self._target = motion.at(now + CONTROL_DT - self._begin)
            if now - self._begin > motion.duration:
                self._go_to(self._goals[1:], now, FADE_STEPS)
        if not self._goals:
            self.message = "The robot waits for the next throw: point at the object."
            self.begin_waiting()


def palm_distance(
    geometry: WorkcellGeometry, camera: CameraSpec, joint_pos: Joints, center: np.ndarray
) -> float:
    """Return the distance of the nearest palm from what is at a pixel, across the line of sight [m]."""
    palms, _ = geometry.palm_poses(torch.tensor(joint_pos[None], dtype=torch.float32))
    pixels, depths = (each[0].numpy() for each in project(camera, palms))
    return float((np.linalg.norm(pixels - center, axis=-1) * depths / camera.fx).min())
