"""On the GPU the camera's functions neither synchronise with the host nor break a CUDA graph."""

import pytest
import torch

from pixel2catch.camera.boxes import box_of_points, perturb_box, pixel_features
from pixel2catch.camera.pinhole import is_in_view, is_unoccluded, project
from pixel2catch.devices import keeping
from pixel2catch.scene.constants import RGB_CAMERA


def see(points: torch.Tensor, hit: torch.Tensor, previous: torch.Tensor) -> torch.Tensor:
    """Every function of the camera in one pass, from points to features."""
    pixels, depth = project(RGB_CAMERA, points)
    is_visible = is_unoccluded(hit) & is_in_view(RGB_CAMERA, pixels, depth)
    box = box_of_points(pixels, is_visible, RGB_CAMERA)
    box = perturb_box(box, torch.ones_like(box), RGB_CAMERA)
    return pixel_features(previous, box, RGB_CAMERA)


def inputs(device: str) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(64, 32, 3, generator=generator) + torch.tensor([0.5, -0.5, 0.8])
    hit = 2.0 * torch.rand(64, 32, generator=generator) - 0.5
    previous = torch.tensor([100.0, 100.0, 120.0, 130.0]).repeat(64, 1)
    return points.to(device), hit.to(device), previous.to(device)


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
@pytest.mark.filterwarnings("ignore:Synchronization debug mode:UserWarning")
def test_a_cuda_graph_computes_the_same_as_the_cpu():
    arguments, graph = inputs("cuda"), torch.cuda.CUDAGraph()
    with keeping({}):
        see(*arguments)  # makes the constants
        torch.cuda.set_sync_debug_mode("error")
        try:
            see(*arguments)
        finally:
            torch.cuda.set_sync_debug_mode("default")
        with torch.cuda.graph(graph):
            captured = see(*arguments)
        graph.replay()
        captured = captured.cpu()
    torch.testing.assert_close(captured, see(*inputs("cpu")), atol=1e-3, rtol=1e-5)
