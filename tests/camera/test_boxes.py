import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from pixel2catch.camera.pinhole import box_of_points, clip_box, perturb_box
from pixel2catch.scene.constants import RGB_CAMERA


@pytest.mark.parametrize(
    ("pixels", "num_visible", "expected"),
    [
        pytest.param(
            [(10, 20), (30, 25), (15, 40), (600, 400)], 3, [10, 20, 30, 40], id="of the visible points"
        ),
        # The point below the image bounds neither left nor right.
        pytest.param([(20, 470), (25, 475), (50, 490)], 3, [20, 470, 25, 480], id="cut at the lower edge"),
        # The point beyond the corner bounds nothing.
        pytest.param([(-9, 4), (3, 5), (-2, -8)], 3, [0, 5, 3, 5], id="cut at the left edge"),
        pytest.param([(20, 490), (-5, 300)], 2, [0] * 4, id="off the image"),
        pytest.param([(torch.inf, torch.nan)], 0, [0] * 4, id="nothing visible"),
    ],
)
def test_box_of_points(pixels, num_visible, expected):
    is_visible = torch.arange(len(pixels))[None] < num_visible
    assert box_of_points(torch.tensor([pixels]).float(), is_visible, RGB_CAMERA).tolist() == [expected]


@pytest.mark.parametrize(
    ("box", "noise", "expected"),
    [
        ([100, 110, 130, 150], [1, -2, 3, -4], [101, 108, 133, 146]),
        ([100, 478, 120, 480], [0, 1.5, 0, -4], [100, 476, 120, 479.5]),  # edges that cross are exchanged
    ],
)
def test_each_edge_moves_by_its_own_noise(box, noise, expected):
    boxes, errors = torch.tensor([box]).float(), torch.tensor([noise]).float()
    assert perturb_box(boxes, errors, RGB_CAMERA).tolist() == [expected]


@settings(max_examples=30)
@given(seed=st.integers(0, 10**6), reach=st.floats(0.0, 5.0))
def test_noise_keeps_boxes_in_order_and_in_the_image(seed: int, reach: float):
    generator = torch.Generator().manual_seed(seed)
    corners = torch.rand(50, 2, 2, generator=generator) * torch.tensor([640.0, 480.0])
    box = torch.cat([corners.amin(1), corners.amax(1)], dim=-1)
    noise = (2 * torch.rand(50, 4, generator=generator) - 1) * reach
    noisy = perturb_box(box, noise, RGB_CAMERA)
    assert (noisy[:, :2] <= noisy[:, 2:]).all()
    torch.testing.assert_close(clip_box(noisy, RGB_CAMERA), noisy, atol=0, rtol=0)
    assert (noisy - box).abs().max() <= reach + 1e-4
