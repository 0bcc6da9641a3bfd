import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from pixel2catch.camera.boxes import box_of_mask, box_of_points, clip_box, perturb_box
from pixel2catch.scene.constants import RGB_CAMERA


def boxes(num: int, seed: int) -> torch.Tensor:
    """Random boxes inside the image [px]."""
    generator = torch.Generator().manual_seed(seed)
    corners = torch.rand(num, 2, 2, generator=generator) * torch.tensor([640.0, 480.0])
    return torch.cat([corners.amin(1), corners.amax(1)], dim=-1)


def test_box_of_visible_points():
    pixels = torch.tensor([[[10.0, 20.0], [30.0, 25.0], [15.0, 40.0], [600.0, 400.0]]])
    is_visible = torch.tensor([[True, True, True, False]])
    assert box_of_points(pixels, is_visible, RGB_CAMERA).tolist() == [[10.0, 20.0, 30.0, 40.0]]


def test_a_box_that_the_image_cuts_ends_at_its_edge():
    pixels = torch.tensor(
        [[[20.0, 470.0], [25.0, 475.0], [50.0, 490.0]], [[-9.0, 4.0], [3.0, 5.0], [-2.0, -8.0]]]
    )
    box = box_of_points(pixels, torch.ones(2, 3, dtype=torch.bool), RGB_CAMERA)
    # The point below the image bounds neither left nor right; the point beyond the corner bounds nothing.
    assert box.tolist() == [[20.0, 470.0, 25.0, 480.0], [0.0, 5.0, 3.0, 5.0]]


def test_all_points_off_the_image_is_a_zero_box():
    pixels = torch.tensor([[[20.0, 490.0], [-5.0, 300.0]]])
    assert box_of_points(pixels, torch.ones(1, 2, dtype=torch.bool), RGB_CAMERA).tolist() == [[0.0] * 4]


def test_nothing_visible_is_a_zero_box_even_with_points_at_infinity():
    pixels = torch.tensor([[[torch.inf, torch.nan]]])
    assert box_of_points(pixels, torch.zeros(1, 1, dtype=torch.bool), RGB_CAMERA).tolist() == [[0.0] * 4]


def test_box_of_mask_runs_along_the_outer_pixel_edges():
    mask = torch.zeros(3, 48, 64, dtype=torch.bool)
    mask[0, 5:9, 10] = True  # rows 5..8, column 10
    mask[1] = True
    box, is_seen = box_of_mask(mask)
    assert box.tolist() == [[10.0, 5.0, 11.0, 9.0], [0.0, 0.0, 64.0, 48.0], [0.0] * 4]
    assert is_seen.tolist() == [True, True, False]


def test_each_edge_moves_by_its_own_noise():
    box = torch.tensor([[100.0, 110.0, 130.0, 150.0]])
    noise = torch.tensor([[1.0, -2.0, 3.0, -4.0]])
    assert perturb_box(box, noise, RGB_CAMERA).tolist() == [[101.0, 108.0, 133.0, 146.0]]


def test_edges_that_cross_are_exchanged():
    box = torch.tensor([[100.0, 478.0, 120.0, 480.0]])
    noise = torch.tensor([[0.0, 1.5, 0.0, -4.0]])  # 479.5 above 476
    assert perturb_box(box, noise, RGB_CAMERA).tolist() == [[100.0, 476.0, 120.0, 479.5]]


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10**6), reach=st.floats(0.0, 5.0))
def test_noise_keeps_boxes_in_order_and_in_the_image(seed: int, reach: float):
    box = boxes(50, seed)
    noise = (2 * torch.rand(50, 4, generator=torch.Generator().manual_seed(seed + 1)) - 1) * reach
    noisy = perturb_box(box, noise, RGB_CAMERA)
    assert (noisy[:, :2] <= noisy[:, 2:]).all()
    torch.testing.assert_close(clip_box(noisy, RGB_CAMERA), noisy, atol=0, rtol=0)
    assert (noisy - box).abs().max() <= reach + 1e-4
