"""SAM 2's modules as CUDA graphs: they can be captured, and change nothing."""

from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from tiny_sam2 import random_images, save_tiny_sam2
from torch.utils._python_dispatch import TorchDispatchMode

from pixel2catch.perception.sam2 import CAPTURED, MODULES, CapturedFunction, Module, Sam2Segmenter
from pixel2catch.perception.segmenter import BoxPrompt

BOX = BoxPrompt(box=(10.0, 12.0, 30.0, 34.0))
WAITS = ("aten.item", "aten._local_scalar_dense", "aten.lift_fresh", "aten.nonzero")
"""Operations that a graph cannot hold: a value goes from the device to the host or back."""


class Recorder(TorchDispatchMode):
    """Counts operations that a graph cannot hold, and others, by the module that is running."""

    def __init__(self) -> None:
        super().__init__()
        self.module = "elsewhere"
        self.waits: Counter[str] = Counter()
        self.operations: Counter[str] = Counter()

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        self.operations[self.module] += 1
        self.waits[self.module] += str(func).startswith(WAITS)
        return func(*args, **(kwargs or {}))

    def watched(self, name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def watch(*args: Any, **kwargs: Any) -> Any:
            self.module = name
            result = function(*args, **kwargs)
            self.module = "elsewhere"
            return result

        return watch


def test_what_is_captured_never_waits_for_the_host(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    segmenter, images = Sam2Segmenter(save_tiny_sam2(tmp_path), "cpu"), random_images(4)
    recorder = Recorder()
    for name in CAPTURED:
        part = getattr(segmenter._model, name)
        owner, method = (part, "forward") if isinstance(part, torch.nn.Module) else (segmenter._model, name)
        monkeypatch.setattr(owner, method, recorder.watched(name, getattr(owner, method)))
    segmenter.start(images[0], BOX)
    with recorder:
        segmenter.start(images[0], BOX)
        for image in images:
            segmenter.track(image)
    assert all(recorder.operations[name] > 0 and recorder.waits[name] == 0 for name in CAPTURED)
    assert recorder.waits["elsewhere"] > 0
    captured = sum(recorder.operations[name] for name in CAPTURED)
    assert captured > 0.85 * recorder.operations.total()


@pytest.mark.gpu
def test_a_captured_function_follows_its_input_and_keeps_its_results() -> None:
    calls = []

    def function(x: torch.Tensor, *, add: int, pair: tuple[torch.Tensor, None]) -> dict[str, Any]:
        calls.append(add)
        return {"sum": x + add, "product": [x * pair[0], None]}

    captured = CapturedFunction(function, torch.cuda.graph_pool_handle())
    results = []
    for shape in ((3,), (2, 2), (3,)):
        for add in (1, 2):
            x, y = torch.rand(shape, device="cuda"), torch.rand(shape, device="cuda")
            results.append((captured(x, add=add, pair=(y, None)), x, y, add))
    for result, x, y, add in results:
        torch.testing.assert_close(result["sum"], x + add)
        torch.testing.assert_close(result["product"][0], x * y)
        assert result["product"][1] is None
    # Two shapes and two constants: four recordings of three runs each.
    assert len(calls) == 12


@pytest.mark.gpu
@pytest.mark.parametrize("compiled", [(), MODULES])
def test_graphs_see_what_the_plain_model_sees(compiled: tuple[Module, ...], tmp_path: Path) -> None:
    """In float32: in bfloat16 noise would hide a memory that is not the right one."""
    folder = save_tiny_sam2(tmp_path)
    plain = Sam2Segmenter(folder, "cuda", is_captured=False, dtype=torch.float32)
    graphs = Sam2Segmenter(folder, "cuda", compiled=compiled, dtype=torch.float32)
    differences = []
    for throw in range(2):
        images = random_images(40, seed=throw)
        pairs = [(plain.start(images[0], BOX), graphs.start(images[0], BOX))]
        pairs += [(plain.track(image), graphs.track(image)) for image in images[1:]]
        for expected, result in pairs:
            assert expected.mask is not None
            assert result.mask is not None
            assert result.score == pytest.approx(expected.score, abs=1e-5)
            differences.append((result.mask != expected.mask).mean())
    # With another memory it is 0.01.
    assert max(differences) < 0.001


@pytest.mark.gpu
def test_the_default_on_cuda_finds_and_forgets(tmp_path: Path) -> None:
    segmenter, images = Sam2Segmenter(save_tiny_sam2(tmp_path), "cuda"), random_images(40)
    first = [segmenter.start(images[0], BOX), *(segmenter.track(image) for image in images[1:])]
    again = [segmenter.start(images[0], BOX), *(segmenter.track(image) for image in images[1:])]
    for result, other in zip(first, again, strict=True):
        assert result.mask is not None
        assert other.mask is not None
        assert (result.mask != other.mask).mean() < 0.001
