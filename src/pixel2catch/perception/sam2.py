"""SAM 2.1, an image segmenter with a memory, for a stream of images.

It has never run with real weights here: begin with `pixel2catch track self-test`. It needs transformers, the
extra `sam2`, and a checkpoint in a local folder. It never uses the network.
"""

import shutil
import time
from pathlib import Path
from statistics import median
from typing import Any, cast

import numpy as np
import torch
import torch.nn.functional as F  # noqa: N812
from jaxtyping import Bool, Float
from safetensors import SafetensorError
from torch import Tensor
from torch.nn.attention import SDPBackend, sdpa_kernel

from pixel2catch.camera.image import Pixels
from pixel2catch.errors import InvalidValueError, PerceptionError
from pixel2catch.files import read_json_object
from pixel2catch.installation import install_command
from pixel2catch.perception.segmenter import (
    NOT_FOUND,
    BoxPrompt,
    Motion,
    Prompt,
    Segmentation,
    Segmenter,
    check_image,
)
from pixel2catch.scene.constants import RGB_CAMERA
from pixel2catch.sim.factory import require_cuda

try:
    from huggingface_hub.errors import StrictDataclassError
    from transformers import Sam2VideoConfig, Sam2VideoInferenceSession, Sam2VideoModel
    from transformers.utils.logging import disable_progress_bar
except (ImportError, RuntimeError) as import_error:
    raise PerceptionError(
        f"SAM 2 cannot be imported from transformers: {import_error.__cause__ or import_error}. Install it: "
        f"{install_command('sam2')} --upgrade. A torchvision of another PyTorch must go: pip uninstall "
        "torchvision."
    ) from import_error

MODEL_ID = "facebook/sam2.1-hiera-tiny"  #: Public name of the smallest checkpoint.
STRIDES = (4, 8, 16)  #: Image pixels per cell of the encoder's feature maps. Source: the architecture.
SIZE_STEP = 32  #: The side of the model's image is a multiple of this [px]. Source: its coarsest feature map.
COMPILERS = ("gcc", "clang")  #: One of them is needed. Source: PyTorch.

#: Parts of the model that can be compiled.
MODULES = ("vision_encoder", "memory_attention", "mask_decoder", "memory_encoder")

ATTENTION = [SDPBackend.FLASH_ATTENTION, SDPBackend.EFFICIENT_ATTENTION, SDPBackend.MATH]
"""Kernels for attention, in order of preference. cuDNN's, PyTorch's first choice on an H100, take twice as
long for the memory attention."""

MEAN, DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
"""Mean and standard deviation of red, green, blue over ImageNet, in [0, 1]. Source: the model's training."""

WARM_UP_FRAMES = 24
"""Images tracked before the first image of a camera on CUDA. The memory grows for 16, and each size is
compiled on its own. Source: ours: timings are steady after 20."""

OBJECT = 0  #: Index of the only object of a session.
BOX_LABELS = (2, 3)  #: Labels of the two corners of a box. Source: the model's prompt encoder.


class Sam2Segmenter(Segmenter):
    """Follows an object by its appearance; it does not use motion.

    Its memory is bounded: the prompted image and what the model reads of the latest ones. The score is the
    model's probability that the object is in the image.
    """

    def __init__(
        self,
        folder: Path,
        device: str,
        image_size: int | None = None,
        *,
        is_compiled: bool = False,
        dtype: torch.dtype | None = None,
    ) -> None:
        """Load a checkpoint; on a CUDA device also track blank images, so that the first real one is fast.

        Args:
            folder: The checkpoint in the format of transformers.
            device: "cpu", "cuda" or "cuda:N".
            image_size: Side of the square that the model gets [px]; None is the checkpoint's 1024. Half of
                it is a quarter of the work, and masks are half as fine.
            is_compiled: Whether `torch.compile` fuses the kernels, and on CUDA records them as graphs.
            dtype: Of weights and computation; None is bfloat16 on CUDA, and float32 else.

        Raises:
            DeviceUnavailableError: CUDA is requested and absent.
            PerceptionError: The checkpoint is missing or damaged, or there is no compiler.
            InvalidValueError: The image size is invalid.
        """
        self._device = torch.device(device)
        is_cuda = self._device.type == "cuda"
        if is_cuda:
            require_cuda(device)
        if is_compiled and not any(map(shutil.which, COMPILERS)):
            fix = "apt install gcc python3-dev, or leave out --compile"
            raise PerceptionError(f"compiling SAM 2 needs a C compiler ({' or '.join(COMPILERS)}): {fix}.")
        dtype = dtype or (torch.bfloat16 if is_cuda else torch.float32)
        self._model = load_sam2(folder, self._device, dtype, image_size)
        self._has_graphs = is_compiled and is_cuda
        for name in MODULES if is_compiled else ():
            module: Any = torch.compile(getattr(self._model, name), mode="reduce-overhead")
            # Without copies the next image would overwrite the memory of the earlier ones.
            module.register_forward_hook(lambda module, inputs, output: _copied(output))
            setattr(self._model, name, module)
        norm = torch.tensor((MEAN, DEVIATION), device=self._device)[..., None, None]
        self._mean, self._deviation = norm
        self._size: tuple[int, int] | None = None  # of the images: height and width
        self._session: Sam2VideoInferenceSession | None = None
        self._frame_idx = 0
        if is_cuda:
            self.seconds_an_image(WARM_UP_FRAMES)

    @property
    def image_size(self) -> int:
        """Side of the square that the model gets [px]."""
        return cast("int", self._model.image_size)

    def find(
        self, image: Pixels, motion: Motion = None, prompt: Prompt = None, interval: float = 1.0
    ) -> Segmentation:
        """See `Segmenter.find`."""
        height, width = self._size or image.shape[:2]
        check_image(image, width, height)
        self._size = (height, width)
        if prompt is not None:
            self._start(width, height, prompt)
        return NOT_FOUND if self._session is None else self._segment(self._session, image)

    def reset(self) -> None:
        """See `Segmenter.reset`."""
        self._session = None

    def _start(self, width: int, height: int, prompt: BoxPrompt) -> None:
        """Begin a session. Each one has one prompt, because the model keeps all prompts."""
        u, v = prompt.center
        if not (0.0 <= u <= width and 0.0 <= v <= height):
            raise PerceptionError(
                f"the prompt's centre ({u:g}, {v:g}) px is not on the image of {width} by {height} px: mark "
                "the object where it is seen."
            )
        places = ("inference_device", "inference_state_device", "video_storage_device")
        where = dict.fromkeys(places, self._model.device)
        self._session = Sam2VideoInferenceSession(**where, dtype=self._model.dtype)
        self._frame_idx = 0
        index = self._session.obj_id_to_idx(OBJECT)
        corners = torch.tensor([[[prompt.box[:2], prompt.box[2:]]]])  # (1, 1, 2, 2) [px]
        labels = torch.tensor([[BOX_LABELS]], dtype=torch.int32)
        scale = torch.tensor([self.image_size / width, self.image_size / height])
        # The model takes coordinates of pixel centres.
        inputs = {"point_coords": corners * scale - 0.5, "point_labels": labels}
        self._session.add_point_inputs(index, self._frame_idx, inputs)
        self._session.obj_with_new_inputs = [OBJECT]

    def seconds_an_image(self, num_images: int) -> float:
        """Return the median time [s] of blank images of the policies' camera; discard object and size."""
        image = np.zeros((RGB_CAMERA.height, RGB_CAMERA.width, 3), np.uint8)
        times, prompt = [], BoxPrompt(box=(0.0, 0.0, 16.0, 16.0))
        self._size = None
        for i in range(num_images + 1):
            begin = time.perf_counter()
            self.find(image, prompt=None if i else prompt)
            times.append(time.perf_counter() - begin)
        self._session = self._size = None
        return median(times[1:])

    @torch.inference_mode()
    @sdpa_kernel(ATTENTION)
    def _segment(self, session: Sam2VideoInferenceSession, image: Pixels) -> Segmentation:
        if self._has_graphs:
            torch.compiler.cudagraph_mark_step_begin()
        output = self._model(session, frame=self._pixels(image), frame_idx=self._frame_idx)
        mask = mask_of_logits(output.pred_masks, *image.shape[:2]).cpu().numpy()
        score = output.object_score_logits.float().sigmoid().item()
        self._prune(session)
        self._frame_idx += 1
        return Segmentation(mask=mask if mask.any() else None, score=score)

    def _pixels(self, image: Pixels) -> Float[Tensor, "1 3 size size"]:
        """Return the image as the model takes it: a square of any aspect, standardised."""
        pixels = torch.from_numpy(image.copy()).to(self._device).permute(2, 0, 1).unsqueeze(0).float()
        size = (self.image_size, self.image_size)
        pixels = F.interpolate(pixels, size, mode="bilinear", align_corners=False, antialias=True)
        return ((pixels / 255.0 - self._mean) / self._deviation).to(self._model.dtype)

    def _prune(self, session: Sam2VideoInferenceSession) -> None:
        """Delete what no later image needs; the model keeps everything."""
        config = self._model.config
        reach = max(config.max_object_pointers_in_encoder, config.num_maskmem) - 1
        session.processed_frames = {}
        session.frames_tracked_per_obj[OBJECT].clear()
        outputs = session.output_dict_per_obj[OBJECT]
        outputs["non_cond_frame_outputs"].pop(self._frame_idx - reach, None)
        for kind in outputs.values():
            if self._frame_idx in kind:
                del kind[self._frame_idx]["high_res_masks"], kind[self._frame_idx]["pred_masks"]


def _copied(output: Any) -> Any:
    """Copy all tensors of tuples, lists and outputs of transformers."""
    match output:
        case Tensor():
            return output.clone()
        case tuple() | list():
            return type(output)(map(_copied, output))
        case dict():
            return type(output)(**{name: _copied(value) for name, value in output.items()})
    return output


def mask_of_logits(
    logits: Float[Tensor, "1 1 rows columns"], height: int, width: int
) -> Bool[Tensor, "height width"]:
    """Return where the model's coarse logits, resized to the image, are above zero."""
    return F.interpolate(logits.float(), (height, width), mode="bilinear", align_corners=False)[0, 0] > 0.0


def load_sam2(
    folder: Path, device: torch.device, dtype: torch.dtype, image_size: int | None = None
) -> Sam2VideoModel:
    """Load the video model from a folder in the format of transformers: config.json, model.safetensors.

    Raises:
        PerceptionError: The folder, or a file or weight in it, is missing or damaged.
        InvalidValueError: The image size is no positive multiple of 32.
    """
    if image_size is not None and (image_size <= 0 or image_size % SIZE_STEP):
        raise InvalidValueError(f"the image size must be a multiple of {SIZE_STEP}, not {image_size}.")
    try:
        kind = read_json_object(folder / "config.json").get("model_type")
    except (OSError, ValueError) as error:
        raise _unusable(folder, f"there is no SAM 2 checkpoint in {folder}: {error}") from error
    if kind != (wanted := Sam2VideoConfig.model_type):  # transformers would read it with new weights
        raise _unusable(folder, f"{folder} holds a model of type '{kind}', not '{wanted}'")
    disable_progress_bar()
    try:
        config = Sam2VideoConfig.from_pretrained(folder, local_files_only=True)
        config = config if image_size is None else _with_image_size(config, image_size)
        options: Any = {"use_safetensors": True, "output_loading_info": True, "local_files_only": True}
        loaded: Any = Sam2VideoModel.from_pretrained(folder, config=config, dtype=dtype, **options)
    except (OSError, ValueError, KeyError, RuntimeError, SafetensorError, StrictDataclassError) as error:
        raise _unusable(folder, f"{folder} cannot be read as SAM 2: {error}") from error
    model, report = loaded
    missing = sorted(report["missing_keys"])
    if missing:
        raise _unusable(folder, f"{folder} lacks {len(missing)} weights of SAM 2, such as {missing[0]}")
    return model.eval().requires_grad_(False).to(device)


def _unusable(folder: Path, problem: str) -> PerceptionError:
    return PerceptionError(f"{problem}. With a network: hf download {MODEL_ID} --local-dir {folder}")


def _with_image_size(config: Sam2VideoConfig, size: int) -> Sam2VideoConfig:
    """The configuration for another size of image; no weight depends on it."""
    values = config.to_dict()
    values["image_size"] = values["prompt_encoder_config"]["image_size"] = size
    values["memory_attention_rope_feat_sizes"] = [size // STRIDES[-1]] * 2
    values["vision_config"]["backbone_feature_sizes"] = [[size // stride] * 2 for stride in STRIDES]
    values["vision_config"]["backbone_config"]["image_size"] = [size, size]
    return Sam2VideoConfig(**values)
