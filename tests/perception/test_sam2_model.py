"""Checkpoints and installations that cannot be used: every message says what to do."""

import json
import runpy
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file
from tiny_sam2 import save_tiny_sam2

from pixel2catch.errors import DeviceUnavailableError, InvalidValueError, PerceptionError
from pixel2catch.perception import sam2
from pixel2catch.perception.sam2 import Sam2Segmenter

ADVICE = "hf download facebook/sam2.1-hiera-tiny --local-dir"


def drop_weights(folder: Path) -> None:
    weights = load_file(folder / "model.safetensors")
    kept = {name: value for name, value in weights.items() if not name.startswith("memory_encoder")}
    save_file(kept, folder / "model.safetensors", metadata={"format": "pt"})


def leave_a_part_of_a_download(folder: Path) -> None:
    """One of two files is there, and the index that names both."""
    parts = [f"model-0000{number}-of-00002.safetensors" for number in (1, 2)]
    files = {name: parts[i % 2] for i, name in enumerate(load_file(folder / "model.safetensors"))}
    (folder / "model.safetensors").rename(folder / parts[0])
    (folder / "model.safetensors.index.json").write_text(json.dumps({"metadata": {}, "weight_map": files}))


def replace_by_the_makers_file(folder: Path) -> None:
    (folder / "model.safetensors").rename(folder / "sam2.1_hiera_tiny.pt")


def change_type(folder: Path) -> None:
    config = folder / "config.json"
    config.write_text(config.read_text().replace('"model_type": "sam2_video"', '"model_type": "sam3_video"'))


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


def test_without_transformers_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "transformers", None)
    with pytest.raises(PerceptionError, match=r"pip install .*\[sam2\]"):
        runpy.run_path(str(sam2.__file__))


def test_compiling_without_a_compiler_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "")
    with pytest.raises(PerceptionError, match=r"needs a C compiler \(gcc or clang\).*apt install gcc"):
        Sam2Segmenter(tmp_path, "cpu", is_compiled=True)


def test_an_image_size_between_multiples_of_32_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InvalidValueError, match="multiple of 32, not 100"):
        Sam2Segmenter(tmp_path, "cpu", image_size=100)
