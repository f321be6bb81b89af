"""Tiny random networks of each transformers family."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

LABELS = ("chair", "wall", "sofa", "armchair", "tv", "LABEL_5")
STAGES = ["stage1", "stage2", "stage3", "stage4"]
SWIN = {
    "model_type": "swin",
    "image_size": 32,
    "embed_dim": 8,
    "depths": [1] * 4,
    "num_heads": [1, 1, 2, 2],
    "window_size": 4,
    "out_features": STAGES,
}
RESNET = {
    "model_type": "resnet",
    "embedding_size": 8,
    "hidden_sizes": [8, 8, 16, 16],
    "depths": [1] * 4,
    "out_features": STAGES,
}
DINO = {
    "model_type": "rf_detr_dinov2",
    "hidden_size": 16,
    "num_hidden_layers": 2,
    "num_attention_heads": 2,
    "image_size": 64,
    "patch_size": 16,
    "num_windows": 2,
    "out_features": STAGES[:2],
}
DETR = {
    "encoder_layers": 1,
    "decoder_layers": 1,
    "encoder_attention_heads": 8,
    "decoder_attention_heads": 8,
    "encoder_ffn_dim": 32,
    "decoder_ffn_dim": 32,
    "d_model": 32,
    "num_queries": 12,
    "backbone_config": RESNET,
}
EOMT = {
    "hidden_size": 16,
    "num_hidden_layers": 2,
    "num_attention_heads": 2,
    "image_size": 64,
    "patch_size": 16,
    "num_blocks": 1,
    "num_queries": 12,
    "num_register_tokens": 1,
}
MODELS: dict[str, tuple[str, dict[str, Any]]] = {
    "mask2former": (
        "Mask2FormerForUniversalSegmentation",
        {
            "backbone_config": SWIN,
            "feature_size": 32,
            "mask_feature_size": 32,
            "hidden_dim": 32,
            "encoder_feedforward_dim": 32,
            "dim_feedforward": 32,
            "encoder_layers": 1,
            "decoder_layers": 2,
            "num_attention_heads": 2,
            "num_queries": 12,
        },
    ),
    "maskformer": (
        "MaskFormerForInstanceSegmentation",
        {
            "backbone_config": SWIN,
            "decoder_config": {"model_type": "detr", **DETR},
            "fpn_feature_size": 32,
            "mask_feature_size": 32,
        },
    ),
    "eomt": ("EomtForUniversalSegmentation", EOMT),
    "eomt_dinov3": ("EomtDinov3ForUniversalSegmentation", {**EOMT, "intermediate_size": 32}),
    "detr": ("DetrForSegmentation", DETR),
    "rf_detr": (
        "RfDetrForInstanceSegmentation",
        {
            "backbone_config": DINO,
            "d_model": 16,
            "decoder_layers": 1,
            "decoder_self_attention_heads": 2,
            "decoder_cross_attention_heads": 2,
            "decoder_ffn_dim": 32,
            "num_queries": 12,
            "group_detr": 1,
            "decoder_n_points": 2,
            "intermediate_size": 32,
        },
    ),
}
FIXED = {"height": 64, "width": 64}
PREPROCESSING: dict[str, dict[str, Any]] = {
    "mask2former": {"size": {"shortest_edge": 48, "longest_edge": 80}, "size_divisor": 32},
    "maskformer": {"size": 48, "max_size": 100, "size_divisibility": 32},
    "eomt": {"size": {"shortest_edge": 64, "longest_edge": 64}, "do_pad": True},
    "eomt_dinov3": {"size": {"shortest_edge": 64, "longest_edge": 64}, "do_pad": True},
    "detr": {"size": {"shortest_edge": 64, "longest_edge": 90}},
    "rf_detr": {"size": FIXED},
}


def write_network(folder: Path, kind: str, labels: Mapping[int, str] | None = None) -> Path:
    """Write a network of a family. Each query has other classes and masks. The default classes are LABELS."""
    import transformers

    name, parameters = MODELS[kind]
    torch.manual_seed(3)
    model_class = getattr(transformers, name)
    names = dict(labels or enumerate(LABELS))
    config = model_class.config_class(**parameters, id2label=names, num_labels=len(names))
    model = model_class(config)
    with torch.no_grad():
        for key, weights in model.named_parameters():
            spread = 3.0 if "quer" in key else 0.7
            if (
                any(part in key for part in ("class", "quer", "mask", "bbox_attention", "decoder.layers"))
                and "norm" not in key
            ):
                weights.copy_(torch.randn_like(weights) * spread)
    model.save_pretrained(folder)
    kind_of_processor = {"eomt": "EomtImageProcessor", "eomt_dinov3": "EomtImageProcessorFast"}
    content = {**PREPROCESSING[kind], "image_processor_type": kind_of_processor.get(kind, "Other")}
    (folder / "preprocessor_config.json").write_text(json.dumps(content))
    return folder
