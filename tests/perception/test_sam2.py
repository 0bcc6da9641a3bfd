"""SAM 2 as a segmenter, of 1.5 million random weights; checkpoints and installations that cannot be used."""

import re
import runpy
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

from pixel2catch.cli.main import main
from pixel2catch.errors import DeviceUnavailableError, InvalidValueError, PerceptionError
from pixel2catch.perception import factory, sam2, self_test
from pixel2catch.perception.factory import PerceptionArgs
from pixel2catch.perception.sam2 import DEVIATION, MEAN, Sam2Segmenter, mask_of_logits
from pixel2catch.perception.segmenter import BoxPrompt, Segmentation
from pixel2catch.perception.self_test import KINDS, LEAST_RIGHT, NUM_EMPTY, painted_throw

SIZE = 64
CERTAIN = 9.0
HEIGHT, WIDTH = 48, 80


def save_tiny_sam2(folder: Path) -> Path:
    """Write a checkpoint of few and narrow layers that always finds something."""
    # Not at the top: each worker collects all tests, and this takes seconds.
    from transformers import Sam2VideoConfig, Sam2VideoModel
    from transformers.models.sam2_video.configuration_sam2_video import Sam2VideoMaskDecoderConfig

    hidden = 128
    backbone = {
        "model_type": "sam2_hiera_det_model",
        "hidden_size": 16,
        "image_size": [SIZE, SIZE],
        "embed_dim_per_stage": [16, 32, 64, 128],
        "blocks_per_stage": [1, 1, 2, 1],
        "num_attention_heads_per_stage": [1, 1, 2, 2],
        "global_attention_blocks": [3],
    }
    decoder: Any = {"hidden_size": hidden, "mlp_dim": 64, "num_attention_heads": 4, "iou_head_hidden_dim": 32}
    config = Sam2VideoConfig(
        image_size=SIZE,
        vision_config={
            "backbone_config": backbone,
            "backbone_channel_list": [128, 64, 32, 16],
            "backbone_feature_sizes": [[SIZE // stride] * 2 for stride in (4, 8, 16)],
            "fpn_hidden_size": hidden,
        },
        prompt_encoder_config={"hidden_size": hidden, "image_size": SIZE},
        mask_decoder_config=Sam2VideoMaskDecoderConfig(**decoder),
        memory_attention_hidden_size=hidden,
        memory_attention_num_layers=2,
        memory_attention_feed_forward_hidden_size=64,
        memory_attention_rope_feat_sizes=[SIZE // 16, SIZE // 16],
        memory_encoder_hidden_size=hidden,
        mask_downsampler_embed_dim=hidden,
        memory_fuser_embed_dim=hidden,
        memory_fuser_intermediate_dim=64,
    )
    torch.manual_seed(0)
    model = Sam2VideoModel(config)
    # The usual initial weights are so small, or zero, that neither image nor memory would matter.
    for weights in model.parameters():
        if weights.ndim > 1:
            torch.nn.init.normal_(weights, std=weights[0].numel() ** -0.5)
    torch.nn.init.constant_(model.mask_decoder.pred_obj_score_head.proj_out.bias, CERTAIN)
    model.save_pretrained(folder)
    return folder


def random_images(count: int, seed: int = 0) -> list[np.ndarray]:
    generator = np.random.default_rng(seed)
    return list(generator.integers(0, 256, (count, HEIGHT, WIDTH, 3), dtype=np.uint8))


BOX = BoxPrompt(box=(10.0, 12.0, 30.0, 34.0))
OTHER = BoxPrompt(box=(45.0, 15.0, 55.0, 25.0))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return save_tiny_sam2(tmp_path_factory.mktemp("sam2"))


def run(segmenter: Sam2Segmenter, images: list[np.ndarray], prompt: BoxPrompt = BOX) -> list[Segmentation]:
    return [segmenter.find(images[0], prompt=prompt), *map(segmenter.find, images[1:])]


def assert_equal(results: list[Segmentation], expected: list[Segmentation]) -> None:
    for result, other in zip(results, expected, strict=True):
        assert result.score == other.score
        np.testing.assert_array_equal(result.mask, other.mask)


def remembered_bytes(value: object, seen: set[int] | None = None) -> int:
    """Size of all tensors that an object holds, but for the model's."""
    seen = set() if seen is None else seen
    if id(value) in seen or isinstance(value, torch.nn.Module):
        return 0
    seen.add(id(value))
    if isinstance(value, torch.Tensor):
        return value.nbytes
    if isinstance(value, dict):
        return 64 * len(value) + sum(remembered_bytes(item, seen) for item in value.values())
    if isinstance(value, (list, tuple)):
        return sum(remembered_bytes(item, seen) for item in value)
    return remembered_bytes(vars(value), seen) if hasattr(value, "__dict__") else 0


def test_deleted_memory_is_never_used(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    images = random_images(40)
    segmenter = Sam2Segmenter(folder, "cpu")
    results = run(segmenter, images)

    monkeypatch.setattr(Sam2Segmenter, "_prune", lambda self, session: None)
    hoarder = Sam2Segmenter(folder, "cpu")
    assert_equal(results, run(hoarder, images))
    assert remembered_bytes(hoarder) > 5 * remembered_bytes(segmenter)


def test_a_new_start_deletes_the_past(folder: Path) -> None:
    images = random_images(6)
    segmenter, other = Sam2Segmenter(folder, "cpu"), Sam2Segmenter(folder, "cpu")
    expected = run(segmenter, images)
    run(other, random_images(6, seed=1), OTHER)
    assert other.find(images[-1]).score != expected[-1].score
    assert_equal(run(other, images), expected)


def test_a_lost_object_is_found_again(folder: Path) -> None:
    """Forced by the bias of the head that says whether the object is there; the memory stays as large."""
    segmenter, sizes = Sam2Segmenter(folder, "cpu"), []
    head = segmenter._model.mask_decoder.pred_obj_score_head.proj_out
    for step, image in enumerate(random_images(24)):
        head.bias.fill_(-CERTAIN if 18 <= step < 21 else CERTAIN)
        found = segmenter.find(image, prompt=None if step else BOX)
        assert (found.mask is None) == (18 <= step < 21)
        sizes.append(remembered_bytes(segmenter))
    assert len(set(sizes[18:])) == 1


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # of PyTorch's own compiler
@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=pytest.mark.gpu)])
def test_compiled_modules_give_the_same_masks(folder: Path, device: str) -> None:
    """In float32: in bfloat16 noise would hide a memory that is not the right one."""
    images = random_images(24)
    plain = run(Sam2Segmenter(folder, device, dtype=torch.float32), images)
    compiled = run(Sam2Segmenter(folder, device, is_compiled=True, dtype=torch.float32), images)
    for result, expected in zip(compiled, plain, strict=True):
        assert result.mask is not None
        assert expected.mask is not None
        assert (result.mask != expected.mask).mean() < 0.001
        assert result.score == pytest.approx(expected.score, abs=1e-5)


def test_the_time_is_printed_and_too_slow_for_a_camera_is_refused(folder: Path, monkeypatch) -> None:
    args, said = PerceptionArgs(segmenter="sam2", checkpoint=folder), list[str]()
    assert isinstance(args.make_segmenter(say=said.append), Sam2Segmenter)
    (line,) = said
    assert re.fullmatch(r"SAM 2 takes \d+\.\d ms for an image of 64 px on cpu; a camera .*", line)
    monkeypatch.setattr(factory, "LONGEST_IMAGE_TIME", 0.0)
    with pytest.raises(InvalidValueError, match=r"takes \d+\.\d ms .* of 64 px on cpu, and a camera"):
        args.make_segmenter(is_live=True)


def test_random_weights_do_not_pass_the_self_test(folder: Path, capsys, monkeypatch) -> None:
    """Background subtraction, which stands beside, would."""
    monkeypatch.setattr(self_test, "NUM_EMPTY", 15)
    assert main(["track", "self-test", "--segmenter", "sam2", "--checkpoint", str(folder)]) == 2
    printed = capsys.readouterr()
    for kind, line in zip(KINDS, printed.out.splitlines(), strict=True):
        share, background = map(float, re.findall(r"(\d+) %", line))
        assert line.startswith(f"{kind}: right boxes in ")
        assert share < 50.0 < 100.0 * LEAST_RIGHT < background
    assert "sam2 does not agree with the truth" in printed.err


def test_a_painted_ball_lies_in_its_box() -> None:
    """Within a pixel; before the throw there is none."""
    images = list(painted_throw("plain"))
    assert not any(box for _, box in images[:NUM_EMPTY])
    image, box = images[-1]
    red, green, _ = np.moveaxis(image.pixels.astype(int), -1, 0)
    rows, columns = np.nonzero(red - green > 80)
    assert (columns.min(), rows.min(), columns.max() + 1, rows.max() + 1) == pytest.approx(box, abs=1.0)


def test_prompts_reach_the_encoder_in_its_coordinates(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    segmenter = Sam2Segmenter(folder, "cpu")
    embedding, seen = segmenter._model.prompt_encoder.shared_embedding, []
    embed = embedding.forward
    monkeypatch.setattr(
        embedding, "forward", lambda coords, shape: (seen.append(coords), embed(coords, shape))[1]
    )
    segmenter.find(random_images(1)[0], prompt=BoxPrompt(box=(WIDTH / 4, HEIGHT / 2, WIDTH, HEIGHT)))
    # The encoder's own last point is padding.
    assert seen[0][0, 0, :-1].tolist() == [[SIZE / 4, SIZE / 2], [SIZE, SIZE]]
    assert segmenter._session is not None
    given = segmenter._session.point_inputs_per_obj[0][0]["point_labels"]
    assert given.flatten().tolist() == [2, 3]


def test_a_prompt_off_the_image_and_an_image_of_another_size_change_nothing(folder: Path) -> None:
    images = random_images(4)
    expected = run(Sam2Segmenter(folder, "cpu"), images)
    segmenter = Sam2Segmenter(folder, "cpu")
    results = run(segmenter, images[:2])
    for left in (-40.0, float("nan")):
        with pytest.raises(PerceptionError, match=f"not on the image of {WIDTH} by {HEIGHT} px"):
            segmenter.find(images[0], prompt=BoxPrompt(box=(left, 5.0, left + 10.0, 15.0)))
    with pytest.raises(PerceptionError, match=rf"must be \({HEIGHT}, {WIDTH}, 3\)"):
        segmenter.find(np.zeros((WIDTH, HEIGHT, 3), np.uint8))
    assert_equal([*results, *(segmenter.find(image) for image in images[2:])], expected)


def test_pixels_are_standardised_and_square(folder: Path) -> None:
    segmenter = Sam2Segmenter(folder, "cpu")
    image = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    image[:, WIDTH // 2 :] = (255, 128, 0)
    image.flags.writeable = False
    segmenter.find(image)
    pixels = segmenter._pixels(image)
    assert pixels.shape == (1, 3, SIZE, SIZE)
    for column, color in ((0, (0, 0, 0)), (-1, (255, 128, 0))):
        expected = (np.array(color) / 255 - MEAN) / DEVIATION
        np.testing.assert_allclose(pixels[0, :, 5, column].numpy(), expected, rtol=1e-6)


def test_a_mask_lies_where_its_logits_do() -> None:
    """Cells are 5 × 3 px; between the centres of cells 3 and 4 the sign changes in the middle: at 4 cells."""
    logits = torch.full((1, 1, 16, 16), -1.0)
    logits[..., 6:12, 4:9] = 1.0
    rows, columns = mask_of_logits(logits, HEIGHT, WIDTH).nonzero().unbind(1)
    assert (rows.min(), rows.max() + 1) == (6 * 3, 12 * 3)
    assert (columns.min(), columns.max() + 1) == (4 * 5, 9 * 5)


ADVICE = "hf download facebook/sam2.1-hiera-tiny --local-dir"


def drop_weights(folder: Path) -> None:
    weights = load_file(folder / "model.safetensors")
    kept = {name: value for name, value in weights.items() if not name.startswith("memory_encoder")}
    save_file(kept, folder / "model.safetensors", metadata={"format": "pt"})


def change_type(folder: Path) -> None:
    config = folder / "config.json"
    config.write_text(config.read_text().replace('"model_type": "sam2_video"', '"model_type": "sam3_video"'))


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (change_type, "a model of type 'sam3_video', not 'sam2_video'"),
        (lambda folder: (folder / "model.safetensors").unlink(), "cannot be read as SAM 2: .*safetensors"),
        (drop_weights, "lacks [0-9]+ weights of SAM 2, such as memory_encoder"),
    ],
)
def test_a_bad_checkpoint_is_named_with_its_download(tmp_path: Path, spoil: Callable, message: str) -> None:
    spoil(save_tiny_sam2(tmp_path))
    with pytest.raises(PerceptionError, match=f"(?s){message}.*{ADVICE} {tmp_path}"):
        Sam2Segmenter(tmp_path, "cpu")


def test_without_transformers_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "transformers", None)
    with pytest.raises(PerceptionError, match=r"pip install .*\[sam2\]"):
        runpy.run_path(str(sam2.__file__))


def test_what_cannot_be_is_refused_before_anything_is_loaded(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setenv("PATH", "")
    with pytest.raises(PerceptionError, match=r"needs a C compiler \(gcc or clang\).*apt install gcc"):
        Sam2Segmenter(tmp_path, "cpu", is_compiled=True)
    with pytest.raises(PerceptionError, match="no SAM 2 checkpoint in nowhere"):
        Sam2Segmenter(Path("nowhere"), "cpu")
    with pytest.raises(InvalidValueError, match="multiple of 32, not 100"):
        Sam2Segmenter(tmp_path, "cpu", image_size=100)
    if not torch.cuda.is_available():
        with pytest.raises(DeviceUnavailableError, match="'cuda'"):
            Sam2Segmenter(tmp_path, "cuda")
