import torch

from pixel2catch.camera.pinhole import is_in_view, is_unoccluded, project
from pixel2catch.scene.constants import RGB_CAMERA


def test_a_miss_or_a_hit_behind_the_point_hides_nothing():
    hits = torch.tensor([[-1.0, 0.999, 1.0, 1.5, 0.0]])
    assert is_unoccluded(hits).tolist() == [[True, False, True, True, False]]


def test_in_view_is_on_the_image_and_in_front():
    # Straight ahead; behind the camera on the same line; far to the left; under the lower edge.
    points = torch.tensor([[[1.5, 0.0, 1.2], [-2.28, 0.02, 3.2], [1.5, 3.0, 1.2], [0.2, 0.0, 0.5]]])
    pixels, depth = project(RGB_CAMERA, points)
    assert (depth[0] > 0).tolist() == [True, False, True, True]
    assert is_in_view(RGB_CAMERA, pixels, depth).tolist() == [[True, False, False, False]]
