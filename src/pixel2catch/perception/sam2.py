"""SAM 2.1, an image segmenter with a memory, as a streaming segmenter.

    segmenter = Sam2Segmenter(Path("sam2.1-hiera-tiny"), "cuda")
    segmenter.start(image, BoxPrompt(box=(300.0, 200.0, 340.0, 240.0)))
    segmentation = segmenter.track(next_image)

Needs transformers, the extra `sam2`, and a checkpoint in a local folder: errors say what to install or to
download. The network is never used.
"""

import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any, Literal, cast

import numpy as np
import torch
import torch.nn.functional as F  # noqa: N812
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.nn.attention import SDPBackend, sdpa_kernel
from torch.utils import _pytree as pytree

from pixel2catch.camera.image import Pixels
from pixel2catch.errors import PerceptionError
from pixel2catch.perception.sam2_checkpoint import Sam2VideoInferenceSession, load_sam2, require_compiler
from pixel2catch.perception.segmenter import (
    BoxPrompt,
    ImageMotion,
    PointPrompt,
    Prompt,
    Segmentation,
    Segmenter,
    check_image,
)
from pixel2catch.scene.constants import RGB_CAMERA
from pixel2catch.sim.factory import require_cuda
from pixel2catch.sim.graphs import GraphedFunction

Module = Literal["vision_encoder", "memory_attention", "mask_decoder", "memory_encoder"]
"""A part of the model whose kernels can be fused."""

MODULES: tuple[Module, ...] = ("vision_encoder", "memory_attention", "mask_decoder", "memory_encoder")

COMPILED: tuple[Module, ...] = ("vision_encoder", "memory_attention")
"""What is worth the time to compile it. Source: ours; all four took more than 110 s on three cores."""

CAPTURED = ("get_image_features", "memory_attention", "_single_frame_forward", "_encode_new_memory")
"""Parts and methods of the model that take and return tensors, and never ask for a value on the host; those
modules are in them. Source: transformers 5.17 to 5.23."""

ATTENTION = [SDPBackend.FLASH_ATTENTION, SDPBackend.EFFICIENT_ATTENTION, SDPBackend.MATH]
"""Kernels for attention, the first that can. Without cuDNN's, PyTorch's first choice on an H100: there the
memory attention takes 0.75 ms a layer with it and 0.37 without (measured; 28,736 keys of 256 in bfloat16)."""

MEAN, DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
"""Mean and standard deviation of red, green, blue over ImageNet, of 1. Source: the model's training."""

WARM_UP_FRAMES = 24
"""Images tracked before the first of a camera on CUDA. The memory grows for 16, and each size is a recording.
Source: ours: timings are steady after 20."""

WARM_UP_RUNS = 2
"""Runs before a recording: in the first, kernels choose algorithms and take memory. Source: ours."""

OBJECT = 0  #: Index of the only object of a session.

BOX_LABELS, POINT_LABELS = (2, 3), (1,)
"""What the points of a prompt are: two corners; a point on the object. Source: the model's prompt encoder."""


class Sam2Segmenter(Segmenter):
    """Follows an object by its look, whatever else moves.

    Its memory is bounded: the prompted image and what the model reads of the latest ones. The score is the
    model's probability that the object is in the image. Motion means nothing to it.
    """

    def __init__(
        self,
        folder: Path,
        device: str,
        image_size: int | None = None,
        *,
        is_captured: bool = True,
        compiled: Sequence[Module] = (),
        dtype: torch.dtype | None = None,
    ) -> None:
        """Load a checkpoint; on a CUDA device also track blank images, so that the first real one is fast.

        Args:
            folder: The checkpoint in the format of transformers.
            device: "cpu", "cuda" or "cuda:N".
            image_size: Side of the square that the model sees [px], a multiple of 32; None is the
                checkpoint's 1024. Half of it is a quarter of the work, and masks are half as fine.
            is_captured: Whether it runs as CUDA graphs on a CUDA device.
            compiled: Modules whose kernels are fused before.
            dtype: Of weights and work; None is bfloat16 on CUDA, and float32 else.

        Raises:
            DeviceUnavailableError: If CUDA is asked for and absent.
            PerceptionError: If the checkpoint is missing or damaged, or a compiler is missing.
            InvalidValueError: If the image size is invalid.
        """
        self._device = torch.device(device)
        is_cuda = self._device.type == "cuda"
        if is_cuda:
            require_cuda(device)
        if compiled:
            require_compiler()
        dtype = dtype or (torch.bfloat16 if is_cuda else torch.float32)
        self._model = load_sam2(folder, self._device, dtype, image_size)
        self._mean = torch.tensor(MEAN, device=self._device).view(3, 1, 1)
        self._deviation = torch.tensor(DEVIATION, device=self._device).view(3, 1, 1)
        self._upload = torch.empty((0, 0, 3), dtype=torch.uint8)
        self._mask, self._score = torch.empty((0, 0), dtype=torch.bool), torch.empty(1, pin_memory=is_cuda)
        self._session: Sam2VideoInferenceSession | None = None
        self._frame_idx = 0
        for name in compiled:
            module = getattr(self._model, name)
            module.forward = torch.compile(module.forward)
        model: Any = self._model
        self._encode_memory = model._batch_encode_memories
        model._batch_encode_memories = self._read_and_remember
        if is_cuda:
            self._is_read = torch.cuda.Event()
            place_pointers_ahead(self._model)
            if is_captured:
                capture(self._model)
            self.start(_blank(), PointPrompt(center=(0.0, 0.0)))
            self.seconds_an_image(WARM_UP_FRAMES)

    @property
    def image_size(self) -> int:
        """Side of the square that the model sees [px]."""
        return cast("int", self._model.image_size)

    def start(self, image: Pixels, prompt: Prompt, motion: ImageMotion | None = None) -> Segmentation:
        """See `Segmenter.start`. A session has one prompt, because the model never forgets one."""
        self._check(image)
        height, width, _ = image.shape
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
        points, labels = _points(prompt)
        scale = torch.tensor([self.image_size / width, self.image_size / height])
        # The model takes coordinates of pixel centres.
        inputs = {"point_coords": points * scale - 0.5, "point_labels": labels}
        self._session.add_point_inputs(index, self._frame_idx, inputs)
        self._session.obj_with_new_inputs = [OBJECT]
        return self._segment(self._session, image)

    def track(self, image: Pixels, motion: ImageMotion | None = None) -> Segmentation:
        """See `Segmenter.track`."""
        self._check(image)
        if self._session is None:
            return Segmentation(mask=None, score=0.0)
        return self._segment(self._session, image)

    def reset(self) -> None:
        """See `Segmenter.reset`."""
        self._session = None

    def seconds_an_image(self, num_images: int) -> float:
        """Return the median time of an image [s] of so many blank ones of the policies' camera.

        What was followed is forgotten, and the size of the images.
        """
        self._upload = torch.empty((0, 0, 3), dtype=torch.uint8)
        image, times = _blank(), []
        self.start(image, BoxPrompt(box=(0.0, 0.0, 16.0, 16.0)))
        for _ in range(num_images):
            begin = time.perf_counter()
            self.track(image)
            times.append(time.perf_counter() - begin)
        self.reset()
        self._upload = torch.empty((0, 0, 3), dtype=torch.uint8)
        return median(times)

    @torch.inference_mode()
    @sdpa_kernel(ATTENTION)
    def _segment(self, session: Sam2VideoInferenceSession, image: Pixels) -> Segmentation:
        """Run the model on the session's next image."""
        self._model(session, frame=self._pixels(image), frame_idx=self._frame_idx)
        self._prune(session)
        self._frame_idx += 1
        if self._device.type == "cuda":
            self._is_read.synchronize()
        mask = self._mask.numpy().copy()
        return Segmentation(mask=mask if mask.any() else None, score=self._score.item())

    def _read_and_remember(self, inference_session: Sam2VideoInferenceSession, **inputs: Any) -> None:
        """Send the result to the host before its memory is encoded, which only the next image waits for."""
        kinds = inference_session.output_dict_per_obj[OBJECT].values()
        output = next(kind[self._frame_idx] for kind in kinds if self._frame_idx in kind)
        self._mask.copy_(mask_of_logits(output["pred_masks"], *self._mask.shape), non_blocking=True)
        score = output["object_score_logits"].float().sigmoid()
        self._score.copy_(score.flatten(), non_blocking=True)
        if self._device.type == "cuda":
            self._is_read.record()
        self._encode_memory(inference_session=inference_session, **inputs)

    def _pixels(self, image: Pixels) -> Float[Tensor, "1 3 size size"]:
        """Return the image as the model wants it: a square, whatever its aspect, and standardised."""
        np.copyto(self._upload.numpy(), image)
        pixels = self._upload.to(self._device, non_blocking=True).permute(2, 0, 1).unsqueeze(0).float()
        size = (self.image_size, self.image_size)
        pixels = F.interpolate(pixels, size, mode="bilinear", align_corners=False, antialias=True)
        return ((pixels / 255.0 - self._mean) / self._deviation).to(self._model.dtype)

    def _prune(self, session: Sam2VideoInferenceSession) -> None:
        """Drop what no later image needs; the model keeps everything."""
        config = self._model.config
        reach = max(config.max_object_pointers_in_encoder, config.num_maskmem) - 1
        session.processed_frames = {}
        session.frames_tracked_per_obj[OBJECT].clear()
        outputs = session.output_dict_per_obj[OBJECT]
        outputs["non_cond_frame_outputs"].pop(self._frame_idx - reach, None)
        for kind in outputs.values():
            if self._frame_idx in kind:
                del kind[self._frame_idx]["high_res_masks"], kind[self._frame_idx]["pred_masks"]

    def _check(self, image: Pixels) -> None:
        is_first = self._upload.numel() == 0
        height, width = (image if is_first else self._upload).shape[:2]
        check_image(image, width, height)
        if is_first:
            is_cuda = self._device.type == "cuda"
            self._upload = torch.empty((height, width, 3), dtype=torch.uint8, pin_memory=is_cuda)
            self._mask = torch.empty((height, width), dtype=torch.bool, pin_memory=is_cuda)


class CapturedFunction:
    """A function of tensors on a CUDA device, recorded once for every shape of its input and then replayed.

    Several may share a pool of memory: inputs and outputs are copied, so that nothing in it is needed between
    two calls.
    """

    def __init__(self, function: Callable[..., Any], pool: Any) -> None:
        """Take the function, and a pool of `torch.cuda.graph_pool_handle`; nothing runs yet.

        The function depends on its arguments and on constant tensors only. In and out are nested tuples,
        lists, dictionaries and model outputs of tensors and constants.
        """
        self._function, self._pool = function, pool
        self._graphs: dict[tuple[Any, ...], GraphedFunction[Any]] = {}

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        """Return what the function returns."""
        leaves, structure = pytree.tree_flatten((args, kwargs))
        tensors = {i: leaf for i, leaf in enumerate(leaves) if isinstance(leaf, Tensor)}
        layouts = {i: (tensor.shape, tensor.dtype, tensor.device) for i, tensor in tensors.items()}
        key = (structure, *(layouts.get(i, leaf) for i, leaf in enumerate(leaves)))
        if key not in self._graphs:
            constants = {i: leaf for i, leaf in enumerate(leaves) if i not in tensors}
            function = partial(self._of_tensors, structure, constants, tuple(tensors))
            device = next(iter(tensors.values())).device
            graphed = GraphedFunction(function, device=device, num_eager_calls=WARM_UP_RUNS, pool=self._pool)
            for _ in range(WARM_UP_RUNS):  # on copies, as the recording: strides matter to compiled code
                graphed(*map(torch.clone, tensors.values()))
            self._graphs[key] = graphed
        return pytree.tree_map_only(Tensor, Tensor.clone, self._graphs[key](*tensors.values()))

    def _of_tensors(
        self, structure: pytree.TreeSpec, constants: dict[int, Any], places: tuple[int, ...], *tensors: Tensor
    ) -> Any:
        """The function with its tensors one after the other, at these places among all that goes in."""
        leaves = constants | dict(zip(places, tensors, strict=True))
        args, kwargs = pytree.tree_unflatten([leaves[i] for i in range(len(leaves))], structure)
        return self._function(*args, **kwargs)


def capture(model: nn.Module) -> None:
    """Let a model on a CUDA device run as CUDA graphs but for what it remembers; it computes the same.

    It runs a thousand small kernels for an image; on a data-centre GPU the time goes into launching them.
    """
    pool = torch.cuda.graph_pool_handle()
    for name in CAPTURED:
        part = getattr(model, name)
        owner, method = (part, "forward") if isinstance(part, nn.Module) else (model, name)
        setattr(owner, method, CapturedFunction(getattr(owner, method), pool))


def place_pointers_ahead(model: Any) -> None:
    """Work out on the host how long ago the object's pointers were made, and send it without waiting.

    The library makes a tensor of them on the device, for which the host waits until the image is encoded.
    """
    process, host, device = model._process_object_pointers, torch.device("cpu"), model.device
    model._process_object_pointers = lambda *inputs: process(*inputs[:-1], host)
    model.temporal_positional_encoding_projection_layer.register_forward_pre_hook(
        lambda _, inputs: (inputs[0].pin_memory().to(device, non_blocking=True),)
    )


def mask_of_logits(
    logits: Float[Tensor, "1 1 rows columns"], height: int, width: int
) -> Bool[Tensor, "height width"]:
    """Return where the model's coarse map of the image, brought to the image's size, is above zero."""
    return F.interpolate(logits.float(), (height, width), mode="bilinear", align_corners=False)[0, 0] > 0.0


def _blank() -> Pixels:
    return np.zeros((RGB_CAMERA.height, RGB_CAMERA.width, 3), np.uint8)


def _points(prompt: Prompt) -> tuple[Float[Tensor, "1 1 num_points 2"], Tensor]:
    """A prompt's points [px] and what they are."""
    if isinstance(prompt, BoxPrompt):
        points, labels = (prompt.box[:2], prompt.box[2:]), BOX_LABELS
    else:
        points, labels = (prompt.center,), POINT_LABELS
    return torch.tensor([[points]], dtype=torch.float32), torch.tensor([[labels]], dtype=torch.int32)
