"""Checkpoints and installations that cannot be used: every message says what to do."""

import importlib.util
import json
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file
from tiny_sam2 import save_tiny_sam2

from pixel2catch.errors import DeviceUnavailableError, PerceptionError
from pixel2catch.perception import sam2
from pixel2catch.perception.sam2 import Sam2Segmenter

ADVICE = "hf download facebook/sam2.1-hiera-tiny --local-dir"


def drop_weights(folder: Path) -> None:
    weights = folder / "model.safetensors"
    kept = {
        name: value for name, value in load_file(weights).items() if not name.startswith("memory_encoder")
    }
    save_file(kept, weights, metadata={"format": "pt"})


def leave_a_part_of_a_download(folder: Path) -> None:
    """One of two files is there, and the index that names both."""
    weights = folder / "model.safetensors"
    names = list(load_file(weights))
    files = {
        name: f"model-0000{1 + position % 2}-of-00002.safetensors" for position, name in enumerate(names)
    }
    weights.rename(folder / "model-00001-of-00002.safetensors")
    (folder / "model.safetensors.index.json").write_text(json.dumps({"metadata": {}, "weight_map": files}))


def replace_by_the_makers_file(folder: Path) -> None:
    (folder / "model.safetensors").rename(folder / "sam2.1_hiera_tiny.pt")


def change_type(folder: Path) -> None:
    config = folder / "config.json"
    config.write_text(json.dumps(json.loads(config.read_text()) | {"model_type": "sam3_video"}))


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (change_type, "a model of type 'sam3_video', not 'sam2_video'"),
        (leave_a_part_of_a_download, "cannot be read as SAM 2: .*model-00002-of-00002.safetensors"),
        (replace_by_the_makers_file, "cannot be read as SAM 2: .*model.safetensors"),
        (drop_weights, "lacks [0-9]+ weights of SAM 2, such as memory_encoder"),
    ],
)
def test_a_bad_checkpoint_is_named_with_its_download(
    tmp_path: Path, spoil: Callable[[Path], None], message: str
) -> None:
    spoil(save_tiny_sam2(tmp_path))
    with pytest.raises(PerceptionError, match=f"(?s){message}.*{ADVICE} {tmp_path}"):
        Sam2Segmenter(tmp_path, "cpu")


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device")
def test_a_missing_device_is_named_before_anything_is_loaded(tmp_path: Path) -> None:
    with pytest.raises(DeviceUnavailableError, match="'cuda'"):
        Sam2Segmenter(tmp_path, "cuda")


def import_anew() -> None:
    spec = importlib.util.spec_from_file_location("fresh", sam2.__file__)
    assert spec is not None
    assert spec.loader is not None
    spec.loader.exec_module(importlib.util.module_from_spec(spec))


def test_without_transformers_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "transformers", None)
    with pytest.raises(PerceptionError, match=r"pip install .*\[sam2\]"):
        import_anew()


def test_compiling_without_a_compiler_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "")
    with pytest.raises(PerceptionError, match=r"needs a C compiler \(gcc or clang\).*apt install gcc"):
        Sam2Segmenter(tmp_path, "cpu", is_compiled=True)
