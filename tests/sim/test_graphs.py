"""Functions that are recorded as CUDA graphs and replayed."""

import pytest
import torch
from torch import Tensor

from pixel2catch.sim.graphs import GraphedFunction

pytestmark = pytest.mark.gpu


@pytest.mark.parametrize("is_aside", [True, False])
def test_replays_compute_what_the_function_does(is_aside: bool) -> None:
    """Calls are counted on the host: the function runs in the eager calls and once more to be recorded."""
    state, num_runs = torch.zeros(3, device="cuda"), [0]

    def add_up(values: Tensor, scale: Tensor) -> Tensor:
        num_runs[0] += 1
        state.add_(values * scale)
        return 2.0 * state

    graphed, expected = (
        GraphedFunction(add_up, device=torch.device("cuda"), num_eager_calls=2, is_aside=is_aside),
        torch.zeros(3),
    )
    for number in range(6):
        values = torch.arange(3.0) + number
        expected += 0.5 * values
        result = graphed(values.cuda(), torch.tensor(0.5, device="cuda"))
        torch.testing.assert_close(result.cpu(), 2.0 * expected)
    assert num_runs[0] == 3


def test_a_recording_draws_anew_from_its_generator() -> None:
    """Not what was drawn before the recording, either; often, as a race would be lost only now and then."""
    for seed in range(100):
        generator = torch.Generator("cuda").manual_seed(seed)

        def draw(values: Tensor, generator: torch.Generator = generator) -> Tensor:
            return values + torch.rand(4, device="cuda", generator=generator)

        graphed = GraphedFunction(draw, device=torch.device("cuda"), num_eager_calls=1, generator=generator)
        draws = torch.stack([graphed(torch.zeros(4, device="cuda")).clone() for _ in range(4)])
        assert len(draws.unique(dim=0)) == 4


def test_recordings_replayed_side_by_side_compute_what_each_does_alone() -> None:
    """Products over many rows, as gradients are, for which cuBLAS may need its workspace."""
    streams = [torch.cuda.Stream() for _ in range(4)]
    pairs = [(torch.randn(8192, 256, device="cuda"), torch.randn(8192, 128, device="cuda")) for _ in streams]

    def product(left: Tensor, right: Tensor) -> Tensor:
        return torch.stack([left.T @ right for _ in range(10)])

    graphed = [GraphedFunction(product, device=torch.device("cuda"), num_eager_calls=1) for _ in streams]
    for each, pair in zip(graphed, pairs, strict=True):
        each(*pair)
    alone = [each(*pair).clone() for each, pair in zip(graphed, pairs, strict=True)]
    for _ in range(20):
        torch.cuda.synchronize()
        results = []
        for each, pair, stream in zip(graphed, pairs, streams, strict=True):
            with torch.cuda.stream(stream):
                results.append(each(*pair))
        torch.cuda.synchronize()
        for result, expected in zip(results, alone, strict=True):
            torch.testing.assert_close(result, expected, rtol=0.0, atol=0.0)
