"""Connected regions, and which of them can be an object."""

import numpy as np
import pytest
import torch

from pixel2catch.camera.boxes import box_of_mask
from pixel2catch.camera.image import Edges
from pixel2catch.camera.pinhole import nominal_projection
from pixel2catch.envs.tasks import HUMAN_THROWS, SIDEWAYS
from pixel2catch.mdp.throws import ThrowCfg, sample_throws
from pixel2catch.perception.regions import PlausibilityCfg, find_blobs, is_jump
from pixel2catch.scene.constants import CONTROL_DT, GRAVITY, RGB_CAMERA


def two_blobs() -> np.ndarray:
    mask = np.zeros((48, 64), dtype=bool)
    mask[5:10, 8:14] = True  # 30 pixels
    mask[20:30, 40:44] = True  # 40 pixels
    return mask


def test_regions_have_the_boxes_of_training_and_are_together_the_mask():
    large, small = find_blobs(two_blobs())
    assert (large.area, large.width, large.height, large.center) == (40, 4, 10, (42.0, 25.0))
    assert (small.area, small.width, small.height, small.center) == (30, 6, 5, (11.0, 7.5))
    for blob in (large, small):
        box, _ = box_of_mask(torch.from_numpy(blob.mask())[None])
        assert box[0].tolist() == list(blob.box)
    assert not (large.mask() & small.mask()).any()
    assert np.array_equal(large.mask() | small.mask(), two_blobs())


@pytest.mark.parametrize("level", [False, True])
def test_a_uniform_mask_is_one_region_or_none(level: bool):
    assert len(find_blobs(np.full((6, 8), level))) == level


CFG = PlausibilityCfg()
OBJECT: Edges = (300.0, 200.0, 330.0, 230.0)


@pytest.mark.parametrize(
    ("jump", "growth", "steps", "expected"),
    [
        (61.0, 0.0, 1.0, False),
        (91.0, 0.0, 1.0, True),
        (91.0, 0.0, 2.0, False),  # an image was skipped
        (91.0, 0.0, 0.5, True),  # a camera of 60 Hz sees no faster objects
        (0.0, 49.0, 1.0, False),
        (0.0, 51.0, 1.0, True),
        (0.0, -29.0, 1.0, False),
    ],
)
def test_a_box_moves_and_grows_no_faster_than_objects_do(
    jump: float, growth: float, steps: float, expected: bool
):
    now = (OBJECT[0], OBJECT[1] + jump, OBJECT[2], OBJECT[3] + jump + growth)
    assert is_jump(CFG, now, OBJECT, steps) is expected


@pytest.mark.parametrize(("radius", "scale"), [(0.02, 1.0), (0.04, 1.0), (0.14, 3.5)])
def test_limits_grow_with_the_object(radius: float, scale: float):
    """In proportion if it is larger than the paper's objects; the area by the square."""
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
