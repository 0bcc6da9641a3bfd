"""What the robot does between throws without a person: it carries, releases, returns, and waits."""

from collections.abc import Callable
from concurrent.futures import Executor, Future
from dataclasses import replace
from functools import partial
from math import inf
from typing import Literal

import numpy as np
import torch

from pixel2catch.camera.pinhole import project
from pixel2catch.deployment.paths import SHARE, Motion, PathFinder
from pixel2catch.deployment.policy_pipeline import FADE_STEPS, PolicyPipeline
from pixel2catch.robots.geometry import WorkcellGeometry
from pixel2catch.ros2.profile import Profile
from pixel2catch.scene.constants import CONTROL_DT, CameraSpec
from pixel2catch.servo.limits import Joints, ServoLimits
from pixel2catch.servo.link import JointTargets
from pixel2catch.workcells import find_workcell

HELD_DISTANCE = 0.12
"""Largest distance of a held object from the palm, across the line of sight [m]. Source: ours."""

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
        executor: Executor | None = None,
    ) -> None:
        """Find the pose over a place; paths are searched by the executor, or at once.

        Raises:
            UnknownNameError: There is no such place.
            DeploymentError: No path leads there.
        """
        self.phase: Literal["wait", "throw", "move"] = "wait"
        self.message = ""  #: The announcement of the motion.
        self.begin_waiting: Callable[[], None] = lambda: None  #: Called when the robot begins to wait.
        self._pipeline, self._camera, self._executor = pipeline, camera, executor
        self._geometry = WorkcellGeometry(find_workcell(profile.workcell))
        self._finder, self._speed = PathFinder(profile, limits), SHARE * limits.joint_records["even_speed"]
        self._place = (f"to {place}", self._finder.pose_over(place))
        self._home = ("to the start pose", self._finder.home)
        self._goals: list[tuple[str, Joints]] = []
        self._motion: Future[Motion] | None = None
        self._target, self._begin, self._num_rests = self._finder.home, inf, 0
        self._held_since = self._thrown = inf
        self._first = np.full(2, np.nan)

    def arm(self, joint_pos: Joints, begin: float) -> None:
        """Hold the measured pose [rad] of a robot that was armed, and move on from a time on [s]."""
        is_away = (np.abs(joint_pos - self._finder.home) > AWAY)[self._finder.is_arm].any()
        if self.phase == "throw":
            self._goals = [self._place, self._home]
        elif is_away and not self._goals:
            self._goals = [self._home]
        self.phase = "move" if self._goals else "wait"
        self._target, self._begin, self._motion, self._num_rests = joint_pos, begin, None, FADE_STEPS

    def decide(self, joint_pos: Joints, now: float) -> JointTargets | None:
        """Return joint targets as `PolicyPipeline.decide` does; between throws there always are some."""
        targets = None if self.phase == "move" else self._pipeline.decide(joint_pos, now)
        if targets and self.phase == "wait":
            self.phase, self.message, self._begin = "throw", "", now
            self._held_since, self._thrown, self._first = inf, inf, self._pipeline.sight.center
        if self.phase == "throw":
            self._goals = self._goals_after(joint_pos, now)
            if not self._goals:
                return targets and self._ramped(targets, now)
            self.phase, self._begin, self._motion, self._num_rests = "move", now, None, 0
        if self.phase == "move":
            self._move(joint_pos, now)
        stamps = dict.fromkeys(("target_stamp", "image_stamp", "box_stamp"), now)
        return JointTargets(joint_pos_target=self._target, **stamps)

    def _ramped(self, targets: JointTargets, now: float) -> JointTargets:
        """Let the targets go over from the start pose to the policy's, as the servo does once it is armed."""
        share = min((now - self._begin) / ServoLimits.ramp_time, 1.0)
        target = self._target + share * (targets.joint_pos_target - self._target)
        return replace(targets, joint_pos_target=target)

    def _goals_after(self, joint_pos: Joints, now: float) -> list[tuple[str, Joints]]:
        """Return the goals after a throw; none before its end."""
        sight = self._pipeline.sight
        palms, _ = self._geometry.palm_poses(torch.tensor(joint_pos[None], dtype=torch.float32))
        pixels, depths = (each[0].numpy() for each in project(self._camera, palms))
        distances = np.linalg.norm(pixels - sight.center, axis=-1) * depths / self._camera.fx
        self._held_since = min(self._held_since, now) if distances.min() < HELD_DISTANCE else inf
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
            search = partial(self._finder.motion, self._target, goal, self._speed)
            self._motion = self._executor.submit(search) if self._executor else _done(search())
        elif self._motion.done():
            motion = self._motion.result()
            if not self.message.startswith(what):
                self.message, self._begin = f"{what}: {motion.in_words}", max(self._begin, now)
            self._target = motion.at(now + CONTROL_DT - self._begin)
            if now - self._begin > motion.duration:
                self._goals, self._motion, self.message = self._goals[1:], None, ""
        if not self._goals:
            self.phase, self.message = "wait", "The robot waits for the next throw: point at the object."
            self.begin_waiting()


def _done(motion: Motion) -> Future[Motion]:
    done = Future[Motion]()
    done.set_result(motion)
    return done
