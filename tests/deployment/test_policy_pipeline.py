"""From an image to orders: what the perception sees is what the policy gets."""

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch
from loop_lab import (
    BOX,
    HOME,
    PROFILE,
    RED,
    Edges,
    EverythingRed,
    moved,
    new_pipeline,
    picture,
    remembering,
)

from pixel2catch.camera.image import Box, Image, Verdict
from pixel2catch.deployment.policy_pipeline import (
    BOX_AGE,
    FADE_STEPS,
    LONGEST_LOOK,
    PolicyController,
    PolicyPipeline,
    make_pipeline,
)
from pixel2catch.deployment.sight import LONGEST_GAP, MOTION, NUM_JUMPS, STILL_TIME
from pixel2catch.errors import DeploymentError
from pixel2catch.evaluation.loading import load_policy
from pixel2catch.mdp.snapshot import BoxHistory
from pixel2catch.perception.segmenter import BoxPrompt, ColorThreshold
from pixel2catch.perception.tracker import Prompter
from pixel2catch.scene.constants import CONTROL_DT, RGB_CAMERA
from pixel2catch.servo.limits import LOSS_TIME
from pixel2catch.servo.link import JointTargets
from pixel2catch.workcells import find_workcell
from pixel2catch.workcells.ur5e_allegro import UR5E_ALLEGRO

PROMPT = BoxPrompt(box=BOX)


def frame(stamp: float, by: float = 0.0) -> Image:
    return Image(pixels=picture(moved(by)), stamp=stamp)


def see(pipeline: PolicyPipeline, frame: Image, now: float) -> Box:
    box = pipeline.perceive(frame, now)
    pipeline.remember(box)
    return box


def think(pipeline: PolicyPipeline, frame: Image, joint_pos: np.ndarray, now: float) -> JointTargets | None:
    see(pipeline, frame, now)
    return pipeline.decide(joint_pos, now)


def test_nothing_is_ordered_before_the_object_is_pointed_out():
    pipeline = new_pipeline()
    assert see(pipeline, frame(1.0), 1.01).verdict is Verdict.NO_PROMPT
    assert pipeline.decide(HOME, 1.01) is None


@pytest.mark.parametrize(
    ("name", "expected"), [("two_ur5e_allegro", Verdict.SEEN), ("proposed", Verdict.NOT_FOUND)]
)
def test_what_the_policy_was_trained_for_is_never_too_large(name: str, expected: Verdict):
    """A box of 28 cm where it is caught, which cannot be one of the paper's objects."""
    policy, _ = load_policy(Path(name))
    controller = PolicyController(policy, find_workcell(policy.contract.workcell))
    pipeline = make_pipeline(controller, ColorThreshold(RED), Prompter(), RGB_CAMERA, None)
    large = (300.0, 200.0, 460.0, 360.0)
    pipeline.point(BoxPrompt(box=large))
    assert see(pipeline, Image(pixels=picture(large), stamp=1.0), 1.01).verdict is expected


@pytest.mark.parametrize(
    ("age", "num_late"),
    [(BOX_AGE, 0.0), (BOX_AGE - 0.25 * CONTROL_DT, 0.25), (BOX_AGE - CONTROL_DT, 1.0), (BOX_AGE + 0.01, 0.0)],
)
def test_orders_are_the_controllers_for_boxes_as_old_as_in_training(age: float, num_late: float):
    """Where images are younger than that, the policy gets what was between them; where older, the newest."""
    pipeline = new_pipeline()
    policy, _ = load_policy(Path("proposed"))
    controller = PolicyController(policy, find_workcell(PROFILE.workcell))
    pipeline.point(PROMPT)
    joint_pos = torch.from_numpy(HOME[None]).float()
    for step in range(4):
        now = 1.0 + step * CONTROL_DT
        joint_targets = think(pipeline, frame(now - age, 4.0 * step), HOME, now)
        assert joint_targets is not None
        box = torch.tensor([moved(4.0 * max(step - num_late, 0.0))])
        boxes = BoxHistory.begun(box, torch.tensor([1.8]), 1)
        expected = controller.step(joint_pos, boxes)[0].numpy()
        assert joint_targets.joint_pos_target == pytest.approx(expected, abs=1e-6)
        assert (joint_targets.target_stamp, joint_targets.image_stamp) == (now, now - age)


def test_a_missing_image_repeats_the_box_and_keeps_its_stamp():
    pipeline = new_pipeline()
    pipeline.point(PROMPT)
    shown = frame(1.0)
    think(pipeline, shown, HOME, 1.01)
    assert see(pipeline, shown, 1.01 + CONTROL_DT).verdict is Verdict.REPEATED
    again = pipeline.decide(HOME, 1.01 + CONTROL_DT)
    assert again is not None
    assert again.image_stamp == 1.0


def test_unknown_joints_give_no_orders():
    pipeline = new_pipeline()
    pipeline.point(PROMPT)
    unknown = np.where(np.arange(len(HOME)) == 3, np.nan, HOME)
    assert think(pipeline, frame(1.0), unknown, 1.01) is None
    assert think(pipeline, frame(1.03), HOME, 1.04) is not None


def test_a_new_throw_forgets_the_old_one():
    """Its first orders are those of a fresh control loop."""
    used, fresh = new_pipeline(), new_pipeline()
    used.point(PROMPT)
    for step in range(3):
        think(used, frame(step * CONTROL_DT, 9.0 * step), HOME, step * CONTROL_DT)
    for pipeline in (used, fresh):
        pipeline.forget()
        pipeline.point(PROMPT)
    assert used.decide(HOME, 9.0) is None
    first, expected = (think(pipeline, frame(9.0), HOME, 9.01) for pipeline in (used, fresh))
    assert first is not None
    assert expected is not None
    assert np.array_equal(first.joint_pos_target, expected.joint_pos_target)


def seen_boxes(controller: PolicyController) -> BoxHistory:
    assert controller.measurement is not None
    return controller.measurement.boxes


def test_a_policy_that_knows_ages_gets_what_was_measured_when_it_was_measured():
    """Nothing between two images, and no box of an image in which nothing was found."""
    controller = remembering()
    pipeline = new_pipeline(controller=controller)
    pipeline.point(PROMPT)
    stamps = [1.0, 1.0 + CONTROL_DT, 1.0 + 4.0 * CONTROL_DT]
    for step, stamp in enumerate(stamps):
        assert think(pipeline, frame(stamp, 4.0 * step), HOME, stamp + 0.06)
    see(pipeline, Image(pixels=picture(None), stamp=1.0 + 5.0 * CONTROL_DT), 1.0 + 6.0 * CONTROL_DT)
    now = 1.0 + 6.5 * CONTROL_DT
    joint_targets = pipeline.decide(HOME, now)
    assert joint_targets is not None
    assert joint_targets.image_stamp == 1.0 + 5.0 * CONTROL_DT
    boxes = seen_boxes(controller)
    assert boxes.age[0].tolist() == pytest.approx([2.5, 5.5, 6.5, 7.5, 8.5, 9.5, 10.5, 11.5], abs=1e-4)
    assert boxes.box[0].tolist() == [list(moved(by)) for by in (8.0, 4.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)]


@pytest.mark.parametrize("memory", ["age", "boxes", "fit"])
def test_as_many_boxes_are_kept_as_the_policy_remembers(memory: str):
    controller = remembering(f"shared_reward+{memory}")
    pipeline = new_pipeline(controller=controller)
    pipeline.point(PROMPT)
    for step in range(30):
        see(pipeline, frame(step * CONTROL_DT, step), step * CONTROL_DT)
    pipeline.decide(HOME, 29.5 * CONTROL_DT)
    ages = seen_boxes(controller).age[0].tolist()
    assert ages == pytest.approx([0.5 + i for i in range(controller.method.num_boxes)], abs=1e-3)


def test_a_perception_that_hangs_is_said_and_gives_no_orders():
    """A policy that knows ages may act on an old box, but only while images are looked at."""
    pipeline = new_pipeline(controller=remembering())
    pipeline.point(PROMPT)
    see(pipeline, frame(1.0), 1.02)
    for step in range(1, 30):
        stamp = 1.0 + step * CONTROL_DT
        see(pipeline, Image(pixels=picture(None), stamp=stamp), stamp)
        assert pipeline.decide(HOME, stamp)
    with pytest.raises(DeploymentError, match=r"looked at is 0\.4 s old"):
        pipeline.decide(HOME, 1.0 + 29 * CONTROL_DT + LONGEST_LOOK + 0.01)


ARM = slice(0, 6)


def run(pipeline: PolicyPipeline, steps: range, box: Edges | None) -> np.ndarray:
    """Targets of control steps in which the joints are where they were to be; each image is 20 ms old."""
    targets, joint_pos = list[np.ndarray](), HOME
    for step in steps:
        stamp = step * CONTROL_DT
        command = think(
            pipeline, Image(pixels=picture(box), stamp=stamp), joint_pos + 0.01 * step, stamp + 0.02
        )
        assert command is not None
        assert command.box_stamp == pipeline.sight.box_stamp
        targets.append(command.joint_pos_target)
    return np.array(targets)


@pytest.mark.parametrize("is_told", [False, True])
def test_while_nothing_is_seen_the_arm_comes_to_rest_and_the_hand_holds(is_told: bool):
    """The policy goes on for the gaps of its training; at rest no target changes, whatever the joints do."""
    pipeline = new_pipeline(controller=remembering() if is_told else None)
    pipeline.point(PROMPT)
    run(pipeline, range(4), BOX)
    last, num = 3, round(LONGEST_GAP / CONTROL_DT)
    blind = run(pipeline, range(last + 1, last + 40), None)
    going_on, held = blind[: num - 1], blind[num - 1 :]
    assert (np.abs(np.diff(going_on[:, ARM], axis=0)).max(axis=1) > 0.0).all()
    assert not np.diff(held[:, 6:], axis=0).any()
    assert np.diff(held[:FADE_STEPS, ARM], axis=0).any()
    assert not np.diff(held[FADE_STEPS - 1 :], axis=0).any()
    rest = HOME + 0.01 * (last + num + FADE_STEPS - 1)
    assert held[-1, ARM] == pytest.approx(rest[ARM])


def test_seen_again_the_policy_goes_on_as_from_the_pose_that_was_held():
    used, fresh = (remembering("shared_reward+age") for _ in range(2))
    pipeline = new_pipeline(controller=used)
    pipeline.point(PROMPT)
    run(pipeline, range(4), BOX)
    held = run(pipeline, range(4, 40), None)[-1]
    again = think(pipeline, frame(2.0), HOME, 2.02)
    fresh.reset(torch.tensor(held[None], dtype=torch.float32))
    boxes = BoxHistory.begun(torch.tensor([BOX]), torch.tensor([0.02 / CONTROL_DT]), 1)
    expected = fresh.step(torch.tensor(HOME[None], dtype=torch.float32), boxes)[0].numpy()
    assert again is not None
    assert again.joint_pos_target == pytest.approx(expected, abs=1e-6)
    assert again.box_stamp == 2.0


def test_while_the_object_is_still_for_long_the_targets_stay():
    """However the joints move, and whoever holds it trembles; the first image of its flight ends that."""
    pipeline = new_pipeline()
    pipeline.point(PROMPT)
    num_asked, targets = round(STILL_TIME / CONTROL_DT), []
    places = [*((-1) ** step * 0.4 * MOTION for step in range(num_asked + 10)), 2.0 * MOTION, 3.0 * MOTION]
    for step, place in enumerate(places):
        now = step * CONTROL_DT
        joint_targets = think(pipeline, frame(now, place), HOME + 0.001 * step, now)
        assert joint_targets is not None
        targets.append(joint_targets.joint_pos_target)
    has_changed = [not np.array_equal(*pair) for pair in pairwise(targets)]
    assert has_changed == (num_asked - 1) * [True] + 10 * [False] + [True, True]


def test_the_words_for_what_is_known_of_the_object():
    pipeline = new_pipeline()
    assert pipeline.sight.at(9.0) == "never seen"
    pipeline.point(PROMPT)
    see(pipeline, frame(1.0), 1.02)
    ages = (0.02, LONGEST_GAP - 0.001, LONGEST_GAP + 0.001, LOSS_TIME - 0.001, LOSS_TIME + 0.001)
    words = [str(pipeline.sight.at(1.0 + age)) for age in ages]
    assert words == ["seen", "seen", "searching", "searching", "lost"]
    pipeline.forget()
    assert pipeline.sight.at(1.1) == "never seen"


@pytest.mark.parametrize("is_told", [False, True])
def test_a_box_that_jumps_never_reaches_the_policy_as_motion(is_told: bool):
    """Another thing, 250 px off, is refused until it can be the same; then it is one that stands still."""
    policy, _ = load_policy(Path("proposed"))
    controller = remembering() if is_told else PolicyController(policy, UR5E_ALLEGRO)
    pipeline = new_pipeline(EverythingRed(), controller)
    pipeline.point(PROMPT)
    verdicts, boxes = list[str](), list[torch.Tensor]()
    for step in range(8):
        stamp = step * CONTROL_DT
        seen = see(pipeline, frame(stamp, 0.0 if step < 3 else 180.0), stamp + 0.02)
        assert pipeline.decide(HOME, stamp + 0.02)
        verdicts.append(str(seen.verdict))
        boxes.append(seen_boxes(controller).box[0])
    assert verdicts == ["seen"] * 3 + ["jump"] * 2 + ["seen"] * 3
    for known in boxes:
        assert not (known[1:] - known[:-1]).any()
    assert boxes[4][0].tolist() == list(BOX)
    assert boxes[5][0].tolist() == list(moved(180.0))
    assert pipeline.sight.problem == ""


def test_a_box_that_jumps_again_and_again_is_no_objects():
    pipeline = new_pipeline(EverythingRed())
    pipeline.point(PROMPT)
    for step in range(2 * NUM_JUMPS):
        see(pipeline, frame(step * CONTROL_DT, 150.0 * (step % 2)), step * CONTROL_DT)
    assert "no thrown one can be" in pipeline.sight.problem
    pipeline.forget()
    assert pipeline.sight.problem == ""
