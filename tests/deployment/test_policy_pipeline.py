"""From an image to joint targets: what perception sees is what the policy gets."""

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch
from loop_lab import BOX, HOME, RED, EverythingRed, forgetting, moved, new_pipeline, picture, remembering

from pixel2catch.camera.image import Box, Edges, Image, Verdict
from pixel2catch.deployment import policy_pipeline as limits
from pixel2catch.deployment.policy_pipeline import FADE_STEPS, LONGEST_GAP, PolicyController, PolicyPipeline
from pixel2catch.errors import DeploymentError
from pixel2catch.evaluation.loading import load_policy
from pixel2catch.mdp.control_step import BoxHistory
from pixel2catch.perception.segmenter import BoxPrompt
from pixel2catch.scene.constants import CONTROL_DT
from pixel2catch.servo.link import JointTargets
from pixel2catch.workcells import find_workcell

PROMPT = BoxPrompt(box=BOX)
ARM = slice(0, 6)


def image(stamp: float, by: float = 0.0) -> Image:
    return Image(pixels=picture(moved(by)), stamp=stamp)


def see(pipeline: PolicyPipeline, image: Image, now: float) -> Box:
    box = pipeline.tracker.step(image, now)
    pipeline.add_box(box)
    return box


def decide(pipeline: PolicyPipeline, image: Image, joint_pos: np.ndarray, now: float) -> JointTargets:
    see(pipeline, image, now)
    targets = pipeline.decide(joint_pos, now)
    assert targets is not None
    return targets


def pointed(pipeline: PolicyPipeline) -> PolicyPipeline:
    pipeline.point(PROMPT)
    return pipeline


def test_there_are_no_targets_before_the_prompt_and_without_all_joints():
    pipeline = new_pipeline()
    assert see(pipeline, image(1.0), 1.01).verdict is Verdict.NO_PROMPT
    assert pipeline.sight.at(99.0) == "never seen"
    assert pipeline.decide(HOME, 1.01) is None
    pipeline.point(PROMPT)
    for step, bad in enumerate((np.nan, -np.inf)):
        unknown = np.where(np.arange(len(HOME)) == 3, bad, HOME)
        see(pipeline, image(1.03 + 0.03 * step), 1.04 + 0.03 * step)
        assert pipeline.decide(unknown, 1.04 + 0.03 * step) is None
    decide(pipeline, image(1.09), HOME, 1.10)


def test_an_object_of_the_training_is_never_too_large():
    """A box of 28 cm where it is caught."""
    policy, large = load_policy(Path("two_ur5e_allegro"))[0], (300.0, 200.0, 460.0, 360.0)
    controller = PolicyController(policy, find_workcell(policy.contract.workcell))
    pipeline = new_pipeline(controller=controller)
    pipeline.point(BoxPrompt(box=large))
    assert see(pipeline, Image(pixels=picture(large), stamp=1.0), 1.01).verdict is Verdict.SEEN


@pytest.mark.parametrize(
    ("age", "num_late"),
    [(limits.BOX_AGE, 0.0), (limits.BOX_AGE - 0.25 * CONTROL_DT, 0.25), (limits.BOX_AGE + 0.01, 0.0)],
)
def test_a_policy_without_ages_gets_boxes_as_old_as_in_training(age: float, num_late: float):
    """Between two younger images; of the newest image if it is older."""
    pipeline = pointed(new_pipeline())
    controller = forgetting()
    joint_pos = torch.from_numpy(HOME[None]).float()
    for step in range(4):
        now = 1.0 + step * CONTROL_DT
        targets = decide(pipeline, image(now - age, 4.0 * step), HOME, now)
        box = torch.tensor([moved(4.0 * max(step - num_late, 0.0))])
        expected = controller.step(joint_pos, BoxHistory.begun(box, torch.tensor([1.8]), 1))[0].numpy()
        assert targets.joint_pos_target == pytest.approx(expected, abs=1e-6)
        assert (targets.target_stamp, targets.image_stamp) == (now, now - age)


def test_a_new_throw_starts_as_a_new_pipeline():
    used, fresh = pointed(new_pipeline()), new_pipeline()
    for step in range(3):
        decide(used, image(step * CONTROL_DT, 9.0 * step), HOME, step * CONTROL_DT)
    for pipeline in (used, fresh):
        pipeline.begin_throw()
        pipeline.point(PROMPT)
    assert used.decide(HOME, 9.0) is None
    first, expected = (decide(pipeline, image(9.0), HOME, 9.01) for pipeline in (used, fresh))
    assert np.array_equal(first.joint_pos_target, expected.joint_pos_target)


def policy_boxes(controller: PolicyController) -> BoxHistory:
    assert controller.history is not None
    return controller.history.now.boxes


def test_a_policy_with_ages_gets_the_measured_boxes_with_their_ages():
    """Nothing between two images, no box of an image without the object, and that of a repeated one once."""
    controller = remembering()
    pipeline = pointed(new_pipeline(controller=controller))
    for step, stamp in enumerate((1.0, 1.0 + CONTROL_DT, 1.0 + 4.0 * CONTROL_DT)):
        decide(pipeline, image(stamp, 4.0 * step), HOME, stamp + 0.06)
    without = Image(pixels=picture(None), stamp=1.0 + 5.0 * CONTROL_DT)
    assert see(pipeline, without, 1.0 + 6.0 * CONTROL_DT).verdict is Verdict.NOT_FOUND
    assert see(pipeline, without, 1.0 + 6.5 * CONTROL_DT).verdict is Verdict.REPEATED
    targets = pipeline.decide(HOME, 1.0 + 6.5 * CONTROL_DT)
    assert targets is not None
    assert targets.image_stamp == 1.0 + 5.0 * CONTROL_DT
    boxes = policy_boxes(controller)
    assert boxes.age[0].tolist() == pytest.approx([2.5, 5.5, 6.5, 7.5, 8.5, 9.5, 10.5, 11.5], abs=1e-4)
    assert boxes.box[0].tolist() == [list(moved(by)) for by in (8.0, 4.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)]


def test_a_camera_of_60_images_a_second_fills_the_history_as_one_of_30():
    controller = remembering()
    pipeline = pointed(new_pipeline(controller=controller))
    for half_step in range(13):
        stamp = 1.0 + half_step * CONTROL_DT / 2.0
        see(pipeline, image(stamp, 4.0 * half_step), stamp)
    assert pipeline.decide(HOME, 1.0 + 6.0 * CONTROL_DT) is not None
    boxes = policy_boxes(controller)
    assert boxes.age[0].tolist() == pytest.approx([0, 1, 2, 3, 4, 5, 6, 7], abs=1e-4)
    assert boxes.box[0, :7].tolist() == [list(moved(8.0 * step)) for step in range(6, -1, -1)]


def test_a_perception_that_hangs_is_an_error():
    """A policy with ages may act on an old box, but only while images are processed."""
    pipeline = pointed(new_pipeline(controller=remembering()))
    see(pipeline, image(1.0), 1.02)
    for step in range(1, 15):
        stamp = 1.0 + step * CONTROL_DT
        see(pipeline, Image(pixels=picture(None), stamp=stamp), stamp)
        assert pipeline.decide(HOME, stamp)
    with pytest.raises(DeploymentError, match=r"0\.4 s old"):
        pipeline.decide(HOME, 1.0 + 14 * CONTROL_DT + limits.LONGEST_PERCEPTION + 0.01)


def run(pipeline: PolicyPipeline, steps: range, box: Edges | None) -> np.ndarray:
    """Targets of control steps with joints that move by 0.01 rad in each; each image is 20 ms old."""
    targets = list[np.ndarray]()
    for step in steps:
        stamp = step * CONTROL_DT
        shown = Image(pixels=picture(box), stamp=stamp)
        decided = decide(pipeline, shown, HOME + 0.01 * step, stamp + 0.02)
        assert decided.box_stamp == pipeline.sight.box_stamp
        targets.append(decided.joint_pos_target)
    return np.array(targets)


@pytest.mark.parametrize("has_ages", [False, True])
def test_while_nothing_is_seen_the_arm_comes_to_rest_and_the_hand_holds(has_ages: bool):
    """The policy acts during the gaps of its training; at rest no target changes, whatever the joints do."""
    pipeline = pointed(new_pipeline(controller=remembering() if has_ages else None))
    run(pipeline, range(4), BOX)
    last, num = 3, round(LONGEST_GAP / CONTROL_DT)
    blind = run(pipeline, range(last + 1, last + 40), None)
    acting, held = blind[: num - 1], blind[num - 1 :]
    assert (np.abs(np.diff(acting[:, ARM], axis=0)).max(axis=1) > 0.0).all()
    assert not np.diff(held[:, 6:], axis=0).any()
    assert np.diff(held[:FADE_STEPS, ARM], axis=0).any()
    assert not np.diff(held[FADE_STEPS - 1 :], axis=0).any()
    rest = HOME + 0.01 * (last + num + FADE_STEPS - 1)
    assert held[-1, ARM] == pytest.approx(rest[ARM])


def test_an_object_that_is_seen_again_starts_the_policy_from_the_held_pose():
    used, fresh = (remembering("shared_reward+age") for _ in range(2))
    pipeline = pointed(new_pipeline(controller=used))
    run(pipeline, range(4), BOX)
    held = run(pipeline, range(4, 40), None)[-1]
    again = decide(pipeline, image(2.0), HOME, 2.02)
    fresh.reset(torch.tensor(held[None], dtype=torch.float32))
    boxes = BoxHistory.begun(torch.tensor([BOX]), torch.tensor([0.02 / CONTROL_DT]), 1)
    expected = fresh.step(torch.tensor(HOME[None], dtype=torch.float32), boxes)[0].numpy()
    assert again.joint_pos_target == pytest.approx(expected, abs=1e-6)
    assert again.box_stamp == 2.0


def test_while_the_object_is_still_for_long_the_targets_stay():
    """However the joints move, and a little trembling; the first image of the flight ends that."""
    pipeline = pointed(new_pipeline())
    num_moving, targets = round(limits.STILL_TIME / CONTROL_DT), []
    places = [
        *((-1) ** step * 0.4 * limits.MOTION for step in range(num_moving + 10)),
        2.0 * limits.MOTION,
        3.0 * limits.MOTION,
    ]
    for step, place in enumerate(places):
        now = step * CONTROL_DT
        decided = decide(pipeline, image(now, place), HOME + 0.001 * step, now)
        targets.append(decided.joint_pos_target)
    has_changed = [not np.array_equal(*pair) for pair in pairwise(targets)]
    assert has_changed == (num_moving - 1) * [True] + 10 * [False] + [True, True]


@pytest.mark.parametrize("has_ages", [False, True])
def test_a_box_that_jumps_never_reaches_the_policy_as_motion(has_ages: bool):
    """Another thing, 250 px off, is refused until it can be the same; then it is one that stands still."""
    controller = remembering() if has_ages else forgetting()
    pipeline = pointed(new_pipeline(EverythingRed(RED), controller))
    verdicts, boxes = list[str](), list[torch.Tensor]()
    for step in range(8):
        stamp = step * CONTROL_DT
        box = see(pipeline, image(stamp, 0.0 if step < 3 else 180.0), stamp + 0.02)
        assert pipeline.decide(HOME, stamp + 0.02)
        verdicts.append(str(box.verdict))
        boxes.append(policy_boxes(controller).box[0])
    assert verdicts == ["seen"] * 3 + ["jump"] * 2 + ["seen"] * 3
    for known in boxes:
        assert not (known[1:] - known[:-1]).any()
    assert boxes[4][0].tolist() == list(BOX)
    assert boxes[5][0].tolist() == list(moved(180.0))
    assert pipeline.sight.problem == ""


def test_a_box_that_jumps_again_and_again_is_a_problem():
    pipeline = pointed(new_pipeline(EverythingRed(RED)))
    for step in range(2 * limits.NUM_JUMPS):
        see(pipeline, image(step * CONTROL_DT, 150.0 * (step % 2)), step * CONTROL_DT)
    assert "jumps" in pipeline.sight.problem
    pipeline.begin_throw()
    assert pipeline.sight.problem == ""
