"""The SAM 2.1 model of transformers from a local folder, and errors that say what to install or to download.

Needs transformers: the extra `sam2`. The network is never used.
"""

import json
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError

from pixel2catch.errors import InvalidValueError, PerceptionError

MODEL_ID = "facebook/sam2.1-hiera-tiny"
"""Public name of the smallest checkpoint. Source: ours: users report 25 images a second on a desktop GPU."""

STRIDES = (4, 8, 16)
"""Image pixels per cell of the encoder's three feature maps. Source: the model's architecture."""

SIZE_STEP = 32
"""The side of the model's image is a multiple of this [px]. Source: cells of its coarsest feature map."""


def _import_advice(error: Exception) -> str:
    """Say what is wrong with the installation."""
    if isinstance(error, ModuleNotFoundError) and error.name in ("huggingface_hub", "transformers"):
        return (
            "SAM 2 needs the package transformers, which is not installed: pip install 'pixel2catch[sam2]'."
        )
    return (
        f"SAM 2 cannot be imported from transformers: {_root_cause(error)}. If that is about torchvision, "
        f"it does not match PyTorch {torch.__version__}; it is not needed: pip uninstall torchvision, or "
        "install the version made for this PyTorch. If not: pip install --upgrade 'pixel2catch[sam2]'."
    )


def _root_cause(error: BaseException) -> BaseException:
    """Return what the error began with; transformers wraps it."""
    cause = error.__cause__ or error.__context__
    return error if cause is None else _root_cause(cause)


try:
    from huggingface_hub.errors import StrictDataclassError
    from transformers import Sam2VideoConfig, Sam2VideoInferenceSession, Sam2VideoModel
    from transformers.utils.logging import disable_progress_bar
except (ImportError, RuntimeError) as import_error:
    raise PerceptionError(_import_advice(import_error)) from import_error


def load_sam2(
    folder: Path, device: torch.device, dtype: torch.dtype, image_size: int | None = None
) -> Sam2VideoModel:
    """Load the video model from a folder in the format of transformers.

    Args:
        folder: Holds config.json and model.safetensors.
        device: Where the model will run.
        dtype: Of its weights and activations.
        image_size: Side of the square that the model sees [px]; None for the checkpoint's own, 1024.

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
            folder, config=config, dtype=dtype, local_files_only=True, output_loading_info=True
        )
    except (OSError, ValueError, KeyError, RuntimeError, SafetensorError, StrictDataclassError) as error:
        raise PerceptionError(
            f"{folder} cannot be read as SAM 2: {error}. {_download_advice(folder)}"
        ) from error
    model, report = loaded
    missing = sorted(report["missing_keys"])
    if missing:
        raise PerceptionError(
            f"{folder} lacks {len(missing)} weights of SAM 2, such as {missing[0]}. "
            f"{_download_advice(folder)}"
        )
    return model.eval().requires_grad_(False).to(device)


def new_session(model: Sam2VideoModel) -> Sam2VideoInferenceSession:
    """Return an empty memory on the model's device."""
    return Sam2VideoInferenceSession(
        inference_device=model.device,
        inference_state_device=model.device,
        video_storage_device=model.device,
        dtype=model.dtype,
    )


def _require_files(folder: Path) -> None:
    """Raise if this is no folder with a SAM 2 video model."""
    config = folder / "config.json"
    if not config.is_file():
        raise PerceptionError(f"there is no SAM 2 checkpoint in {folder}. {_download_advice(folder)}")
    if not any(folder.glob("*.safetensors")):
        raise PerceptionError(f"{folder} has no weights (*.safetensors). {_download_advice(folder)}")
    try:
        kind = json.loads(config.read_text()).get("model_type")
    except (ValueError, AttributeError) as error:
        raise PerceptionError(f"{config} is damaged: {error}. {_download_advice(folder)}") from error
    if kind != Sam2VideoConfig.model_type:
        raise PerceptionError(
            f"{folder} holds a model of type '{kind}', not '{Sam2VideoConfig.model_type}'. "
            f"{_download_advice(folder)}"
        )


def _download_advice(folder: Path) -> str:
    """Say how to get the checkpoint."""
    return f"On a machine with a network: hf download {MODEL_ID} --local-dir {folder}"


def _with_image_size(config: Sam2VideoConfig, size: int) -> Sam2VideoConfig:
    """Return the configuration for another size of image; no weight depends on it."""
    values = config.to_dict()
    values["image_size"] = values["prompt_encoder_config"]["image_size"] = size
    values["memory_attention_rope_feat_sizes"] = [size // STRIDES[-1]] * 2
    values["vision_config"]["backbone_feature_sizes"] = [[size // stride] * 2 for stride in STRIDES]
    values["vision_config"]["backbone_config"]["image_size"] = [size, size]
    return Sam2VideoConfig(**values)
