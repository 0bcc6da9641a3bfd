"""SAM 2.1 from a local folder: the library that it needs, the files, and what is wrong with them."""

import shutil
import sysconfig
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError

from pixel2catch.errors import InvalidValueError, PerceptionError
from pixel2catch.files import read_json_object
from pixel2catch.installation import install_command, requirements

__all__ = ("Sam2VideoInferenceSession", "image_size_of", "load_sam2", "require_compiler")

MODEL_ID = "facebook/sam2.1-hiera-tiny"
"""Public name of the smallest checkpoint. Source: ours: users report 25 images a second on a desktop GPU."""

USUAL_SIZE = 1024  #: Side of the square that all public checkpoints were made for [px].

STRIDES = (4, 8, 16)
"""Image pixels per cell of the encoder's three feature maps. Source: the model's architecture."""

SIZE_STEP = 32
"""The side of the model's image is a multiple of this [px]. Source: cells of its coarsest feature map."""

COMPILERS = ("gcc", "clang")  #: Any of them will do. Source: PyTorch.


def _require_version() -> None:
    """Refuse a version of transformers in which SAM 2 may be another; without metadata any may do."""
    wanted = requirements("sam2").get("transformers")
    if wanted and not wanted.contains(found := version("transformers"), prereleases=True):
        raise PerceptionError(
            f"SAM 2 needs transformers {wanted}, and {found} is installed: {install_command('sam2')}."
        )


def _import_advice(error: BaseException) -> str:
    if isinstance(error, ModuleNotFoundError) and error.name in ("huggingface_hub", "transformers"):
        return f"SAM 2 needs the package transformers, which is not installed: {install_command('sam2')}."
    while cause := error.__cause__ or error.__context__:  # transformers wraps it
        error = cause
    return (
        f"SAM 2 cannot be imported from transformers: {error}. If that is about torchvision, it "
        f"does not match PyTorch {torch.__version__}; it is not needed: pip uninstall torchvision, or "
        f"install the version made for this PyTorch. If not: {install_command('sam2')} --upgrade"
    )


try:
    _require_version()
    from huggingface_hub.errors import StrictDataclassError
    from transformers import Sam2VideoConfig, Sam2VideoInferenceSession, Sam2VideoModel
    from transformers.utils.logging import disable_progress_bar
except (ImportError, RuntimeError) as import_error:
    raise PerceptionError(_import_advice(import_error)) from import_error


def load_sam2(
    folder: Path, device: torch.device, dtype: torch.dtype, image_size: int | None = None
) -> Sam2VideoModel:
    """Load the video model from a folder in the format of transformers: config.json, model.safetensors.

    Raises:
        PerceptionError: If the folder, or a file or weight in it, is missing or damaged.
        InvalidValueError: If the image size is no positive multiple of 32.
    """
    if image_size is not None and (image_size <= 0 or image_size % SIZE_STEP):
        raise InvalidValueError(
            f"the image size must be a positive multiple of {SIZE_STEP}, not {image_size}."
        )
    _require_files(folder)
    disable_progress_bar()
    try:
        config = Sam2VideoConfig.from_pretrained(folder, local_files_only=True)
        config = config if image_size is None else _with_image_size(config, image_size)
        loaded: Any = Sam2VideoModel.from_pretrained(
            folder,
            config=config,
            dtype=dtype,
            local_files_only=True,
            use_safetensors=True,
            output_loading_info=True,
        )
    except (OSError, ValueError, KeyError, RuntimeError, SafetensorError, StrictDataclassError) as error:
        raise _unusable(folder, f"{folder} cannot be read as SAM 2: {error}") from error
    model, report = loaded
    missing = sorted(report["missing_keys"])
    if missing:
        raise _unusable(folder, f"{folder} lacks {len(missing)} weights of SAM 2, such as {missing[0]}")
    return model.eval().requires_grad_(False).to(device)


def image_size_of(folder: Path) -> int:
    """Side of the square that a checkpoint was made for [px].

    Raises:
        PerceptionError: If the folder, or a file in it, is missing or damaged.
    """
    _require_files(folder)
    size = read_json_object(folder / "config.json").get("image_size")
    return size if isinstance(size, int) else USUAL_SIZE


def _require_files(folder: Path) -> None:
    config = folder / "config.json"
    if not config.is_file():
        raise _unusable(folder, f"there is no SAM 2 checkpoint in {folder}")
    if not any(folder.glob("*.safetensors")):
        raise _unusable(folder, f"{folder} has no weights (*.safetensors)")
    try:
        kind = read_json_object(config).get("model_type")
    except (OSError, ValueError) as error:
        raise _unusable(folder, f"{config} is damaged: {error}") from error
    if kind != (wanted := Sam2VideoConfig.model_type):
        raise _unusable(folder, f"{folder} holds a model of type '{kind}', not '{wanted}'")


def _unusable(folder: Path, problem: str) -> PerceptionError:
    return PerceptionError(
        f"{problem}. On a machine with a network: hf download {MODEL_ID} --local-dir {folder}"
    )


def _with_image_size(config: Sam2VideoConfig, size: int) -> Sam2VideoConfig:
    """Return the configuration for another size of image; no weight depends on it."""
    values = config.to_dict()
    values["image_size"] = values["prompt_encoder_config"]["image_size"] = size
    values["memory_attention_rope_feat_sizes"] = [size // STRIDES[-1]] * 2
    values["vision_config"]["backbone_feature_sizes"] = [[size // stride] * 2 for stride in STRIDES]
    values["vision_config"]["backbone_config"]["image_size"] = [size, size]
    return Sam2VideoConfig(**values)


def require_compiler() -> None:
    """Refuse to go on without what `torch.compile` needs, and would miss only after long work.

    Raises:
        PerceptionError: If it is missing.
    """
    header = Path(sysconfig.get_path("include")) / "Python.h"
    if not any(map(shutil.which, COMPILERS)):
        lack = f"a C compiler ({' or '.join(COMPILERS)})"
    elif not header.is_file():
        lack = f"Python's headers ({header})"
    else:
        return
    raise PerceptionError(
        f"compiling SAM 2 needs {lack}, and there is none: apt install gcc python3-dev, or do without."
    )
