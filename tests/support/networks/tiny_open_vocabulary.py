"""Tiny random OWLv2 and SAM models."""

from __future__ import annotations

import json
from pathlib import Path

import torch

from tests.support.networks.tiny_image_text import TEXT, VISION, write_tokenizer

SIDE = 64  # px
DECODER = {
    "hidden_size": 32,
    "mlp_dim": 32,
    "num_attention_heads": 2,
    "iou_head_hidden_dim": 16,
}
PROMPTS = {"hidden_size": 32, "image_size": SIDE, "patch_size": 16}
SAM_VISION = {
    "hidden_size": 32,
    "output_channels": 32,
    "num_hidden_layers": 1,
    "num_attention_heads": 2,
    "image_size": SIDE,
    "patch_size": 16,
    "mlp_dim": 32,
    "global_attn_indexes": [0],
    "num_pos_feats": 16,
}
HIERA = {
    "model_type": "sam2_hiera_det_model",
    "hidden_size": 8,
    "image_size": [SIDE, SIDE],
    "blocks_per_stage": [1, 1, 1, 1],
    "embed_dim_per_stage": [8, 16, 32, 64],
    "num_attention_heads_per_stage": [1, 1, 2, 2],
    "window_size_per_stage": [4, 4, 4, 4],
    "global_attention_blocks": [],
    "window_positional_embedding_background_size": [4, 4],
}


def write_owlv2(folder: Path) -> Path:
    import transformers

    torch.manual_seed(2)
    config = transformers.Owlv2Config(
        text_config=TEXT, vision_config={**VISION, "image_size": SIDE, "patch_size": 16}, projection_dim=16
    )
    transformers.Owlv2ForObjectDetection(config).save_pretrained(folder)
    write_tokenizer(folder)
    (folder / "preprocessor_config.json").write_text(json.dumps({"size": {"height": SIDE, "width": SIDE}}))
    return folder


def write_sam(folder: Path, kind: str) -> Path:
    """Write a SAM model if `kind` is "sam", otherwise a SAM 2 model."""
    import transformers

    torch.manual_seed(2)
    if kind == "sam":
        config = transformers.SamConfig(
            vision_config=SAM_VISION, prompt_encoder_config=PROMPTS, mask_decoder_config=DECODER
        )
        transformers.SamModel(config).save_pretrained(folder)
    else:
        vision = {
            "backbone_config": HIERA,
            "backbone_channel_list": [64, 32, 16, 8],
            "backbone_feature_sizes": [[16, 16], [8, 8], [4, 4]],
            "fpn_hidden_size": 32,
        }
        config = transformers.Sam2Config(
            vision_config=vision, prompt_encoder_config=PROMPTS, mask_decoder_config=DECODER
        )
        transformers.Sam2Model(config).save_pretrained(folder)
    (folder / "preprocessor_config.json").write_text("{}")
    return folder
