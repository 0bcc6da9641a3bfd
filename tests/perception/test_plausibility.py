"""Which boxes can be the object's, in a camera of 640 x 480."""

import pytest
import torch

from pixel2catch.perception.plausibility import PlausibilityCfg, Verdict, judge
from pixel2catch.scene.constants import RGB_CAMERA

Box = tuple[float, float, float, float]
OBJECT: Box = (300.0, 200.0, 330.0, 230.0)


def verdict(box: Box, area: int, *before) -> Verdict:
    return judge(PlausibilityCfg(), RGB_CAMERA, torch.tensor([box]), area, *before)


@pytest.mark.parametrize(
    ("box", "area", "expected"),
    [
        (OBJECT, 700, Verdict.SEEN),
        ((300.0, 200.0, 305.0, 201.0), 5, Verdict.TOO_SMALL),
        ((0.0, 0.0, 640.0, 480.0), 307_200, Verdict.TOO_LARGE),
        ((100.0, 100.0, 200.0, 162.0), 900, Verdict.TOO_LARGE),  # 6,200 px of 6,144 allowed
        ((100.0, 100.0, 200.0, 161.0), 900, Verdict.SEEN),  # 6,100 px
        ((300.0, 0.0, 330.0, 20.0), 500, Verdict.SEEN),  # leaves the image at the top
        ((300.0, 460.0, 330.0, 480.0), 500, Verdict.SEEN),
        ((0.0, 100.0, 640.0, 105.0), 900, Verdict.BORDER),  # from the left to the right
        ((620.0, 460.0, 640.0, 480.0), 300, Verdict.BORDER),  # a corner
    ],
)
def test_size_and_borders(box: Box, area: int, expected: Verdict):
    assert verdict(box, area) is expected


@pytest.mark.parametrize(
    ("jump", "steps", "expected"),
    [
        (61.0, 1.0, Verdict.SEEN),
        (91.0, 1.0, Verdict.JUMP),
        (91.0, 2.0, Verdict.SEEN),  # an image was skipped
        (181.0, 2.0, Verdict.JUMP),
        (91.0, 0.5, Verdict.JUMP),  # a camera of 60 Hz sees no faster objects
        (300.0, 4.0, Verdict.SEEN),  # it heals by itself
    ],
)
def test_a_box_moves_no_faster_than_objects_do(jump: float, steps: float, expected: Verdict):
    moved = (OBJECT[0], OBJECT[1] + jump, OBJECT[2], OBJECT[3] + jump)
    assert verdict(moved, 700, torch.tensor([OBJECT]), steps) is expected
