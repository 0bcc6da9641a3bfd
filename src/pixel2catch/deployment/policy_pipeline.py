"""From an image to joint targets: perception, memory of the boxes, and the policy."""

from collections import deque
from math import inf

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from pixel2catch.agents import commands_of
from pixel2catch.camera.image import Box, Verdict
from pixel2catch.camera.level import level_boxes
from pixel2catch.camera.pinhole import nominal_projection
from pixel2catch.errors import DeploymentError, PolicyMismatchError
from pixel2catch.mdp.control_step import ActionMap, BoxHistory, History, Measurement
from pixel2catch.mdp.throws import ThrowCfg
from pixel2catch.perception.regions import PlausibilityCfg, RobotMask
from pixel2catch.perception.segmenter import BoxPrompt, Segmenter
from pixel2catch.perception.tracker import ObjectTracker, Prompter
from pixel2catch.policy import Policy, contract_of, method_of
from pixel2catch.policy.contract import unmeasured_terms
from pixel2catch.robots.geometry import WorkcellGeometry
from pixel2catch.robots.workcell import WorkcellSpec
from pixel2catch.scene.constants import CONTROL_DT, RGB_CAMERA, CameraSpec
from pixel2catch.servo.limits import LOSS_TIME, Joints
from pixel2catch.servo.link import JointTargets

Batch = Float[Tensor, "1 num_joints"]  #: Numbers of all joints, as policies take them.
_UNKNOWN = torch.full((1, 3), torch.nan)


def _batch(joint_pos: Joints) -> Batch:
    return torch.tensor(joint_pos[None], dtype=torch.float32)


class PolicyController:
    """A policy at its control rate: call `reset` before a throw, then `step` in every control step."""

    def __init__(self, policy: Policy, workcell: WorkcellSpec, camera: CameraSpec = RGB_CAMERA) -> None:
        """Raise PolicyMismatchError for another robot or camera, or inputs that no camera measures."""
        self.method = method_of(policy.contract)  #: The method that the policy was trained with.
        self.projection = nominal_projection(camera, torch.zeros(0))  #: The calibrated camera.
        policy.contract.require(contract_of(self.method, workcell, camera))
        self._policy = policy
        self.object_radius = policy.contract.object_radius  #: Of the largest object in training [m].
        self._action_map = ActionMap.of(commands_of(workcell), torch.device("cpu"))
        self._geometry, self.joints = WorkcellGeometry(workcell), workcell.joints
        roles = [group.role for group in workcell.groups for _ in group.joints]
        self.is_arm = np.array(roles) == "arm"  #: Whether each joint is an arm's.
        self.history: History | None = None  #: Measurements of this throw; None before its first step.
        self._action: Batch = torch.zeros(1, len(self.joints))
        self._target: Batch | None = None
        if unmeasured := dict.fromkeys(unmeasured_terms(self.method, workcell)):
            raise PolicyMismatchError(
                f"a policy of method '{self.method.name}' reads {', '.join(unmeasured)}, which one camera "
                "does not measure; deploy a policy that reads pixel features, such as 'proposed'."
            )

    def reset(self, joint_pos_target: Batch | None = None) -> None:
        """Start a new throw from these joint targets [rad]; None for the measured positions."""
        self.history, self._action, self._target = None, torch.zeros_like(self._action), joint_pos_target

    @torch.inference_mode()
    def step(self, joint_pos: Batch, boxes: BoxHistory) -> Batch:
        """Return the joint targets for the end of the next control step, by measured positions [rad]."""
        past, now = self.history, self._measure(joint_pos, boxes)
        history = History(past.before, past.now, now) if past else History(now, now, now)
        self._action = self.method.joint_actions(self._policy.act(self.method.observe(history)))
        self._target = self._action_map.joint_pos_target(self._action, now.joint_pos)
        self.history = history
        return self._target

    def _measure(self, joint_pos: Batch, boxes: BoxHistory) -> Measurement:
        """Return the measurement as the environment makes it, with NaN for what only a tracker measures."""
        palm_pos, palm_quat = self._geometry.palm_poses(joint_pos)
        return Measurement(
            boxes=boxes,
            camera_pos=self.projection.center[None],
            object_pos=_UNKNOWN,
            initial_object_pos=_UNKNOWN,
            joint_pos=joint_pos,
            joint_pos_target=joint_pos if self._target is None else self._target,
            palm_pos=palm_pos,
            palm_quat=palm_quat,
            action=self._action,
        )


LONGEST_GAP = 0.7  #: Age of a box from which the policy is not stepped [s]. Source: ours, rehearsals.
MOTION = 6.0  #: Change of the box centre from which the object has moved [px]. Source: ours.

STILL_TIME = (ThrowCfg().hover_steps[1] + 1) * CONTROL_DT
"""Time without motion after which the object is held or caught, and targets stay [s]. Source: ours, the
longest hover of the paper's task, which the shipped policies were trained with."""

NUM_JUMPS, NUM_IMAGES = 5, 30  #: Jumps in a number of images that no thrown object makes. Source: ours.


class ObjectSight:
    """When and where the object was seen in this throw, and whether its boxes can be one object's."""

    def __init__(self) -> None:
        self.box_stamp = -inf  #: Exposure time of the newest image with the object [s].
        self.center, self._moved = np.full(2, inf), -inf  # centre of the box [px], to `MOTION`
        self._jumps: deque[bool] = deque(maxlen=NUM_IMAGES)

    def update(self, box: Box) -> None:
        self._jumps.append(box.verdict is Verdict.JUMP)
        if box.verdict is Verdict.SEEN:
            center = np.reshape(box.edges, (2, 2)).mean(axis=0)
            if np.abs(center - self.center).max() > MOTION or box.stamp - self.box_stamp > LONGEST_GAP:
                self.center, self._moved = center, box.stamp
            self.box_stamp = box.stamp

    @property
    def is_still(self) -> bool:
        """Whether the object has not moved for `STILL_TIME`."""
        return self.box_stamp - self._moved >= STILL_TIME

    @property
    def problem(self) -> str:
        """Why the boxes cannot be one object's; empty if they can."""
        if sum(self._jumps) < NUM_JUMPS:
            return ""
        return (
            "the box jumps again and again further than a thrown object can move: remove other things of the "
            "object's looks, and flickering light. 'pixel2catch track' shows what is seen."
        )

    def at(self, now: float) -> str:
        """Return whether the object is seen at a time [s]: never seen, seen, searching or lost."""
        age = now - self.box_stamp
        if age <= LONGEST_GAP:
            return "seen"
        return "searching" if age <= LOSS_TIME else "lost" if age < inf else "never seen"


BOX_AGE = 1.8 * CONTROL_DT
"""Age of the box that a policy without ages gets, as in training; images may be older [s]. Source: ours."""

LEAST_SPACING = 0.75 * CONTROL_DT
"""Time from a kept box to the next, but for the newest [s]. Source: ours; a camera of 60 Hz then fills the
history as one of 30 Hz, which policies are trained with."""

MEMORY = 8  #: Least number of boxes that are kept, one for each image.
FADE_STEPS = 5  #: Control steps in which an arm comes to rest while nothing is seen. Source: ours.

LONGEST_PERCEPTION = 0.4  #: Age of the newest processed image that is a fault [s]. Source: ours.


class PolicyPipeline:
    """Perception and policy, without network and clock.

    The tracker may run in another thread than the rest. While it processes an image, `point` must not be
    called.
    """

    def __init__(
        self,
        controller: PolicyController,
        segmenter: Segmenter,
        prompter: Prompter,
        camera: CameraSpec = RGB_CAMERA,
        robot: RobotMask | None = None,
    ) -> None:
        """Start before the first throw, for objects up to the largest of the policy's training."""
        limits = PlausibilityCfg.up_to(controller.object_radius)
        self._controller, self._prompter = controller, prompter
        #: From images to boxes. It ignores motion where the robot mask covers the image.
        self.tracker = ObjectTracker(
            segmenter, prompter, robot=robot, camera=camera, limits=limits, waits=True
        )
        #: Whether the policy gets the age of each box. Without, all its boxes have the same age.
        self.knows_age = controller.method.knows_age
        self.num_joints = len(controller.joints)
        self._image_stamp = -inf
        self._boxes: deque[Box] = deque(maxlen=max(MEMORY, controller.method.num_boxes))
        self.sight = ObjectSight()  #: When the object was seen in this throw.
        self._target: Joints | None = None
        self._lead, self._num_held = np.zeros(self.num_joints), 0

    def begin_throw(self) -> None:
        self._image_stamp, self._target, self.sight = -inf, None, ObjectSight()
        self._begin_track()

    def _begin_track(self) -> None:
        """Drop all boxes, and start the policy from the present targets."""
        self._controller.reset(None if self._target is None else _batch(self._target))
        self._boxes.clear()
        self._num_held = 0

    def point(self, prompt: BoxPrompt | None) -> None:
        """Start a new throw of the perception, with the operator's prompt if there is one."""
        self.tracker.reset()
        if prompt is not None:
            self._prompter.give(prompt)

    def add_box(self, box: Box) -> None:
        """Keep the box of an image for the policy.

        Without a new box, the last one ages for a policy that knows ages; for another one it is also the box
        of this image, as in training. A box that starts elsewhere, or that ends a hold, is the first one.
        """
        if not box.is_valid or box.stamp <= self._image_stamp:
            return
        self._image_stamp = box.stamp
        self.sight.update(box)
        is_seen = box.verdict is Verdict.SEEN
        if is_seen and (box.is_elsewhere or self._num_held):
            self._begin_track()
        if is_seen or not self.knows_age:
            is_dense = len(self._boxes) > 1 and self._boxes[-1].stamp - self._boxes[-2].stamp < LEAST_SPACING
            if is_dense and self.knows_age:
                self._boxes.pop()
            self._boxes.append(box)

    def decide(self, joint_pos: Joints, now: float) -> JointTargets | None:
        """Return the joint targets for the boxes so far; None before the first box or without all joints.

        After `LONGEST_GAP` without a box the arm comes to rest and the hand holds, until the object is seen
        again. While it has been still for `STILL_TIME`, the targets stay. Raises DeploymentError if the
        newest processed image is older than `LONGEST_PERCEPTION`. As in training, joint positions [rad] are
        measured at the time of the decision [s], not of the image; they are not finite where unknown.
        """
        if not (self._boxes and np.isfinite(joint_pos).all()):
            return None
        if now - self._image_stamp > LONGEST_PERCEPTION:
            raise DeploymentError(
                f"the newest processed image is {now - self._image_stamp:.1f} s old: check the camera, and "
                "with 'pixel2catch track' which stage of perception is slow."
            )
        if self._target is not None and self.sight.at(now) != "seen":
            self._target = self.rest(joint_pos)
        elif self._target is None or not self.sight.is_still:
            boxes = self._measured_boxes(now) if self.knows_age else self._box_at(now - BOX_AGE)
            self._target = self._controller.step(_batch(joint_pos), boxes)[0].double().numpy()
        return JointTargets(
            joint_pos_target=self._target,
            target_stamp=now,
            image_stamp=self._image_stamp,
            box_stamp=min(self.sight.box_stamp, now),
        )

    def rest(self, joint_pos: Joints) -> Joints:
        """Return targets whose lead of the arm's joints fades to zero in `FADE_STEPS` control steps [rad]."""
        target = joint_pos if self._target is None else self._target
        if self._num_held == 0:
            self._lead = target - joint_pos
        self._num_held += 1
        if self._num_held <= FADE_STEPS:
            faded = joint_pos + (1.0 - self._num_held / FADE_STEPS) * self._lead
            target = np.where(self._controller.is_arm, faded, target)
        self._target = target
        return target

    def _measured_boxes(self, now: float) -> BoxHistory:
        edges = torch.tensor([box.edges for box in self._boxes], dtype=torch.float32)
        stamps, method = [box.stamp for box in self._boxes], self._controller.method
        if method.is_levelled:
            edges = level_boxes(edges, self._controller.projection)
        return BoxHistory.of_stamps(edges, stamps, now, method.num_boxes)

    def _box_at(self, moment: float) -> BoxHistory:
        """Return the box at a time [s], interpolated between two images; the newest one if it is older."""
        stamps = [box.stamp for box in self._boxes]
        box = [np.interp(moment, stamps, edge) for edge in np.transpose([box.edges for box in self._boxes])]
        return BoxHistory.begun(
            torch.tensor([box], dtype=torch.float32), torch.tensor([BOX_AGE / CONTROL_DT]), num_boxes=1
        )
