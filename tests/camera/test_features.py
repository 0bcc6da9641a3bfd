import torch

from pixel2catch.camera.boxes import pixel_features
from pixel2catch.scene.constants import RGB_CAMERA

BEFORE = torch.tensor([[300.0, 100.0, 320.0, 130.0]])  # centre (310, 115), size (20, 30)
NOW = torch.tensor([[304.0, 108.0, 336.0, 132.0]])  # centre (320, 120), size (32, 24)


def test_numbers_by_hand():
    # 320 / 640, 120 / 480, 32 / 640, 24 / 480, then 320 - 310, 120 - 115, 32 - 20, 24 - 30
    expected = torch.tensor([[0.5, 0.25, 0.05, 0.05, 10.0, 5.0, 12.0, -6.0]])
    torch.testing.assert_close(pixel_features(BEFORE, NOW, RGB_CAMERA), expected)
