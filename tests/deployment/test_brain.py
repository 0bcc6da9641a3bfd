"""From an image to orders: what the perception sees is what the policy gets."""

import numpy as np
import pytest
import torch
from loop_lab import BOX, HOME, PROFILE, brain, picture

from pixel2catch.deployment.controller import Controller
from pixel2catch.evaluation.loading import load_policy
from pixel2catch.perception.finder import CameraFrame
from pixel2catch.perception.gate import Verdict
from pixel2catch.perception.segmenter import BoxPrompt
from pixel2catch.robot.constants import CONTROL_DT

PROMPT = BoxPrompt(box=BOX)


def moved(by: float) -> tuple[float, float, float, float]:
    xmin, ymin, xmax, ymax = BOX
    return xmin + by, ymin + by, xmax + by, ymax + by


def frame(stamp: float, by: float = 0.0) -> CameraFrame:
    return CameraFrame(image=picture(moved(by)), stamp=stamp)


def test_nothing_is_ordered_before_the_object_is_pointed_out():
    thinking = brain()
    thinking.begin()
    thought = thinking.think(frame(1.0), HOME, 1.01)
    assert thought.extraction.verdict is Verdict.NO_PROMPT
    assert thought.orders is None


@pytest.mark.parametrize(("age", "num_late"), [(0.01, 1), (0.03, 1), (0.035, 0), (0.06, 0)])
def test_orders_are_the_controllers_for_boxes_as_old_as_in_training(age: float, num_late: int):
    """One to two control steps: where images are younger, the policy gets the box before."""
    thinking = brain()
    policy, _ = load_policy(None)
    controller = Controller(policy, PROFILE.handedness)
    thinking.begin(PROMPT)
    joint_pos = torch.from_numpy(HOME[None]).float()
    for step in range(4):
        now = 1.0 + step * CONTROL_DT
        orders = thinking.think(frame(now - age, 4.0 * step), HOME, now).orders
        assert orders is not None
        box = torch.tensor([moved(4.0 * max(step - num_late, 0))])
        expected = controller.step(joint_pos, box)[0].numpy()
        assert orders.joint_pos_target == pytest.approx(expected, abs=1e-6)
        assert (orders.target_stamp, orders.image_stamp) == (now, now - age)


def test_a_missing_image_repeats_the_box_and_keeps_its_stamp():
    thinking = brain()
    thinking.begin(PROMPT)
    shown = frame(1.0)
    thinking.think(shown, HOME, 1.01)
    again = thinking.think(shown, HOME, 1.01 + CONTROL_DT)
    assert again.extraction.verdict is Verdict.REPEATED
    assert again.orders is not None
    assert again.orders.image_stamp == 1.0


def test_unknown_joints_give_no_orders():
    thinking = brain()
    thinking.begin(PROMPT)
    unknown = np.where(np.arange(len(HOME)) == 3, np.nan, HOME)
    assert thinking.think(frame(1.0), unknown, 1.01).orders is None
    assert thinking.think(frame(1.03), HOME, 1.04).orders is not None


def test_a_new_throw_forgets_the_old_one():
    """Its first orders are those of a fresh brain."""
    used, fresh = brain(), brain()
    used.begin(PROMPT)
    for step in range(3):
        used.think(frame(step * CONTROL_DT, 9.0 * step), HOME, step * CONTROL_DT)
    for thinking in (used, fresh):
        thinking.begin(PROMPT)
    first, expected = (thinking.think(frame(9.0), HOME, 9.01).orders for thinking in (used, fresh))
    assert first is not None
    assert expected is not None
    assert np.array_equal(first.joint_pos_target, expected.joint_pos_target)
