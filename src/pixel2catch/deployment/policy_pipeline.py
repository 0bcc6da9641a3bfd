"""What happens in a control step between the newest image and the servo: perception, then the policy."""

from collections import deque
from dataclasses import dataclass
from math import inf

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from pixel2catch.agents import commands_of
from pixel2catch.camera.image import Box, Image, Verdict
from pixel2catch.deployment.sight import Sight, SightTrack
from pixel2catch.errors import DeploymentError, NonFiniteError, PolicyMismatchError
from pixel2catch.mdp.actions import ActionMap
from pixel2catch.mdp.observations import observe
from pixel2catch.mdp.snapshot import BoxHistory, History, Measurement
from pixel2catch.mdp.tensors import put
from pixel2catch.methods import Method
from pixel2catch.perception.regions import PlausibilityCfg
from pixel2catch.perception.robot_mask import RobotMask
from pixel2catch.perception.segmenter import Prompt, Segmenter
from pixel2catch.perception.tracker import ObjectTracker, Prompter
from pixel2catch.policy import LoadedPolicy, contract_of, method_of
from pixel2catch.robots.geometry import WorkcellGeometry
from pixel2catch.robots.workcell import WorkcellSpec
from pixel2catch.scene.constants import CONTROL_DT, RGB_CAMERA, CameraSpec
from pixel2catch.servo.limits import Joints
from pixel2catch.servo.link import JointTargets


@dataclass(frozen=True)
class _Past:
    """What is remembered from the step before."""

    history: History
    action: Float[Tensor, "1 num_joints"]
    joint_pos_target: Float[Tensor, "1 num_joints"]


class PolicyController:
    """A policy at its control rate: call `reset` before a throw, then `step` in every control step."""

    def __init__(self, policy: LoadedPolicy, workcell: WorkcellSpec, camera: CameraSpec = RGB_CAMERA) -> None:
        """Take over a policy, for the robots and the camera of the laboratory.

        Raises:
            PolicyMismatchError: It was trained for another robot or camera, or needs what no camera
                sees.
        """
        self.method = method_of(policy.contract)  #: What the policy was trained with.
        policy.contract.require(contract_of(self.method, workcell, camera))
        self._policy = policy
        self.object_radius = policy.contract.object_radius  #: Of the largest object that it knows [m].
        self._action_map = ActionMap.of(commands_of(workcell), torch.device("cpu"))
        self._geometry, self.joints = WorkcellGeometry(workcell), workcell.joints
        #: Which joints are an arm's, in joint order.
        self.is_arm = np.zeros(len(self.joints), dtype=bool)
        for columns in workcell.of_role("arm"):
            self.is_arm[columns] = True
        self._past: _Past | None = None
        self._held: Tensor | None = None
        nowhere = BoxHistory.begun(torch.zeros(1, 4), torch.zeros(1), self.method.num_boxes)
        at_zero = self._measure(torch.zeros(1, len(workcell.joints)), nowhere)
        _refuse_trackers(self.method, at_zero)

    def reset(self, joint_pos_target: Float[Tensor, "1 num_joints"] | None = None) -> None:
        """Begin a new throw, with joints that are held here [rad], or where they are measured."""
        self._past, self._held = None, joint_pos_target
        self._policy.reset()

    @property
    def measurement(self) -> Measurement | None:
        """What the policy saw in the last step; none before the first."""
        return None if self._past is None else self._past.history.now

    @torch.inference_mode()
    def step(
        self, joint_pos: Float[Tensor, "1 num_joints"], boxes: BoxHistory
    ) -> Float[Tensor, "1 num_joints"]:
        """Decide where the joints shall be at the end of the next control step [rad].

        Joint positions are in joint order [rad]; there are as many boxes as the method remembers.

        Raises:
            NonFiniteError: There is a NaN or an infinity; nothing is remembered of it.
        """
        self._refuse_non_finite(joint_pos, boxes)
        past, now = self._past, self._measure(joint_pos, boxes)
        history = History(now, now, now)
        if past is not None:
            history = History(past.history.before, past.history.now, now)
        layouts = self.method.layouts
        actions = self._policy.act(observe(layouts, history))
        action = put([(layout.joints, actions[name]) for name, layout in layouts.items()])
        target = self._action_map.joint_pos_target(action, now.joint_pos)
        self._past = _Past(history, action, target)
        return target

    def _refuse_non_finite(self, joint_pos: Float[Tensor, "1 num_joints"], boxes: BoxHistory) -> None:
        is_good = joint_pos.isfinite()[0].tolist()
        bad = [joint.name for joint, good in zip(self.joints, is_good, strict=True) if not good]
        bad += [] if boxes.box.isfinite().all() else ["the object's box"]
        bad += [] if boxes.age.isfinite().all() else ["the age of the object's box"]
        if bad:
            raise NonFiniteError(
                f"a reading has a NaN or an infinity for {', '.join(bad)}; stop, and look at what sent it."
            )

    def _measure(self, joint_pos: Float[Tensor, "1 num_joints"], boxes: BoxHistory) -> Measurement:
        """The measurement as the environment makes it; what only a tracker sees is not a number."""
        past = self._past
        palm_pos, palm_quat = self._geometry.palm_poses(joint_pos)
        held = joint_pos if self._held is None else self._held
        return Measurement(
            boxes=boxes,
            object_pos=_UNKNOWN,
            initial_object_pos=_UNKNOWN,
            joint_pos=joint_pos,
            joint_pos_target=held if past is None else past.joint_pos_target,
            palm_pos=palm_pos,
            palm_quat=palm_quat,
            action=torch.zeros_like(joint_pos) if past is None else past.action,
        )


_UNKNOWN = torch.full((1, 3), torch.nan)


def _refuse_trackers(method: Method, measurement: Measurement) -> None:
    """Refuse a method whose observation depends on what a measurement does not have."""
    for layout in method.layouts.values():
        frame, terms = layout.inputs(measurement, measurement), (*layout.terms, *layout.memory)
        blind = [term.__name__ for term in terms if not term(frame).isfinite().all()]
        if blind:
            raise PolicyMismatchError(
                f"a policy of method '{method.name}' reads {', '.join(blind)}, which one camera cannot give; "
                "deploy a policy that reads pixel features, such as 'proposed'."
            )


BOX_AGE = 1.8 * CONTROL_DT
"""How old the boxes are that a policy gets which does not know it, if images are not older [s]. Source: ours.

In training they are one or two control steps old. The policy leads the object by so much, and reaches beyond
it where boxes are younger: in simulation `proposed` catches 92 % of 200 throws with boxes one control step
old, 94 % with two, and 76 % with none. The same age in every step matters, too: with the box that is nearest
to an age, which is now of this image and now of the one before, it catches 69 % instead of 89 % of 150 throws
where perception takes 10 to 17 ms by chance.
"""

MEMORY = 8  #: Boxes that are kept at least, one an image.

LONGEST_LOOK = 0.4
"""Age of the newest image that was looked at from which perception hangs [s].

Source: ours; where an image takes 100 ms, it is up to 0.25 s old when the next one is done.
"""

FADE_STEPS = 5  #: Control steps in which an arm comes to rest while nothing is seen. Source: ours.


class PolicyPipeline:
    """Perception and policy, without a network and without a clock.

    Only `perceive` and `settle` may run in another thread than the rest, one after the other; nothing else
    of perception may run while `perceive` does.
    """

    def __init__(self, controller: PolicyController, tracker: ObjectTracker, person: Prompter) -> None:
        """Begin before the first throw, with a person that tells perception where the operator points."""
        self._controller, self._tracker, self._person = controller, tracker, person
        #: Whether the policy is told how old the boxes are. One that is not gets all of the same age.
        self.knows_age = controller.method.knows_age
        self.num_joints = len(controller.joints)
        num_boxes = max(MEMORY, controller.method.num_boxes)
        self._looked = -inf
        self._stamps: deque[float] = deque(maxlen=num_boxes)
        self._boxes: deque[Float[Tensor, " 4"]] = deque(maxlen=num_boxes)
        self.sight = SightTrack()  #: When the object was seen in this throw.
        self._target: Joints | None = None
        self._lead, self._num_held = np.zeros(self.num_joints), 0

    def forget(self) -> None:
        """A new throw begins for the policy: nothing is known of the object."""
        self._looked, self._target, self.sight = -inf, None, SightTrack()
        self._begin_track()

    def _begin_track(self) -> None:
        """What is seen next continues nothing; the joints are held where they are to be now."""
        target = self._target
        self._controller.reset(None if target is None else torch.tensor(target[None], dtype=torch.float32))
        self._stamps.clear()
        self._boxes.clear()
        self._num_held = 0

    def point(self, prompt: Prompt | None) -> None:
        """A new throw begins for the perception, which looks where the operator points."""
        self._tracker.reset()
        if prompt is not None:
            self._person.give(prompt)

    def perceive(self, image: Image, now: float) -> Box:
        """Look at the newest image: what takes most of the time.

        Now is a time [s] of the clock of the image's stamp.

        Raises:
            PerceptionError: The first image has the wrong size.
        """
        return self._tracker.step(image, now)

    def settle(self) -> None:
        """Learn from the last look what no decision waits for; the next look does it at the latest."""
        self._tracker.settle()

    def remember(self, box: Box) -> None:
        """Keep the box of an image for the policy.

        Where nothing was seen, the last box gets older for a policy that knows it; for another one it is also
        the box of this image, as in its training. A box that does not continue the one before, or that ends a
        hold, is the first.
        """
        if not box.is_valid or box.stamp <= self._looked:
            return
        self._looked = box.stamp
        self.sight.note(box)
        is_seen = box.verdict is Verdict.SEEN
        if is_seen and (box.is_elsewhere or self._num_held):
            self._begin_track()
        if is_seen or not self.knows_age:
            self._stamps.append(box.stamp)
            self._boxes.append(torch.tensor(box.edges))

    def decide(self, joint_pos: Joints, now: float) -> JointTargets | None:
        """Let the policy decide on what was seen, and on joints as they are now.

        In training it acts in the very moment in which the joints are measured. Positions that are as old as
        the perception takes cost `proposed` 5 of 100 throws (experiments/LOG.md).

        The newest joint positions are in joint order [rad], and NaN where unknown. Nothing is decided before
        the object is seen, nor without joint positions. When it was not seen for `LONGEST_GAP`, the policy is
        not asked: the arm comes to rest and stays, and the hand holds, until it is seen again. While the
        object has been still for `STILL_TIME` it is not asked, either: the targets stay.

        Raises:
            NonFiniteError: The policy is asked, and a joint position is infinite.
            DeploymentError: No image was looked at for long.
        """
        if not self._boxes or np.isnan(joint_pos).any():
            return None
        if now - self._looked > LONGEST_LOOK:
            raise DeploymentError(
                f"the newest image that was looked at is {now - self._looked:.1f} s old: look at the camera, "
                "and with 'pixel2catch track' at which stage of perception takes so long."
            )
        if self._target is not None and self.sight.at(now) is not Sight.SEEN:
            self._target = self._resting(joint_pos, self._target)
        elif self._target is None or not self.sight.is_still:
            boxes = self._measured(now) if self.knows_age else self._box_at(now - BOX_AGE)
            target = self._controller.step(torch.tensor(joint_pos[None], dtype=torch.float32), boxes)
            self._target = target[0].double().numpy()
        return JointTargets(
            joint_pos_target=self._target,
            target_stamp=now,
            image_stamp=self._looked,
            box_stamp=min(self.sight.box_stamp, now),
        )

    def _resting(self, joint_pos: Joints, target: Joints) -> Joints:
        """Targets after these with which the arm comes to rest evenly where it then is [rad]."""
        if self._num_held == 0:
            self._lead = target - joint_pos
        self._num_held += 1
        if self._num_held > FADE_STEPS:
            return target
        share = 1.0 - self._num_held / FADE_STEPS
        return np.where(self._controller.is_arm, joint_pos + share * self._lead, target)

    def _measured(self, now: float) -> BoxHistory:
        """The measured boxes, each as old as it is."""
        return BoxHistory.of_stamps(
            torch.stack(list(self._boxes)), list(self._stamps), now, self._controller.method.num_boxes
        )

    def _box_at(self, moment: float) -> BoxHistory:
        """Where the object was, between two images or in the newest one that is not newer [s]."""
        edges = np.transpose([box.numpy() for box in self._boxes])
        box = [np.interp(moment, self._stamps, edge) for edge in edges]
        return BoxHistory.begun(
            torch.tensor([box], dtype=torch.float32), torch.tensor([BOX_AGE / CONTROL_DT]), num_boxes=1
        )


def make_pipeline(
    controller: PolicyController,
    segmenter: Segmenter,
    prompter: Prompter,
    camera: CameraSpec,
    robot: RobotMask | None,
) -> PolicyPipeline:
    """Put perception and policy together.

    The prompter points the object out, and is told where the operator does. The motion of a robot that is
    given is not the object's.
    """
    limits = PlausibilityCfg.up_to(controller.object_radius)
    tracker = ObjectTracker(segmenter, prompter, robot=robot, camera=camera, limits=limits, waits=True)
    return PolicyPipeline(controller, tracker, prompter)
