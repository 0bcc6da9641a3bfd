"""SAM 2.1 with 1.5 million random weights: the real code in milliseconds."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

if TYPE_CHECKING:  # takes seconds: each worker collects all tests, and one of them runs these
    from transformers import Sam2VideoConfig

SIZE = 64
CERTAIN = 9.0
HEIGHT, WIDTH = 48, 80


def save_tiny_sam2(folder: Path) -> Path:
    """Write a checkpoint that always finds something."""
    from transformers import Sam2VideoModel

    torch.manual_seed(0)
    model = Sam2VideoModel(tiny_config())
    # The usual initial weights are so small, or zero, that neither image nor memory would matter.
    for weights in model.parameters():
        if weights.ndim > 1:
            torch.nn.init.normal_(weights, std=weights[0].numel() ** -0.5)
    torch.nn.init.constant_(model.mask_decoder.pred_obj_score_head.proj_out.bias, CERTAIN)
    model.save_pretrained(folder)
    return folder


def tiny_config() -> "Sam2VideoConfig":
    """The architecture with few and narrow layers."""
    from transformers import Sam2VideoConfig
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
    vision = {
        "backbone_config": backbone,
        "backbone_channel_list": [128, 64, 32, 16],
        "backbone_feature_sizes": [[SIZE // stride] * 2 for stride in (4, 8, 16)],
        "fpn_hidden_size": hidden,
    }
    decoder: dict[str, Any] = {
        "hidden_size": hidden,
        "mlp_dim": 64,
        "num_attention_heads": 4,
        "iou_head_hidden_dim": 32,
    }
    return Sam2VideoConfig(
        image_size=SIZE,
        vision_config=vision,
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


def random_images(count: int, seed: int = 0) -> list[np.ndarray]:
    generator = np.random.default_rng(seed)
    return list(generator.integers(0, 256, (count, HEIGHT, WIDTH, 3), dtype=np.uint8))
