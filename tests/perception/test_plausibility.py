"""Which boxes can be the object's, in a camera of 640 x 480."""

import pytest
import torch

from pixel2catch.camera.pinhole import nominal_projection
from pixel2catch.envs.tasks import HUMAN_THROWS, SIDEWAYS
from pixel2catch.mdp.throws import ThrowCfg, sample_throws
from pixel2catch.perception.plausibility import PlausibilityCfg, Verdict, is_jump, judge
from pixel2catch.scene.constants import CONTROL_DT, GRAVITY, RGB_CAMERA

Box = tuple[float, float, float, float]
OBJECT: Box = (300.0, 200.0, 330.0, 230.0)


CFG = PlausibilityCfg()


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
    assert judge(CFG, RGB_CAMERA, torch.tensor([box]), area) is expected


@pytest.mark.parametrize(
    ("jump", "steps", "expected"),
    [
        (61.0, 1.0, False),
        (91.0, 1.0, True),
        (91.0, 2.0, False),  # an image was skipped
        (181.0, 2.0, True),
        (91.0, 0.5, True),  # a camera of 60 Hz sees no faster objects
    ],
)
def test_a_box_moves_no_faster_than_objects_do(jump: float, steps: float, expected: bool):
    moved = (OBJECT[0], OBJECT[1] + jump, OBJECT[2], OBJECT[3] + jump)
    assert is_jump(CFG, torch.tensor([moved]), torch.tensor([OBJECT]), steps) is expected


@pytest.mark.parametrize(("by", "expected"), [(49.0, False), (51.0, True), (-29.0, False)])
def test_a_box_grows_no_faster_than_what_was_hidden_appears(by: float, expected: bool):
    grown = (OBJECT[0], OBJECT[1], OBJECT[2], OBJECT[3] + by)
    assert is_jump(CFG, torch.tensor([grown]), torch.tensor([OBJECT]), 1.0) is expected


@pytest.mark.parametrize(("radius", "scale"), [(0.02, 1.0), (0.04, 1.0), (0.08, 2.0), (0.14, 3.5)])
def test_limits_grow_with_what_is_thrown(radius: float, scale: float):
    """In proportion where it is larger than the paper's objects, the sides, and the area by its square."""
    cfg = PlausibilityCfg.up_to(radius)
    sides = cfg.largest_side / CFG.largest_side, cfg.largest_growth / CFG.largest_growth
    assert (*sides, cfg.largest_share / CFG.largest_share) == pytest.approx((scale, scale, scale**2))
    assert (cfg.least_area, cfg.largest_jump) == (CFG.least_area, CFG.largest_jump)


FLIGHTS = [(ThrowCfg(), 0.075, 1.0), (HUMAN_THROWS, 0.075, 0.999), (SIDEWAYS, 0.14, 1.0)]


@pytest.mark.parametrize(("throws", "radius", "quantile"), FLIGHTS)
def test_no_flight_of_the_task_is_a_jump(throws: ThrowCfg, radius: float, quantile: float):
    """Spheres of 15 and 28 cm, from the release until they come down to the height of the catch."""
    cfg = PlausibilityCfg.up_to(radius)
    thrown = sample_throws(throws, 2000, torch.Generator().manual_seed(0))
    time = CONTROL_DT * torch.arange(60)[:, None]
    pos = thrown.pos + thrown.lin_vel * time[..., None]
    pos[..., 2] -= 0.5 * GRAVITY * time**2
    pixels, depth = zip(*(nominal_projection(RGB_CAMERA, at).pixels(at[:, None]) for at in pos), strict=True)
    center, half = torch.stack(pixels)[:, :, 0], radius * RGB_CAMERA.fx / torch.stack(depth)[:, :, 0, None]
    boxes = torch.cat((center - half, center + half), dim=-1)
    in_view = (center > 0.0).all(dim=-1) & (center < torch.tensor([640.0, 480.0])).all(dim=-1)
    flies = in_view & (time < thrown.flight_time())
    change = (boxes[1:] - boxes[:-1])[flies[1:] & flies[:-1]]
    first, last = change.split(2, dim=-1)
    speed, growth = (0.5 * (first + last)).norm(dim=-1), (last - first).amax(dim=-1)
    assert len(change) > 20_000
    assert 60.0 < speed.quantile(quantile) < cfg.largest_jump
    assert growth.quantile(quantile) < 0.2 * cfg.largest_growth
    side = float(2.0 * half[flies[..., None]].quantile(quantile))
    area = RGB_CAMERA.width * RGB_CAMERA.height
    assert side < cfg.largest_side
    assert side**2 < cfg.largest_share * area
    assert side**2 > CFG.largest_share * area or radius < 0.1
