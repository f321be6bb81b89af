"""Tiny random CLIP and SigLIP models with a small tokenizer."""

from __future__ import annotations

import json
from pathlib import Path

import torch

WORDS = ("[PAD]", "[UNK]", "[EOS]", "this", "is", "a", "photo", "of", "red", "blue", "chair", "bed", ".")
SIDE = 32  # px
VISION = {
    "hidden_size": 16,
    "intermediate_size": 32,
    "num_hidden_layers": 2,
    "num_attention_heads": 2,
    "image_size": SIDE,
    "patch_size": 8,
}
TEXT = {
    "hidden_size": 16,
    "intermediate_size": 32,
    "num_hidden_layers": 2,
    "num_attention_heads": 2,
    "max_position_embeddings": 16,
    "vocab_size": len(WORDS),
    "pad_token_id": 0,
    "bos_token_id": 2,
    "eos_token_id": 2,
}


def write_image_text(folder: Path, kind: str = "siglip") -> Path:
    """Write a model of type `kind` with its tokenizer and its preprocessing."""
    import transformers

    torch.manual_seed(5)
    config_class, model_class = {
        "siglip": (transformers.SiglipConfig, transformers.SiglipModel),
        "clip": (transformers.CLIPConfig, transformers.CLIPModel),
    }[kind]
    more = {"projection_dim": 16} if kind == "clip" else {}
    model = model_class(config_class(text_config=TEXT, vision_config=VISION, **more))
    with torch.no_grad():
        for weights in model.parameters():  # with the initial weights, all images would have equal embeddings
            weights.add_(torch.randn_like(weights) * 0.3)
    model.save_pretrained(folder)
    write_tokenizer(folder)
    size = {"height": SIDE, "width": SIDE} if kind == "siglip" else {"shortest_edge": SIDE}
    content = {"size": size, "resample": 3, "rescale_factor": 1 / 255}
    content |= {"image_mean": [0.5] * 3, "image_std": [0.5] * 3} if kind == "siglip" else {}
    (folder / "preprocessor_config.json").write_text(json.dumps(content))
    return folder


def write_tokenizer(folder: Path) -> None:
    """Write a tokenizer with the vocabulary WORDS."""
    import transformers
    from tokenizers import Tokenizer, models, normalizers, pre_tokenizers, processors

    tokenizer = Tokenizer(models.WordLevel({word: k for k, word in enumerate(WORDS)}, unk_token="[UNK]"))
    tokenizer.normalizer = normalizers.Lowercase()
    tokenizer.pre_tokenizer = pre_tokenizers.Whitespace()
    tokenizer.post_processor = processors.TemplateProcessing(single="$A [EOS]", special_tokens=[("[EOS]", 2)])
    fast = transformers.PreTrainedTokenizerFast(
        tokenizer_object=tokenizer, pad_token="[PAD]", unk_token="[UNK]", eos_token="[EOS]"
    )
    fast.save_pretrained(folder)
